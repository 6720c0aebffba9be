"""GMCA: components that are sparse in wavelets (Bobin et al. 2007, 2008; for foregrounds Chapman et al. 2013)."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
from instrument_plugins.foregrounds.sparse import MAD, search
from instrument_plugins.foregrounds.starlet import GAINS, SMOOTH, starlet
from pydantic import Field

from instrument.errors import Outcome
from instrument.foreground.base import ForegroundRemover, Separation
from instrument.foreground.linear import apply, covariance, leading, principal, projection, seen
from instrument.units import Bool, Float


class GMCA(ForegroundRemover):
    """Finds spectra A and sparse maps S with X = A S + N in starlet space, by alternating least squares.

    The threshold on S falls from its largest value to `threshold` times its noise over `iterations`. Every wavelet
    scale is first divided by its noise ("measured": the median of the weakest of the principal maps that are used;
    "white": what white noise gives), so that noise of the finest scale does not hide a foreground at larger ones.
    `paper=True` is the published scheme: no such division, all channels rather than principal maps, soft thresholds
    that keep a share of the coefficients which grows with the iterations. `mode` "project" takes away A A^+ X,
    "threshold" only what of it stands `threshold` times above the noise, scale by scale.
    """

    components: Annotated[int, Field(ge=0)] = 4
    scales: Annotated[int, Field(ge=1, le=8)] = 4
    iterations: Annotated[int, Field(ge=2)] = 100
    threshold: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 3.0
    noise: Literal["measured", "white"] = "measured"
    mode: Literal["project", "threshold"] = "project"
    paper: bool = False

    def separate(self, maps: Any, freq_hz: Float) -> Separation:
        """Foreground A A^+ X, or what of it is significant."""
        n, f = self.components, len(maps)
        if not 0 < n < f:
            return projection(maps, np.eye(f)[:, :n], Outcome.CONVERGED, f"{n} components of {f} channels: no search")
        kept = f if self.paper else min(max(20, 5 * n), f)
        # principal maps lose nothing of span(A) within them, and there are 8 times fewer of them than channels
        basis = np.eye(f) if self.paper else principal(maps, kept)[1]
        details, last = starlet(apply(basis.T, maps), self.scales)
        good = seen(maps)
        if not self.paper:
            details /= self._levels(details[-1], last[-1], good)[:-1, None, None].astype(maps.dtype)
        data = (details if good.all() else details[:, :, good]).reshape(kept, -1)
        del details
        found = search(data, n, self.iterations, self.threshold, self.paper)
        if found.mixing is None:
            remark = f"no wavelet coefficient stands {self.threshold:g} times above the noise: nothing was taken away"
            return Separation.nothing(maps, found.outcome, remark)
        scheme = "the published scheme" if self.paper else f"each over its noise ({self.noise})"
        remark = f"{self.scales} wavelet scales, {scheme}, {self.mode}"
        remark = f"{remark}, {found.iterations} iterations, last change {found.change:.0e}"
        separation = projection(maps, basis @ found.mixing, found.outcome, remark)
        return separation if self.mode == "project" else self._significant(maps, separation)

    def _levels(self, details: Any, last: Any, good: Bool) -> Float:
        """Noise of each scale and of the smooth plane (scales + 1,), from the planes of one map."""
        white = np.array([*GAINS[: self.scales], SMOOTH[self.scales - 1]])
        if self.noise == "white":
            return white
        found = np.array([np.median(np.abs(plane[good])) for plane in (*details, last)], float) / MAD
        return found if (found > 0).all() else white * max(found.max(), 1e-30)

    def _significant(self, maps: Any, separation: Separation) -> Separation:
        """Only what of A A^+ X stands above the noise, scale by scale, the smooth plane included.

        Along the principal axes of A S, which are orthonormal: every axis has the noise of a channel, that of the
        weakest principal map. Along the columns of A, nearly parallel for smooth spectra, noise would be far larger.
        """
        a, s = separation.mixing, separation.components
        values, vectors = principal(maps, min(max(20, 5 * self.components), len(maps)))
        details, last = starlet(apply(vectors[:, -1:].T, maps), self.scales)
        levels = self._levels(details[0], last[0], good := seen(maps))
        if self.noise == "white":
            levels = levels * np.sqrt(max(values[-1], 0.0))
        axes = leading(a @ covariance(s) @ a.T, a.shape[1])[1]
        limit = (self.threshold * levels).astype(maps.dtype)
        details, last = starlet(apply(axes.T, maps), self.scales)
        sparse = last * (good & (np.abs(last) >= limit[-1]))
        sparse += (details * (good & (np.abs(details) >= limit[:-1, None, None]))).sum(axis=1)
        kept = apply(np.linalg.pinv(a) @ axes, sparse)
        return replace(separation, components=kept, foreground=apply(axes, sparse), operator=None)
