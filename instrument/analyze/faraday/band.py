"""What a band can see in Faraday depth: resolution, largest depth and scale, and the map between depth and k_par."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from instrument.analyze.faraday.aliases import summits
from instrument.analyze.power.fourier import comoving, line_of_sight
from instrument.checked import checked
from instrument.compiled import compiled
from instrument.errors import InputError
from instrument.numbers import unmasked
from instrument.observe.directions import LIGHT
from instrument.phasor import cis
from instrument.shown import short_repr
from instrument.units import Float, to_si

MOST = 2001  # depths of an axis that nobody asked for
STEPS = 100_000  # of the search for half height, each 0.125 over the width of the band


def number(value: Any, unit: str, name: str) -> Float:
    """Finite numbers of any shape in a unit, given bare or as a `Quantity`; raises `InputError` for others."""
    unmasked(value, name)
    out = np.asarray(to_si(value, unit, name) if getattr(value, "unit", None) is not None else value)
    wanted = "finite numbers" + (f" in {unit}" if unit else "")
    if out.dtype.kind not in "iuf":
        raise InputError(f"{name} must be {wanted}, got {type(value).__name__} of {out.dtype}")
    if not np.isfinite(out).all():
        raise InputError(f"{name} must be {wanted}, got {out[~np.isfinite(out)].flat[0]}")
    return out.astype(float)


def one(value: Any, unit: str, name: str) -> float:
    """One finite number in a unit, given bare or as a `Quantity`."""
    found = number(value, unit, name)
    if found.size != 1:
        raise InputError(f"{name} takes one value, got {found.shape}")
    return float(found.reshape(()))


@compiled(nogil=True, error_model="numpy")
def half_height(lambda2: Any, weights: Any) -> float:
    """Smallest depth where |R(phi)| = |sum w exp(-2i phi l2)| / sum w is 1/2; inf where it stays above."""
    total, mean, low, high = 0.0, 0.0, np.inf, -np.inf
    for j in range(len(lambda2)):
        if weights[j] > 0:
            total += weights[j]
            mean += weights[j] * lambda2[j]
            low, high = min(low, lambda2[j]), max(high, lambda2[j])
    if not high > low:
        return np.inf
    mean /= total
    step = 0.125 / (high - low)  # |R| changes by less than 0.25 a step
    left, right, above, below = 0.0, 0.0, 0.75, 0.0
    bracketed = False
    for i in range(STEPS + 60):
        # first steps outwards, then the secant, kept inside the bracket (Illinois)
        phi = (i + 1) * step if not bracketed else right - below * (right - left) / (below - above)
        re, im = 0.0, 0.0
        for j in range(len(lambda2)):
            if weights[j] > 0:
                c, s = cis(phi * (lambda2[j] - mean) / np.pi)
                re += weights[j] * c
                im += weights[j] * s
        excess = (re * re + im * im) / (total * total) - 0.25
        if not bracketed:
            if excess > 0:
                left, above = phi, excess
                if i == STEPS:
                    return np.inf
                continue
            right, below, bracketed = phi, excess, True
            continue
        if abs(excess) < 1e-15 or right - left < 1e-15 * right:
            return phi
        if excess > 0:
            left, above = phi, excess
            below /= 2
        else:
            right, below = phi, excess
            above /= 2
    return 0.5 * (left + right)


PerhapsNaN = Annotated[float, "NaN where it is not known"]  # no door of `checked` for it


@checked
@dataclass(frozen=True, eq=False)
class FaradayBand:
    """Figures of a band of N channels (those with weight), from lambda² in m² (N,) and weights (N,); depths in rad/m².

    `channel_m2` is the width in lambda² of the widest channel, NaN where it is not known (one channel).
    """

    __repr__ = short_repr
    lambda2: Float
    weights: Float
    channel_m2: PerhapsNaN

    @classmethod
    def of(cls, frequencies: Any, weights: Any = None, channel_width: Any = None) -> FaradayBand:
        """Of channels at frequencies with a unit (F,); those of weight 0 are left out.

        Channels are as wide as the median step between them unless `channel_width` is given with its unit, so that
        gaps do not count as wide channels.
        """
        freq = np.atleast_1d(np.asarray(to_si(frequencies, "Hz", "frequencies"), float))
        weight = np.ones(len(freq)) if weights is None else np.asarray(weights, float)
        if freq.ndim != 1 or not (freq > 0).all() or not np.isfinite(freq).all():
            raise InputError(f"frequencies = {frequencies} must be a list of finite values above 0")
        if weight.shape != freq.shape or not (weight >= 0).all() or not 0 < weight.sum() < np.inf:
            raise InputError(f"weights must be {len(freq)} finite numbers, none below 0 and not all 0")
        used = weight > 0
        steps = np.diff(np.unique(freq))
        width = to_si(channel_width, "Hz", "channel_width") if channel_width is not None else np.nan
        if channel_width is None and len(steps):
            width = float(np.median(steps))
        low = float(freq[used].min())
        if not (np.isnan(width) and channel_width is None) and not 0 < width < 2 * low:
            raise InputError(f"channel_width = {channel_width} must be above 0 and less than twice the frequency")
        extent = (LIGHT / (low - width / 2)) ** 2 - (LIGHT / (low + width / 2)) ** 2
        return cls((LIGHT / freq[used]) ** 2, weight[used], float(extent))

    @property
    def width(self) -> float:
        """Delta lambda², from the first channel to the last, m²."""
        return float(np.ptp(self.lambda2))

    @property
    def fwhm(self) -> float:
        """Full width at half maximum of |R|, solved from it; inf for one channel."""
        return 2 * float(half_height(np.ascontiguousarray(self.lambda2), np.ascontiguousarray(self.weights)))

    @property
    def fwhm_nominal(self) -> float:
        """2 sqrt 3 / Delta lambda² (Brentjens & de Bruyn 2005, eq. 61): 9 % less than the half height."""
        return 2 * float(np.sqrt(3)) / self.width if self.width else np.inf

    @property
    def fwhm_sinc(self) -> float:
        """3.8 / Delta lambda² (Schnitzeler et al. 2009): of a band evenly filled in lambda²."""
        return 3.8 / self.width if self.width else np.inf

    @property
    def phi_max(self) -> float:
        """sqrt 3 / the widest channel in lambda²: there that channel keeps sinc(sqrt 3) = 0.570; NaN if not known."""
        return float(np.sqrt(3)) / self.channel_m2

    @property
    def max_scale(self) -> float:
        """pi / the smallest lambda²: wider slabs in Faraday depth are depolarized away."""
        return float(np.pi / self.lambda2.min())

    def depths(self, first: float | None = None, last: float | None = None, most: int = MOST) -> Float:
        """An axis of depths, rad/m² (N,): steps of FWHM / 8, or a little less, from `first` to `last`.

        Without these from minus to plus the largest depth that a channel lets through, at least two FWHM, and `most`
        depths: the axis is then shorter.
        """
        step = self.fwhm / 8
        if not 0 < step < np.inf:
            raise InputError("the RMSF of this band does not come down to half: give the depths")
        if (first is None) != (last is None):
            raise InputError("give both ends of the depths, or none")
        if first is None or last is None:
            reach = np.nan_to_num(self.phi_max, nan=0.0)
            n = int(min(np.ceil(max(reach, 2 * self.fwhm) / step), (most - 1) // 2))
            return np.asarray(step * np.arange(-n, n + 1), float)
        return np.linspace(first, last, int(np.ceil((last - first) / step)) + 1)

    def aliases(self, span: float, least: float = 0.5) -> tuple[tuple[float, float], ...]:
        """Depths within `span` at which |R| comes back to `least` or more, and how high, highest first (20 at most)."""
        depth, height = summits(self.lambda2, self.weights, span, self.fwhm)
        high = [k for k in np.argsort(-height, kind="stable") if height[k] >= least][:20]
        return tuple((float(depth[k]), float(min(height[k], 1.0))) for k in high)

    def complaints(self, depths: Float) -> list[str]:
        """What is wrong with an axis of depths in this band, in words: steps or span that do not fit its RMSF."""
        out: list[str] = []
        fwhm = self.fwhm
        if len(depths) < 3 or not np.isfinite(fwhm):
            return out
        steps = np.diff(np.sort(depths))
        if np.median(steps) > fwhm / 4 * (1 + 1e-6):
            text = f"depths in steps of {np.median(steps):.4g} rad/m2, but the RMSF is {fwhm:.4g} wide (FWHM)"
            out.append(f"{text}: sources between them are missed; take steps of {fwhm / 8:.3g}")
        if 0 < np.ptp(depths) < 4 * fwhm:
            text = f"depths over {np.ptp(depths):.4g} rad/m2, {np.ptp(depths) / fwhm:.2g} times the FWHM of the RMSF"
            out.append(f"{text}, {fwhm:.4g}: peaks beyond them are not seen; this band reaches {self.phi_max:.3g}")
        return out

    def __str__(self) -> str:
        return (
            f"{len(self.lambda2)} channels, lambda² {self.lambda2.min():.4g} to {self.lambda2.max():.4g} m²: "
            f"FWHM {self.fwhm:.4g} (2 sqrt3/width {self.fwhm_nominal:.4g}, 3.8/width {self.fwhm_sinc:.4g}), "
            f"largest depth {self.phi_max:.4g}, largest scale {self.max_scale:.3g} rad/m²"
        )


def _per_depth(freq_hz: Any, cosmology: Any) -> float:
    """k_par of 1 rad/m², in 1/Mpc."""
    freq = one(freq_hz, "Hz", "freq_hz")
    if freq <= 0:
        raise InputError(f"freq_hz = {freq_hz} must be above 0")
    delay = 2 * (LIGHT / freq) ** 2 / (np.pi * freq)
    redshift, _ = comoving(freq, None, cosmology)
    return float(2 * np.pi * delay / line_of_sight(redshift, cosmology))


@checked
def k_par_of_depth(depths: Any, freq_hz: Any, cosmology: Any = None) -> Float:
    """k_parallel in 1/Mpc where emission at Faraday depths in rad/m² appears; the shape and sign of the depths.

    exp(2i phi lambda²) turns once in a frequency step of 1/delay, delay = 2 phi lambda² / (pi nu); k_par = 2 pi delay
    over the comoving Mpc per Hz. At 150 MHz 1 rad/m² is 17.0 ns and 0.0062 /Mpc (Planck15, the default).
    """
    return number(depths, "rad/m2", "depths") * _per_depth(freq_hz, cosmology)


@checked
def depth_of_k_par(k_par: Any, freq_hz: Any, cosmology: Any = None) -> Float:
    """Faraday depth in rad/m² whose emission appears at k_par in 1/Mpc: the inverse of `k_par_of_depth`."""
    return number(k_par, "1/Mpc", "k_par") / _per_depth(freq_hz, cosmology)
