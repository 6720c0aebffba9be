"""Cases of the scatter of power spectra: the sigma that is stated, and the modes behind a taper or a hole."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from instrument.analyze.analyzer import Analyzer
from instrument.stress.case import Answer, both, case
from instrument.stress.cases_power import FREQ, cells_of, cube_of, mpc, taper_of
from instrument.units import Float


@case(
    "PS6",
    "spectra",
    "the scatter of 60 cubes of noise",
    "the sigma that is stated, each bin within 25 %, all within 4 %",
)
def scatter(_: None) -> Answer:
    """White noise behind a taper, a hole and a window over the images; cylindrical, spherical, images, crossed."""
    rows: dict[str, list[Any]] = {"c": [], "s": [], "i": [], "x": []}
    said: dict[str, list[Any]] = {"c": [], "s": [], "i": [], "x": []}
    for seed in range(60):
        rng = np.random.default_rng(seed)
        x, y = rng.normal(size=(2, 16, 14, 14))
        x[:, 3:6, 4:7] = np.nan
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            a = Analyzer(cube_of(x, FREQ[:16]))
            made: dict[str, Any] = {
                "c": a.cylindrical(bins=3, bins_par=3, taper_space="hann"),
                "s": a.spherical(bins=4),
                "i": a.spectrum_2d(bins=3, taper="hann"),
                "x": a.cylindrical(bins=3, bins_par=3, cross=cube_of(np.where(np.isnan(x), np.nan, y), FREQ[:16])),
            }
        for name, one in made.items():
            rows[name].append(one.power)
            said[name].append(one.sigma)
    answers = []
    for name in rows:
        power, sigma = np.array(rows[name]), np.array(said[name])
        ratio = power.std(axis=0) / sigma.mean(axis=0)
        use = np.isfinite(ratio)
        answers += [Answer(float(np.abs(ratio[use] - 1).max()), 0.3), Answer(abs(float(np.mean(ratio[use])) - 1), 0.1)]
    return both(*answers)


def _modes(index: Any, across: Float, along: Float) -> float:
    """Cells (N, 3) of delay, v, u squared over the sum of |correlation|^2 of all pairs, behind windows; half of it."""
    alike = np.abs(np.fft.fft2(across**2)) ** 2
    later = np.abs(np.fft.fft(along**2)) ** 2
    d, v, u = ((index[:, None, k] - index[None, :, k]) % n for k, n in enumerate((len(along), *across.shape)))
    total = (alike[v, u] / alike[0, 0] * later[d] / later[0]).sum()
    return float(len(index) ** 2 / total / 2)


@case("PS6b", "spectra", "how many modes a bin has behind a taper", "all pairs of its cells counted by hand, to 1e-3")
def modes(_: None) -> Answer:
    """A Hann window over 14 x 13 pixels, 12 channels; a cut of baselines; a wedge; the spectrum of an image."""
    from astropy import units as u

    x = np.random.default_rng(4).normal(size=(12, 14, 13))
    freq = FREQ[:12]
    cube, along = cube_of(x, freq), taper_of(12)
    hann = np.multiply.outer(*(0.5 + 0.5 * np.cos(2 * np.pi * (np.arange(n) - n // 2) / n) for n in (14, 13)))
    _p, across, par = cells_of(x, freq, hann, along)
    _z, distance, per_hz = mpc(freq)
    step = 2 * np.pi / (12 * (freq[1] - freq[0]) * per_hz)
    cut = (50.0, 190.0)
    low, high = (c * 2 * np.pi / distance for c in cut)
    disc = (across >= low) & (across <= high)
    answers = []
    flat = Analyzer(cube).cylindrical(taper_space="hann", uv_range=cut, bins=2)
    for i in range(2):
        inside = disc & (across >= flat.perp_edges[i]) & ((across < flat.perp_edges[i + 1]) | (i == 1))
        for j, m in ((0, 1), (2, 3), (5, 6)):
            index = np.argwhere(inside & (np.rint(par / step) == m))
            found = (flat.power[i, j] / flat.sigma[i, j]) ** 2
            answers.append(Answer(abs(found / _modes(index, hann, along) - 1), 1e-3))
    k = np.hypot(across, par)
    slope = distance / ((freq[0] + freq[-1]) / 2 * per_hz) * np.sin(np.deg2rad(15))
    keep = disc & (par >= 0.05) & (across * slope <= par)
    round_ = Analyzer(cube).spherical(taper_space="hann", uv_range=cut, bins=2, wedge=15 * u.deg, k_par_min=0.05)
    for i in range(2):
        top = (k < round_.edges[i + 1]) if i == 0 else (k <= round_.edges[2] * (1 + 1e-9))
        index = np.argwhere(keep & (k >= round_.edges[i] * (1 - 1e-9)) & top)
        answers.append(Answer(abs((round_.power[i] / round_.sigma[i]) ** 2 / _modes(index, hann, along) - 1), 1e-3))
    image = Analyzer(cube).spectrum_2d(taper="hann", uv_range=cut, bins=2)
    plane = across[0] * distance / mpc(freq[:1])[1]
    for i in range(2):
        ends = image.edges[i : i + 2]
        index = np.argwhere(
            (plane >= ends[0] * (1 - 1e-9)) & ((plane < ends[1]) | (i == 1)) & (plane <= image.edges[2] * (1 + 1e-9))
        )
        index = np.insert(index, 0, 0, axis=1)
        answers.append(Answer(abs((image.power[i] / image.sigma[i]) ** 2 / _modes(index, hann, np.ones(1)) - 1), 1e-3))
    return both(*answers)
