"""GMCA: components that are sparse in wavelets (Bobin et al. 2007, 2008; for foregrounds Chapman et al. 2013)."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
from instrument_plugins.foregrounds.sparse import MAD, SLOPE, search, share
from instrument_plugins.foregrounds.starlet import GAINS, SMOOTH, starlet

from instrument.errors import Outcome
from instrument.foreground.base import ForegroundRemover, Separation
from instrument.foreground.linear import apply, covariance, leading, principal, projection, seen
from instrument.foreground.maps import StokesMaps
from instrument.units import Bool, Float, Real, Whole

SAMPLE = 32768  # coefficients of which medians are taken: to 0.7 %
BRIGHTEST = 1e4  # power of a principal map over that of the weakest, beyond which it is scaled down to it
LEFT = 10  # times the power that principal components leave: then something was not seen


class GMCA(ForegroundRemover):
    """Finds spectra A and sparse maps S with X = A S + N in starlet space, by alternating least squares.

    The threshold on S falls from its largest value to `threshold` times its noise over `iterations`. Every wavelet
    scale is first divided by its noise ("measured": the median of the weakest of the principal maps that are used;
    "white": what white noise gives), so that noise of the finest scale does not hide a foreground at larger ones.
    `paper=True` is the published scheme: no such division, all channels rather than principal maps, soft thresholds
    that keep a share of the coefficients which grows with the iterations. `mode` "project" takes away A A^+ X,
    "threshold" only what of it stands `threshold` times above the noise, scale by scale.
    """

    components: Annotated[int, Whole(at_least=0)] = 4
    scales: Annotated[int, Whole(at_least=1, at_most=8)] = 4
    iterations: Annotated[int, Whole(at_least=2)] = 100
    threshold: Annotated[float, Real(at_least=0)] = 3.0
    noise: Literal["measured", "white"] = "measured"
    mode: Literal["project", "threshold"] = "project"
    paper: bool = False

    def separate(self, given: StokesMaps) -> Separation:
        """Foreground A A^+ X, or what of it is significant."""
        maps = given.plane
        n, f = self.components, len(maps)
        if not 0 < n < f:
            return projection(maps, np.eye(f)[:, :n], Outcome.CONVERGED, f"{n} components of {f} channels: no search")
        # principal maps lose nothing of span(A) within them, and there are 8 times fewer of them than channels
        values, vectors = principal(maps, min(max(20, 5 * n), f))
        basis = np.eye(f) if self.paper else vectors * _scale(values)
        data, sample = self._coefficients(apply(basis.T, maps), seen(maps), float(values[-1]))
        noise = np.ones(f) if self.paper else _scale(values)
        found = search(data, sample, noise, n, self.iterations, self.threshold, self.paper)
        if found.mixing is None:
            remark = f"no wavelet coefficient stands {self.threshold:g} times above the noise: nothing was taken away"
            return Separation.nothing(maps, found.outcome, remark)
        scheme = "the published scheme" if self.paper else f"each over its noise ({self.noise})"
        remark = f"{self.scales} wavelet scales, {scheme}, {self.mode}"
        remark = f"{remark}, {found.iterations} iterations, last change {found.change:.0e}"
        # (D A)^+ sees the scaled maps; the spectra themselves are D^-1 A. QR with pivots keeps every row's digits
        inner = found.mixing if self.paper else found.mixing / _scale(values)[:, None]
        separation = projection(maps, (basis if self.paper else vectors) @ inner, found.outcome, remark)
        separation = _all_of_it(separation, values, vectors, float(np.finfo(maps.dtype).eps))
        return separation if self.mode == "project" else self._significant(maps, separation)

    def _coefficients(self, maps: Any, good: Bool, weakest: float) -> tuple[Any, Any]:
        """Wavelet coefficients (rows, N) where there are data, and some of them: those of every n-th diagonal.

        The smooth plane is one of the scales: a foreground without small scales is nowhere else. The diagonals are
        mirrored about the middle, so that turned and mirrored cubes give the same answer.
        """
        details, last = starlet(maps, self.scales)
        planes = details if self.paper else np.concatenate([details, last[:, None]], axis=1)
        del details
        if not self.paper:
            planes /= self._levels(planes[-1, :-1], last[-1], good, weakest)[:, None, None].astype(maps.dtype)
        rows, columns = (np.minimum(np.arange(k), np.arange(k)[::-1]) for k in good.shape)
        every = min(max(int(good.sum()) * planes.shape[1] // SAMPLE, 1), 1 + rows.max() + columns.max())
        some = good & ((rows[:, None] + columns) % every == 0)
        sample = planes[:, :, some if some.any() else good].reshape(len(planes), -1)
        return (planes if good.all() else planes[:, :, good]).reshape(len(planes), -1), sample

    def _levels(self, details: Any, last: Any, good: Bool, power: float) -> Float:
        """Noise of each scale and of the smooth plane (scales + 1,), of the planes or the power of one map."""
        white = np.array([*GAINS[: self.scales], SMOOTH[self.scales - 1]])
        if self.noise == "white":
            return white * (np.sqrt(power) if power > 0 else 1.0)
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
        levels = self._levels(details[0], last[0], good := seen(maps), float(values[-1]))
        axes = leading(a @ covariance(s) @ a.T, a.shape[1])[1]
        limit = (self.threshold * levels / (1 - SLOPE)).astype(maps.dtype)  # what is below the threshold stays whole
        details, last = starlet(apply(axes.T, maps), self.scales)
        sparse = last * (good * share(last, limit[-1]))
        sparse += (details * (good * share(details, limit[:-1, None, None]))).sum(axis=1)
        kept = apply(np.linalg.pinv(a) @ axes, sparse)
        return replace(separation, components=kept, foreground=apply(axes, sparse), operator=None)


def _scale(values: Float) -> Float:
    """Factors (r,) of principal maps of powers `values`: none is left more than 100 times brighter than the weakest.

    What is so far above the noise is known as well at a hundredth of it, while spectra that are parallel but for a
    millionth drown in the rounding of the sums.
    """
    tiny = np.finfo(float).tiny
    return np.minimum(1.0, np.sqrt(BRIGHTEST * np.maximum(values[-1], tiny) / np.maximum(values, tiny)))


def _all_of_it(found: Separation, values: Float, vectors: Float, eps: float) -> Separation:
    """The separation; POOR_FIT where it leaves far more power than as many principal components do."""
    inner = vectors.T @ found.basis
    rest = np.eye(len(values)) - inner @ inner.T
    left = float(((rest**2) @ values).sum())
    least = float(values[found.basis.shape[1] :].sum()) + (100 * eps) ** 2 * float(values[0])
    if left <= LEFT * least:
        return found
    remark = f"{found.remark}; it leaves {left / least:.0f} times the power that as many principal components do"
    return replace(found, outcome=Outcome.POOR_FIT, remark=remark)
