"""The "do nothing" score of a foreground removal, from the truth or, without it, from the data alone.

With x the spectra of a Fourier cell (u, v), f the foreground in them, g the foreground found and T the low delays
behind a taper, score = sum |T^T (f - g)|^2 / sum |T^T f|^2: leaving the cube alone scores 1. Without f both sums are
estimated without bias. Noise of power s S in a cell (S diagonal: how it differs between channels) comes from delays
beyond 0.3 /Mpc, where no smooth foreground reaches; it may have any spatial spectrum. Then, with r = x - g,
    sum |T^T f|^2       <-  |T^T x|^2 - s tr(T^T S T)
    sum |T^T (f - g)|^2 <-  |T^T r|^2 - s tr(T^T S T) + 2 cov(T^T n, T^T g)
(Stein 1981, Ann. Statist. 9, 1135). For a fixed operator g = P x the covariance is s tr(T^T P S T). One chosen by
looking at x also fits the noise by its choice, so the covariance is measured: with a draw w of that noise,
(T^T w, T^T (g(x + e w) - g(x))) / e; with g(x + e w) in r as well this is unbiased for a noise larger by e^2 = 9 %
in power, whatever the remover does
(coupled bootstrap of Oliveira, Lei & Tibshirani 2021, arXiv:2111.09447). What of a 21-cm signal is not white over
channels counts as foreground.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from instrument.analyze.fourier import comoving, line_of_sight, taper_of
from instrument.errors import InputError
from instrument.foreground.linear import apply, covariance, one_thread
from instrument.units import Bool, Float

NOISE_FROM = 0.3  # 1/Mpc: delays beyond it hold noise
PROBES = 32  # spectra of those delays in which the noise of each cell is measured: to 18 %, their sum to far better
DRAW = 0.3  # of the noise, added to see what an adapted remover makes of it: a smaller one scatters more
UNSURE = 0.3  # of a score: a scatter beyond which a second draw is made
LEAST = 4  # delays of noise
RIDGE = 1e-2  # of the least squares for the noise of channels, towards their mean


@dataclass(frozen=True)
class Score:
    """Power of the error of a removal over that of the foreground at low delays; `value` 1 is nothing gained.

    `sigma` is the scatter of an estimate over the cells. Where the foreground is not seen above the noise `value` is a
    lower bound (`bound`): the estimated foreground was replaced by twice its scatter. `removed` is what a perfect
    removal would take away, in the power of the data at these delays.
    """

    value: float
    sigma: float
    how: str
    bound: bool
    removed: float

    @property
    def worse(self) -> bool:
        """Whether the removal is worse than doing nothing, by more than the scatter."""
        return self.value - self.sigma > 1

    @property
    def verdict(self) -> str:
        """One line in plain words."""
        if self.worse:
            return "worse than not cleaning: do not use"
        if self.bound:
            return "no foreground is seen above the noise: leave it alone"
        if self.value + self.sigma >= 1:
            return "nothing gained"
        return "of the foreground's power at these delays is left or wrong"

    def __float__(self) -> float:
        return self.value

    def __str__(self) -> str:
        value = f"{'at least ' if self.bound else ''}{self.value:.2g}"
        spread = f" +- {self.sigma:.1g}" if self.sigma and not self.bound else ""
        return f"{value}{spread}: {self.verdict} (1 = nothing gained, > 1 = worse than not cleaning; {self.how})"


def true_score(truth: Any, found: Any, freq_hz: Float, pixel_rad: float, *options: Any) -> Score:
    """Score against the true foreground; maps (C, Ny, Nx), options as in `Split.score`."""
    modes, cells = _modes(freq_hz, options[0], options[2]), _cells(freq_hz, pixel_rad, truth.shape[1:], options[1])
    lost = _powers(modes, truth - found, cells)
    all_of_it = _powers(modes, truth, cells)
    if not all_of_it.sum():
        raise InputError("the true foreground has no power at these delays: there is nothing to score")
    return Score(float(lost.sum() / all_of_it.sum()), 0.0, "against the true foreground", False, 1.0)


def estimated_score(
    maps: Any,
    found: Any,
    operator: Float | None,
    again: Callable[[Any], Any] | None,
    freq_hz: Float,
    pixel_rad: float,
    k_par: float,
    k_perp: tuple[float, float],
    taper: str | None,
    seed: int,
) -> Score:
    """Score from maps (C, Ny, Nx) alone; `again` runs an adapted remover once more, else `operator` (C, C) is it."""
    modes, cells = _modes(freq_hz, k_par, taper), _cells(freq_hz, pixel_rad, maps.shape[1:], k_perp)
    noise, scale = noise_power(maps, freq_hz)
    noise_here = noise[cells]
    level = np.trace(modes.T @ (scale[:, None] * modes))
    before = _powers(modes, maps, cells) - noise_here * level
    # |DFT|^2 of a real image: each cell of the half plane is independent
    n, spread = before.size, float(np.sqrt(before.size) * before.std())
    bound = bool(before.sum() < 2 * spread)
    total = max(float(before.sum()), 2 * spread)
    if not total > 0:
        raise InputError("the cube has no power at these delays: there is nothing to score")

    def drawn(seed: int) -> Float:
        draw = _draw(noise, scale, maps, seed)
        moved = again(maps + draw.dtype.type(DRAW) * draw) - found if again else None
        one, two = _spectra(modes, draw, cells), _spectra(modes, moved, cells)
        fitted = (one.real * two.real + one.imag * two.imag).sum(axis=0) / DRAW
        return np.asarray(_powers(modes, maps - found - moved, cells) - noise_here * level + 2 * fitted)

    def valued(left: Float) -> tuple[float, float]:
        value = float(left.sum() / total)
        return value, float(np.sqrt(n) * (left - value * before).std() / total)

    if again is None:
        assert operator is not None
        fitted = noise_here * np.trace(modes.T @ operator @ (scale[:, None] * modes))
        how = "estimated; noise fitted: trace of the operator"
        value, sigma = valued(_powers(modes, maps - found, cells) - noise_here * level + 2 * fitted)
    else:
        how = f"estimated; noise fitted: from one draw, seed {seed}"
        value, sigma = valued(left := drawn(seed))
        if sigma > UNSURE * abs(value):
            how = f"estimated; noise fitted: from two draws, seeds {seed} and {seed + 1}"
            value, sigma = valued((left + drawn(seed + 1)) / 2)
    power = float((before + noise_here * level).sum())
    return Score(max(value, 0.0), sigma, how, bound, total / power if power else 0.0)


def noise_power(maps: Any, freq_hz: Float) -> tuple[Float, Float]:
    """Noise power of every cell of the half plane (Ny, Nx // 2 + 1) and its shape over channels (C,), of mean 1.

    From delays beyond 0.3 /Mpc: the complement of what is band-limited to less (eigenvectors of sinc(2 tau (f - f'))
    above 1e-12, so channels may be uneven). Raises `InputError` where fewer than 4 are left.
    """
    from scipy.linalg import eigh

    tau = _delay(freq_hz, NOISE_FROM)
    with one_thread():
        values, vectors = eigh(np.sinc(2 * tau * (freq_hz[:, None] - freq_hz)))
    high = vectors[:, values < 1e-12 * values[-1]]
    if high.shape[1] < LEAST:
        raise InputError(f"{len(freq_hz)} channels leave {high.shape[1]} delays beyond {NOISE_FROM} /Mpc for the noise")
    quiet = high @ high.T
    found = np.diagonal(quiet @ covariance(maps) @ quiet)  # = quiet^2 shape
    mean = max(float(found.sum()) / high.shape[1], np.finfo(float).tiny)
    # these delays hardly reach the outermost channels: there the mean stands in
    even = (quiet**2).T @ quiet**2 + RIDGE * np.eye(len(quiet))
    shape = np.linalg.solve(even, (quiet**2).T @ (found / mean) + RIDGE)
    shape = np.maximum(shape, 1e-3)
    shape /= shape.mean()
    turn = np.random.default_rng(1).standard_normal((high.shape[1], min(PROBES, high.shape[1])))
    probes = high @ np.linalg.qr(turn)[0]
    gain = np.einsum("cp,c,cp->p", probes, shape, probes)
    cells = np.ones((maps.shape[1], maps.shape[2] // 2 + 1), bool)
    power = (np.abs(_spectra(probes, maps, cells)) ** 2 / gain[:, None]).mean(axis=0)
    return power.reshape(cells.shape), shape


def _delay(freq_hz: Float, k_par: float) -> float:
    """Delay in s of a wavenumber in 1/Mpc, at the middle of the band."""
    z, _ = comoving(float((freq_hz.min() + freq_hz.max()) / 2), None, None)
    return k_par * line_of_sight(z, None) / (2 * np.pi)


def _modes(freq_hz: Float, k_par: float, taper: str | None) -> Float:
    """Delays below k_par of the band's own spacing behind a taper, cosines and sines (C, m)."""
    step = np.diff(np.sort(freq_hz))
    if len(freq_hz) < 2 or not step.max(initial=0) > 0:
        raise InputError(f"{len(freq_hz)} channels have no delays: give two frequencies or more")
    spacing = step[step > 0].min()
    span = freq_hz.max() - freq_hz.min() + spacing
    n = int(np.round(span / spacing))  # channels of the band without its gaps
    at = (freq_hz - freq_hz.min()) / spacing
    # a periodic taper has its largest value at n // 2
    window = np.interp(at, np.arange(n), taper_of(n, taper)) if n < 1 << 20 else np.ones(len(at))
    count = int(np.floor(_delay(freq_hz, k_par) * span * (1 + 1e-9)))
    phase = 2 * np.pi * np.multiply.outer(at / n, np.arange(1, min(count, (n - 1) // 2) + 1))
    root2 = np.sqrt(2.0)  # a delay stands for both of its signs
    return window[:, None] * np.hstack([np.ones((len(at), 1)), root2 * np.cos(phase), root2 * np.sin(phase)])


def _cells(freq_hz: Float, pixel_rad: float, shape: tuple[int, int], k_perp: tuple[float, float]) -> Bool:
    """Cells of the half plane (Ny, Nx // 2 + 1) with k_perp strictly between two values, each line of sight once."""
    _, distance = comoving(float((freq_hz.min() + freq_hz.max()) / 2), None, None)
    ny, nx = shape
    v, u = np.fft.fftfreq(ny, pixel_rad)[:, None], np.fft.rfftfreq(nx, pixel_rad)
    k = 2 * np.pi / distance * np.hypot(v, u)
    once = (u > 0) & (u < 0.5 / pixel_rad) | (v > 0)
    inside = (k > k_perp[0]) & (k < k_perp[1]) & once
    if not inside.any():
        raise InputError(f"an image of {nx} x {ny} has no cell with k_perp between {k_perp[0]} and {k_perp[1]} /Mpc")
    return np.asarray(inside)


def _spectra(modes: Float, maps: Any, cells: Bool) -> Any:
    """Modes of the maps, transformed, in some cells (m, N)."""
    from ducc0 import fft

    found = apply(modes.T, maps)
    return np.stack([fft.r2c(image, nthreads=0)[cells] for image in found])


def _powers(modes: Float, maps: Any, cells: Bool) -> Float:
    return np.asarray((np.abs(_spectra(modes, maps, cells)) ** 2).sum(axis=0, dtype=np.float64))


def _draw(noise: Float, shape: Float, maps: Any, seed: int) -> Any:
    """Noise of a given power in every cell and shape over channels, in the precision of the maps (C, Ny, Nx)."""
    from ducc0 import fft

    rng = np.random.default_rng(seed)
    out = np.empty_like(maps)
    _, ny, nx = maps.shape
    amplitude = (np.sqrt(noise) / np.sqrt(ny * nx)).astype(maps.dtype)  # white noise of variance 1: |DFT|^2 = ny nx
    hole = ~maps.any(axis=0)
    # `noise` was seen through the holes, which take their share of it; the draw goes through them once more
    amplitude /= maps.dtype.type(np.sqrt(1 - hole.mean()))
    for image, s in zip(out, np.sqrt(shape), strict=True):
        cells = fft.r2c(rng.standard_normal((ny, nx), dtype=maps.dtype), nthreads=0) * (amplitude * maps.dtype.type(s))
        image[...] = fft.c2r(cells, lastsize=nx, forward=False, inorm=2, nthreads=0)
        image[hole] = 0
    return out
