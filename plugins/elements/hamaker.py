"""Hamaker: the analytic element beam of LOFAR's HBA and LBA dipoles."""

from __future__ import annotations

from functools import cache
from typing import ClassVar, Literal

import numpy as np

from instrument.jones.base import ElementBeam
from instrument.mat2 import UNIT, pack
from instrument.observe.sampling import Sampling
from instrument.units import Complex, Float

X_AZIMUTH = np.deg2rad(225.0)  # of the +X dipole, from p (east) towards q (north): south-west


class Hamaker(ElementBeam):
    """LOFAR dual-dipole element, (T, F, A, S, 2, 2): two azimuthal harmonics, polynomials in theta and frequency.

    p_d(theta, x) = sum_ij C[k, i, j, d] theta^i x^j with x = (f - f0) / df, and
    J = sum_k [[cos a p_theta, -sin a p_phi], [sin a p_theta, cos a p_phi]], a = (-1)^k (2k+1) phi, phi from the +X
    dipole. The minus sign on p_phi of Hamaker (2011) is already in the distributed coefficients, which are those of
    fields exp(+i omega t). Zero at and below the
    antenna plane; outside its band it extrapolates. At the zenith the second harmonic leaves a jump of 3e-3 to 5e-3 in
    azimuth (`zenith_seam`), which is the published model's own.
    """

    zenith_seam: ClassVar[float] = 1e-2  # 3.1e-3 at 180 MHz, 5e-3 at the ends of the bands

    band: Literal["hba", "lba"] = "hba"

    def band_hz(self) -> tuple[float, float]:
        """120-240 MHz (HBA) or 10-100 MHz (LBA)."""
        _, centre, width = coefficients(self.band)
        return centre - width, centre + width

    def peak(self, at: Sampling) -> float:
        """Sum over harmonics of the larger of |p_theta|, |p_phi|, at its highest between zenith and horizon."""
        theta = np.linspace(0, np.pi / 2, 2001)[None, None, None]
        bound = sum(np.maximum(np.abs(t), np.abs(f)) for t, f in self._patterns(self._folded(at.freq_hz), theta))
        return 1.001 * float(np.max(bound))  # between the points of the grid it changes by less than 1e-3

    def rounding(self, at: Sampling) -> Float:
        """That of the polynomials, term by term (outside the band they cancel), and of the angles they are taken at."""
        table, f0, df = coefficients(self.band)
        x = float(np.abs(at.freq_hz - f0).max()) / df
        theta = np.arccos(np.clip(at.rising.lowest, 0.0, 1.0))
        size = np.abs(table).max(axis=3).sum(axis=0)  # (i, j)
        out = np.zeros(len(theta))
        for i in range(size.shape[0]):
            for j in range(size.shape[1]):
                # 16 roundings of theta; those of the azimuth act on what grows with theta, 4 turns of it
                out += size[i, j] * x**j * ((2 * i + 3 * j + 50) * theta**i + 80 * i * theta ** max(i - 1, 0))
        return UNIT * out

    def jump(self, at: Sampling) -> float:
        """What is no smooth field at the zenith: the second harmonic, 4 turns, and p_theta without p_phi, 2."""
        first, second = self._folded(at.freq_hz)[:, 0]  # (F, d) each, at theta = 0
        unlike = np.minimum(np.abs(first[:, 0] - first[:, 1]), np.abs(first[:, 0] + first[:, 1]))
        return float((4 * np.abs(second).max(axis=1) + 2 * unlike).max())

    def jones(self, at: Sampling) -> Complex:
        """J of the element, (T, F, A, S, 2, 2)."""
        folded = self._folded(at.freq_hz)
        theta = at.zenith_angle[:, None]
        cos_az, sin_az = at.azimuth_cos_sin
        c, s = np.cos(X_AZIMUTH), np.sin(X_AZIMUTH)
        cos_phi, sin_phi = (cos_az * c + sin_az * s)[:, None], (sin_az * c - cos_az * s)[:, None]
        out = np.zeros((theta.shape[0], len(at.freq_hz), *theta.shape[2:], 2, 2), complex)
        for k, (p_theta, p_phi) in enumerate(self._patterns(folded, theta)):
            cos_a, sin_a = _multiple(cos_phi, sin_phi, 2 * k + 1)
            sin_a = -sin_a if k % 2 else sin_a
            out += pack(cos_a * p_theta, -sin_a * p_phi, sin_a * p_theta, cos_a * p_phi)
        out *= (theta < np.pi / 2)[..., None, None]
        return out

    def _folded(self, freq_hz: Float) -> Complex:
        """The polynomials in theta of each channel, (k, i, F, d): those in frequency folded once."""
        table, f0, df = coefficients(self.band)
        x = (freq_hz - f0) / df
        return np.asarray(np.einsum("kijd,fj->kifd", table, x[:, None] ** np.arange(table.shape[2])))

    @staticmethod
    def _patterns(folded: Complex, theta: Float) -> list[list[Complex]]:
        """p_theta and p_phi of each harmonic at zenith angles (T, 1, A, S), by Horner: [k][d] of (T, F, A, S)."""
        found = []
        for k in range(folded.shape[0]):
            pair = []
            for d in range(2):
                terms = folded[k, :, None, :, None, None, d]
                value = terms[-1] + np.zeros_like(theta)
                for term in terms[-2::-1]:
                    value = value * theta + term
                pair.append(value)
            found.append(pair)
        return found


def _multiple(cos: Float, sin: Float, order: int) -> tuple[Float, Float]:
    """Cosine and sine of `order` (1 or 3) times an angle from those of the angle."""
    if order == 1:
        return cos, sin
    return cos * (4 * cos**2 - 3), sin * (3 - 4 * sin**2)


@cache
def coefficients(band: str) -> tuple[Complex, float, float]:
    """C[k, i, j, d] (2, 5, 5, 2), centre and half width of the band in Hz."""
    from instrument_plugins.data import table

    rows = table(f"lofar_hamaker_{band}.ecsv")
    out = np.zeros((2, 5, 5, 2), complex)
    for d, name in enumerate(("p_theta", "p_phi")):
        out[rows["k"], rows["i_theta"], rows["j_nu"], d] = rows[f"{name}_re"] + 1j * np.asarray(rows[f"{name}_im"])
    out.setflags(write=False)
    return out, float(rows.meta["freq_center_hz"]), float(rows.meta["freq_range_hz"])
