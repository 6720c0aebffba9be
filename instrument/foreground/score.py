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
in power, whatever the remover does (coupled bootstrap of Oliveira, Lei & Tibshirani 2021, arXiv:2111.09447). What a
fixed operator makes of that 9 %, e^2 s tr(T^T P S P^T T), is taken off; what it tips in the choice stays. Where that
moves more foreground than noise, g(x) stands in r and the covariance alone is drawn. What of a
21-cm signal is not white over channels counts as foreground.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from instrument.analyze.power.fourier import comoving, taper_of
from instrument.errors import InputError
from instrument.foreground.linear import apply
from instrument.foreground.noise import delay, measured_noise, spectra
from instrument.shown import short_repr
from instrument.units import Bool, Float

DRAW = 0.3  # of the noise, added to see what an adapted remover makes of it: a smaller one scatters more
UNSURE = 0.3  # of a score: a scatter beyond which a second draw is made
MOST_DRAWS = 6  # made while it is not told from 1 and the draws are what leaves it open
OWN = 8  # stream of the draws: of its seed alone a mock of noise of the same seed would be the same noise again
QUIET = 5e-3  # of a score: a smaller scatter is in none of the digits that are printed
TURNS = 1.5  # a draw that scatters more in g(x + e w) than in the covariance alone: g(x) is taken for r then
SMALL = 1e-8  # of the trace, on the diagonal of the fit to a draw: fewer pixels than channels leave it singular


@dataclass(frozen=True)
class Score:
    """Power of the error of a removal over that of the foreground at low delays; `value` 1 is nothing gained.

    `sigma` is the scatter of an estimate about the true score, over draws of the noise on the same foreground: next to
    nothing without noise. Where the foreground is not seen above the noise `value` is a lower bound (`bound`): the
    estimated foreground was replaced by twice its error. `removed` is what a perfect
    removal would take away, in the power of the data at these delays.
    """

    __repr__ = short_repr
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
        if spread and self.sigma < QUIET * self.value:
            spread += " (there is hardly any noise)"
        return f"{value}{spread}: {self.verdict} (1 = nothing gained, > 1 = worse than not cleaning; {self.how})"


@dataclass(frozen=True, eq=False)
class Cut:
    """Where a score is made: channels (C,), pixels, delays above k_par, baselines within k_perp, and the taper."""

    freq_hz: Float
    pixel_rad: float
    k_par: float
    k_perp: tuple[float, float]
    taper: str | None

    def cells(self, shape: tuple[int, int]) -> Any:
        """The cells of an image (Ny, Nx) within k_perp."""
        return _cells(self.freq_hz, self.pixel_rad, shape, self.k_perp)


def true_score(truth: Any, found: Any, cut: Cut) -> Score:
    """Score against the true foreground; maps (C, Ny, Nx)."""
    modes, cells = _modes(cut.freq_hz, cut.k_par, cut.taper), cut.cells(truth.shape[1:])
    lost = _powers(modes, truth - found, cells)
    all_of_it = _powers(modes, truth, cells)
    if not all_of_it.sum():
        raise InputError("the true foreground has no power at these delays: there is nothing to score")
    return Score(float(lost.sum() / all_of_it.sum()), 0.0, "against the true foreground", False, 1.0)


