"""OffsetSums: flux and position of sources together, by linear least squares in the visibilities.

A source of flux f moved by (dl, dm) is f K + f dl dK/dl + f dm dK/dm to first order: three columns for each source, all
sources solved at once. Right for shifts well below the resolution; the error grows with the square of their ratio.
"""

from __future__ import annotations

import numpy as np

from instrument.errors import InputError
from instrument.observe.directions import LIGHT, lmn
from instrument.phasor import station_phases
from instrument.sky.points import PointSky
from instrument.units import UV_RANGE, Complex, Float, Int
from instrument.visibilities import Visibilities


class OffsetSums:
    """Normal equations of fluxes and offsets of groups of sources, for several sets of data on the same coordinates.

    `group` (S,) numbers the group of each source from 0, in ascending order; a group keeps the shares of |I| among its
    sources, and moves as one. Time and channels are averaged over; `uv_range` is in wavelengths.
    """

    def __init__(self, sky: PointSky, group: Int, uv_range: tuple[float, float] | None = None) -> None:
        self.sky = sky
        self.first = np.flatnonzero(np.diff(group, prepend=-1))
        flux = np.abs(sky.stokes_jy[:, 0])
        total = np.add.reduceat(flux, self.first)[group]
        count = np.bincount(group)[group]
        self.mix = np.where(total > 0, flux / np.where(total > 0, total, 1), 1 / count)
        self.shaped = np.flatnonzero(sky.gaussian)
        self.uv_range = None if uv_range is None else UV_RANGE.check(uv_range, "uv_range")
        self.normal = np.zeros((3 * len(self.first),) * 2)
        self.right: Float | None = None

    def add(self, block: Visibilities, stokes_i: Complex) -> None:
        """Add a block: its coordinates and weights, and R sets of Stokes I visibilities (R, T, F, B)."""
        weights = np.broadcast_to(block.stokes_weight[..., 0], block.data.shape[:3])
        if self.right is None:
            self.right = np.zeros((len(self.normal), len(stokes_i)))
        for t in range(block.at.shape[0]):
            for f, freq in enumerate(block.freq_hz):
                uvw = block.station_uvw_m[t] * (freq / LIGHT)
                apart = uvw[block.antenna1] - uvw[block.antenna2]
                use = weights[t, f] > 0
                if self.uv_range is not None:
                    length = np.hypot(apart[:, 0], apart[:, 1])
                    use &= (length >= self.uv_range[0]) & (length <= self.uv_range[1])
                root = np.sqrt(weights[t, f, use])
                columns = self._columns(block, t, f, uvw, apart, use) * root[:, None]
                columns = np.concatenate([columns.real, columns.imag])
                values = stokes_i[:, t, f, use] * root
                self.normal += columns.T @ columns
                self.right += columns.T @ np.concatenate([values.real, values.imag], axis=1).T

    def _columns(self, block: Visibilities, t: int, f: int, uvw: Float, apart: Float, use: Float) -> Complex:
        """Visibilities of 1 Jy, and their derivatives by l and by m, complex (B', 3 G)."""
        where = lmn(self.sky.vectors, block.phase_centre)
        z = station_phases(uvw[None], where)[0]
        k = z[block.antenna1[use]] * z[block.antenna2[use]].conj() * self.mix
        apart = apart[use]
        if len(self.shaped):
            at = block.at.block(slice(t, t + 1), slice(f, f + 1))
            envelope = self.sky.select(self.shaped).envelope(at, apart[None, None])
            assert envelope is not None
            k[:, self.shaped] *= envelope[0, 0]
        n = 1 + where[:, 2]
        # d(n - 1)/dl = -l/n
        slopes = [-2j * np.pi * (apart[:, c, None] - apart[:, 2, None] * (where[:, c] / n)) for c in (0, 1)]
        each = (k, slopes[0] * k, slopes[1] * k)
        return np.concatenate([np.add.reduceat(x, self.first, axis=1) for x in each], axis=1)

    def finish(self) -> tuple[Float, Float, Float]:
        """Flux in Jy (R, G), flux times offset in l and m in Jy rad (R, G, 2), and their spread (G, 3).

        The spread is the standard error for data whose real and imaginary parts have an rms of 1 Jy: flux, then flux
        times offset. Raises `InputError` where sources cannot be told apart by this array.
        """
        from scipy.linalg import LinAlgError, cho_factor, cho_solve

        if self.right is None:
            raise InputError("no visibilities were given to measure offsets in")
        size = np.sqrt(np.diagonal(self.normal))
        try:
            if not np.all(size > 0):
                raise LinAlgError
            # columns of 1 and of 2 pi u differ by 1e5: scaled to a unit diagonal first
            factor = cho_factor(self.normal / size[:, None] / size, lower=True)
        except LinAlgError:
            raise InputError(
                f"fluxes and offsets of {len(self.first)} sources are not told apart by these baselines: watch fewer"
            ) from None
        found = (cho_solve(factor, self.right / size[:, None]) / size[:, None]).T.reshape(len(self.right[0]), 3, -1)
        spread = np.sqrt(np.diagonal(cho_solve(factor, np.eye(len(size))))) / size
        return found[:, 0], np.moveaxis(found[:, 1:], 1, 2), spread.reshape(3, -1).T