def estimated_score(
    maps: Any, found: Any, operator: Float | None, again: Callable[[Any], Any] | None, cut: Cut, seed: int
) -> Score:
    """Score from maps (C, Ny, Nx) alone; `again` runs an adapted remover once more, else `operator` (C, C) is it."""
    made = _Estimate(maps, found, operator, again, cut)
    if again is None:
        assert operator is not None
        response = made.modes.T @ operator
        how = "estimated; noise fitted: trace of the operator"
        fitted = 2 * made.noise_here * np.trace(response @ (made.scale[:, None] * made.modes))
        value, sigma, _ = made.valued(fitted, response)
    else:
        how = f"estimated; noise fitted: from one draw, seed {seed}"
        added, response = made.drawn(seed)
        value, sigma, own = made.valued(added, response)
        draws = 1
        while (
            draws < MOST_DRAWS
            and own > sigma / 2
            and ((sigma > UNSURE * abs(value) and draws < 2) or abs(value - 1) < sigma)
        ):
            added, draws = added + made.drawn(seed + draws)[0], draws + 1
            how = f"estimated; noise fitted: from {draws} draws, seeds {seed} to {seed + draws - 1}"
            value, sigma, own = made.valued(added / draws, response)
    return Score(max(value, 0.0), sigma, how, made.bound, made.total / made.power if made.power else 0.0)


class _Estimate:
    """What a score is made of: powers seen in maps (C, Ny, Nx) and left in them, the noise, and its errors."""

    def __init__(self, maps: Any, found: Any, operator: Any, again: Callable[[Any], Any] | None, cut: Cut) -> None:
        self.maps, self.found, self.operator, self.again = maps, found, operator, again
        self.modes, self.cells = _modes(cut.freq_hz, cut.k_par, cut.taper), cut.cells(maps.shape[1:])
        self.noise, self.scale, probes = measured_noise(maps, cut.freq_hz)
        self.noise_here = self.noise[self.cells]
        self.level = np.trace(self.modes.T @ (self.scale[:, None] * self.modes))
        self.seen = spectra(self.modes, maps, self.cells)
        self.left = spectra(self.modes, maps - found, self.cells)
        self.errors = _Errors(self.modes, self.scale, probes, self.noise_here, float(maps.any(axis=0).mean()))
        self.power = float(_power(self.seen).sum())
        before = self.power - float(self.noise_here.sum() * self.level)
        self.spread = self.errors.of_noise(self.seen, np.zeros((self.modes.shape[1], len(self.scale))), 0.0)
        self.bound = before < 2 * self.spread
        self.total = max(before, 2 * self.spread)
        if not self.total > 0:
            raise InputError("the cube has no power at these delays: there is nothing to score")

    def drawn(self, seed: int) -> tuple[Float, Float]:
        """Noise that the remover fitted (N,), from one draw of more of it, and the response (m, C)."""
        assert self.again is not None
        draw = _draw(self.noise, self.scale, self.maps, seed)
        moved = self.again(self.maps + draw.dtype.type(DRAW) * draw) - self.found
        response = self.modes.T @ self.operator if self.operator is not None else _response(self.modes, draw, moved)
        one, two = spectra(self.modes, draw, self.cells), spectra(self.modes, moved, self.cells)
        fitted = (one.real * two.real + one.imag * two.imag).sum(axis=0) / DRAW
        more = DRAW**2 * self.noise_here * np.trace(response @ (self.scale[:, None] * response.T))
        moving = _power(self.left - two) - _power(self.left) + 2 * fitted - more
        # a choice that turns a bright foreground: gmca, 1 mK, error of a score 20 times larger with it than without
        turns = self.errors.of_draw(moving) > TURNS * self.errors.of_draw(2 * fitted)
        return (2 * fitted if turns else moving), response

    def valued(self, added: Float, response: Float) -> tuple[float, float, float]:
        """The score, its error, and the part of that which is of the draw, of the noise that was fitted (N,)."""
        value = float((_power(self.left) - self.noise_here * self.level + added).sum() / self.total)
        own = self.errors.of_draw(added) if self.again else 0.0
        sigma = np.hypot(self.errors.of_noise(self.left - value * self.seen, response, value), own)
        # sigma^2 here is a square in `value`, whose own error adds spread^2 sigma^2 / total^2 to it, and 1 / total^2
        # is on average too large by 3 spread^2 / total^2: at 4 spreads of foreground sigma were 12 % too large
        scale = float(np.hypot(self.total, 2 * self.spread))
        return value, float(sigma) / scale, own / scale


@dataclass(frozen=True, eq=False)
class _Errors:
    """Scatter of sums over cells from the noise: modes (C, m), shape (C,), probes (C, K), noise power of a cell (N,).

    `seen` is the share of the pixels that are not holes: behind holes neighbouring cells are alike, and fewer count.
    """

    modes: Float
    shape: Float
    probes: Float
    power: Float
    seen: float

    def of_noise(self, left: Any, response: Float, value: float) -> float:
        """Error of an estimated sum |T^T (f - g)|^2 - value |T^T f|^2 for `left` = T^T (x - g - value x) (m, N).

        `response` (m, C) is T^T P, what the foreground found has of noise. With the noise n of power s S, M = T T^T,
        R = (1 - value) I - P and w^T the probes that measure s over their gain (K of them, W = sum of w w^T / K), the
        error is 2 Re n^H M (x - g - value x) - (1 - value) |T^T n|^2 less its mean as s measured in n gives it:
        2 Re n^H M R f + n^H B n, with B = M R + R^T M - (1 - value) M - tr(S [2 M R - (1 - value) M]) W,
        of variance 2 s f^H R^T M S M R f + s^2 tr (B S)^2. The first term is found from x, where it is larger by
        2 s^2 tr(M R S R^T M S): the second-order Stein formula (Bellec & Zhang 2021, Ann. Statist. 49, 1864) but for
        the turning of P itself, which counts with channels and not with cells.
        """
        t, s = self.modes, self.shape
        rest = (1 - value) * t.T - response
        inner = t.T @ (s[:, None] * t)
        probes = self.probes / np.einsum("cp,c,cp->p", self.probes, s, self.probes)
        count = probes.shape[1]
        form = t @ rest + rest.T @ t.T - (1 - value) * (t @ t.T)
        form = (form - np.trace(form * s) / count * (probes @ self.probes.T)) * s
        squares = np.trace(form @ form) - 2 * np.trace(inner @ (rest * s) @ rest.T)
        linear = np.einsum("mn,mk,kn->n", left.conj(), inner, left, optimize=True).real
        # a power from `count` exponential ones has a square too large by 1 / count
        variance = 2 * (self.power * linear).sum() + (self.power**2).sum() * squares * count / (count + 1)
        return float(np.sqrt(max(variance, 0.0) / self.seen))

    def of_draw(self, added: Float) -> float:
        """Error of the sum of what a draw adds to each cell (N,), from how it differs between them over their noise."""
        even = added - self.power * (added.sum() / self.power.sum())
        return float(np.sqrt((even**2).sum() / self.seen))


def _response(modes: Float, draw: Any, moved: Any) -> Float:
    """Modes of the foreground (m, C) that a spectrum of noise makes: the fit to how far a draw moved it, all pixels."""
    noise = draw.reshape(len(draw), -1)
    power = (noise @ noise.T).astype(float)
    moment = apply(modes.T, moved).reshape(modes.shape[1], -1) @ noise.T / DRAW
    return np.asarray(np.linalg.solve(power + SMALL * np.trace(power) * np.eye(len(power)), moment.T).T)


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
    count = int(np.floor(delay(freq_hz, k_par) * span * (1 + 1e-9)))
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


def _power(spectra: Any) -> Float:
    """Sum over modes (N,) of |spectra|^2 (m, N)."""
    return np.asarray((np.abs(spectra) ** 2).sum(axis=0, dtype=np.float64))


def _powers(modes: Float, maps: Any, cells: Bool) -> Float:
    return _power(spectra(modes, maps, cells))


def _draw(noise: Float, shape: Float, maps: Any, seed: int) -> Any:
    """Noise of a given power in every cell and shape over channels, in the precision of the maps (C, Ny, Nx)."""
    from ducc0 import fft

    rng = np.random.default_rng([OWN, seed])
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
