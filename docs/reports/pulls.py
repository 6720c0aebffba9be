"""Pulls: how far results lie from the truth, over the error that the package prints for them, as a table.

    python docs/reports/pulls.py [--draws 1000] [--areas faraday,spectra,sources,confusion]

writes docs/reports/pulls.md. A pull is the scatter of (found - true) / error over draws of noise: 1 where the error
is the scatter. Of powers in few modes, whose error goes with the power that is found, it is the scatter over the
mean error. Each area is one function `(draws, seed) -> rows`; a row is (case, what, pull).
"""

from __future__ import annotations

import argparse
import platform
import time
import warnings
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from astropy import units as u

from instrument import Analyzer, PointSky, StokesCube, __version__
from instrument.analyze.sources.leakage import leakage_of
from instrument.analyze.sources.photometry import ForcedPhotometry
from instrument.errors import InstrumentWarning
from instrument.jones.mueller import brightness
from instrument.observe.directions import lmn, offset
from instrument.phasor import station_phases
from instrument.units import unit_vectors

Row = tuple[str, str, float]
LIGHT = 299792458.0
BAND = 134e6 + 1e6 * np.arange(33)


def _cube(data, freq=BAND, pixel=3 * u.arcmin):
    return StokesCube(data, freq * u.Hz, pixel, "K")


def _screen(draws, snr, seed, freq=BAND, sigma=None, depth=7.3, angle=0.4, index=0.0):
    """`draws` lines of sight with one screen of 1 at 150 MHz and noise that leaves it `snr` sigmas; and sigma (F,)."""
    rng = np.random.default_rng(seed)
    shape = np.ones(len(freq)) if sigma is None else np.asarray(sigma, float)
    sigma = shape * np.sqrt(len(freq)) / snr
    p = (freq / 150e6) ** index * np.exp(2j * (angle + depth * (LIGHT / freq) ** 2))
    data = sigma[:, None, None, None] * rng.normal(size=(len(freq), 4, 1, draws))
    data[:, 1] += p.real[:, None, None]
    data[:, 2] += p.imag[:, None, None]
    return data, sigma


def _of_peaks(case, peaks, scale, lambda2_0, depth=7.3, angle=0.4):
    good = peaks.significant[0]

    def spread(name, off):
        return float(np.std((off / getattr(peaks, name)[0])[good]))

    turned = [np.angle(np.exp(2j * (x - t))) / 2
              for x, t in ((peaks.angle[0], angle), (peaks.angle_0[0], angle + depth * lambda2_0))]  # fmt: skip
    return [
        (case, "depth", spread("depth_error", peaks.depth[0] - depth)),
        (case, "polarized intensity", float(np.std(((peaks.polarized - scale) / peaks.noise)[0][good]))),
        (case, "angle emitted", spread("angle_error", turned[0])),
        (case, "angle at lambda0^2", spread("angle_0_error", turned[1])),
    ]


def faraday(draws: int, seed: int = 0) -> list[Row]:
    """Depth, polarized intensity and angles of one screen in a pixel."""
    rows: list[Row] = []

    def add(case, data, snr=8.0, scale=1.0, clean=False, depths=None, **settings):
        found = Analyzer(_cube(data)).rm_synthesis(depths, **settings)
        cube = found.clean(sigmas=3).cube if clean else found
        rows.extend(_of_peaks(case, cube.peaks(snr=snr), scale, found.lambda2_0))

    x = (LIGHT / BAND) ** 2
    data, _ = _screen(draws, 15, seed)
    add("even weights, noise measured, 15 sigma", data)
    add("the same, lambda0^2 = 0", data, lambda2_0=0)
    add("the same after RM-CLEAN", data, clean=True)
    data, _ = _screen(draws, 9, seed + 1)
    add("9 sigma, peaks from 5", data, snr=5.0)
    data, _ = _screen(draws, 2000, seed + 2)
    add("2000 sigma, steps of FWHM / 4", data, depths=0.53 * np.arange(-40, 41))
    sigma = np.random.default_rng(seed + 3).uniform(0.5, 2, len(BAND))
    data, real = _screen(draws, 15, seed + 4, sigma=sigma)
    add("noise differs by channel, weights 1/sigma^2, given", data, weights=1 / sigma**2, noise=real)
    add("noise differs by channel, even weights, given", data, noise=real)
    add("noise grows along the band, even weights, measured",
        _screen(draws, 15, seed + 5, sigma=np.linspace(0.5, 2, len(BAND)))[0])  # fmt: skip
    data, _ = _screen(draws, 15, seed + 6)
    add("weights of a Gaussian taper", data, weights=np.exp(-(((x - x.mean()) / 0.6) ** 2)))
    gone = np.random.default_rng(seed + 7).random((len(BAND), 1, draws)) < 0.3
    gone[:12, :, ::2] = True
    data[:, 1][gone] = np.nan
    add("a third of the voxels missing, of half the pixels also the lower third of the band", data)
    data, _ = _screen(draws, 15, seed + 8, index=-0.8)
    data[:, 0] += 2 * ((BAND / 150e6) ** -0.8)[:, None, None]
    scale = (LIGHT / np.sqrt(x.mean()) / 150e6) ** -0.8
    add("divided by the power law fitted to Stokes I", data, divide_by_i="fit", scale=scale)
    return rows


def _of_powers(case, makes: Callable[[int], list], draws: int) -> list[Row]:
    """Scatter of every bin over its mean error: the median bin, and the ones furthest off."""
    made = [makes(k) for k in range(draws)]
    rows = []
    for n in range(len(made[0])):
        power = np.array([m[n][0].ravel() for m in made])
        sigma = np.array([m[n][1].ravel() for m in made])
        with np.errstate(invalid="ignore", divide="ignore"):
            pull = power.std(axis=0) / sigma.mean(axis=0)
        pull = pull[np.isfinite(pull)]
        what = made[0][n][2]
        rows += [(case, f"{what}, median of {len(pull)} bins", float(np.median(pull)))]
        rows += [(case, f"{what}, lowest and highest bin", float(edge)) for edge in (pull.min(), pull.max())]
    return rows


def spectra(draws: int, seed: int = 0) -> list[Row]:
    """Powers of white noise in 2D, cylindrical and spherical spectra, with and without tapers, cuts and holes."""
    rows: list[Row] = []
    freq, n = BAND[:24], 24
    hole = np.hypot(*(np.indices((n, n)) - n // 2)) > 9
    for case, stokes, taper, space, holes in (
        ("no taper", "I", None, None, False),
        ("tapers along frequency and over the images", "I", "blackman-harris", "hann", False),
        ("tapers, Q + iU", "P", "blackman-harris", "hann", False),
        ("a round hole in the field, taper along frequency", "I", "blackman-harris", None, True),
    ):

        def make(k, stokes=stokes, taper=taper, space=space, holes=holes):
            data = np.random.default_rng([seed, k]).normal(size=(len(freq), 4, n, n))
            if holes:
                data[:, :, hole] = np.nan
            analyzer = Analyzer(_cube(data, freq))
            cells = analyzer.cells(stokes, taper, space)
            plane, tube, ball = (
                analyzer.spectrum_2d(stokes, taper=space, bins=6),
                cells.cylindrical(6),
                cells.spherical(8),
            )
            binned = cells.cylindrical(6, 5)
            return [
                (s.power, s.sigma, what)
                for s, what in ((plane, "2D"), (tube, "cylindrical, each delay"), (binned, "cylindrical"),
                                (ball, "spherical"))
            ]  # fmt: skip

        rows += _of_powers(case, make, draws)
    return rows


CORE = ["CS001HBA0", "CS002HBA0", "CS005HBA1", "CS011HBA0", "CS024HBA0", "CS028HBA1", "CS030HBA0", "CS103HBA1"]
BEAM = 4.5e-4  # rad, 1 / longest baseline of those in wavelengths at 150 MHz


def _field(apart, wide=0.0, minutes=40):
    """Visibilities of two sources of 3 and 2 Jy, some polarized, `apart` beams from each other; and their sky."""
    from astropy.coordinates import SkyCoord

    import instrument
    from instrument import Observation, Scene

    centre = SkyCoord("08h13m36.0s +48d13m03s")
    shape = {k: np.full(2, wide * BEAM) for k in ("major_rad", "minor_rad")} | {"angle_rad": np.zeros(2)}
    flux = np.array([[3, 0.3, 0.2, 0.1], [2, 0, 0.2, 0.1]])
    where = centre.spherical_offsets_by([0, apart * BEAM] * u.rad, [0, 0] * u.rad)
    sky = PointSky.at(where, flux, **(shape if wide else {}))
    night = Observation(
        phase_centre=centre, transit="2012-12-07", duration=8 * u.hour, interval=minutes * u.min,
        frequencies=[150] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    array = instrument.load("telescopes", "lofar-hba", beam=None, stations=CORE)
    return Scene(instrument=array, sky=sky, observation=night).plan().run(), sky


def sources(draws: int, seed: int = 0) -> list[Row]:
    """Fluxes and leakages by forced photometry, fluxes and positions by offsets, under noise of the receivers."""
    from instrument.analyze.sources.offsets import OffsetSums

    rows: list[Row] = []
    for case, apart, wide, sefd, flagged in (
        ("two sources 30 beams apart", 30, 0, 300, False),
        ("0.1 beam apart", 0.1, 0, 300, False),
        ("0.01 beam apart", 0.01, 0, 300, False),
        ("1e-4 beam apart", 1e-4, 0, 300, False),
        ("0.1 beam apart, some data flagged", 0.1, 0, 300, True),
        ("Gaussians of 5 beams, 5 beams apart", 5, 5, 300, False),
    ):
        vis, sky = _field(apart, wide)
        if flagged:
            vis = vis.flagged(np.random.default_rng(seed).random(vis.data.shape[:3]) < 0.1)
        # without a source of its own polarization in the model, all that is seen is leakage
        plain = sky.with_fields(stokes_jy=sky.stokes_jy * [1, 0, 0, 0])
        pulls, leaks = [], []
        for k in range(draws):
            fluxes = ForcedPhotometry().measure(vis.with_noise(sefd * u.Jy, seed + k), plain)
            pulls.append((fluxes.stokes_jy[0] - sky.stokes_jy) / fluxes.error_jy[0])
            leak = leakage_of(fluxes, vis.phase_centre)
            true = 100 * np.stack([np.hypot(*sky.stokes_jy[:, 1:3].T), sky.stokes_jy[:, 3]], 1) / sky.stokes_jy[:, :1]
            found = np.stack([leak.linear_percent, leak.circular_percent], 1)
            leaks.append((found - true) / leak.error_percent)
        rows += [(case, f"Stokes {s}", float(np.std(np.array(pulls)[..., n]))) for n, s in enumerate("IQUV")]
        if apart > 1 and not wide:
            rows += [(case, f"{what} leakage", float(np.std(np.array(leaks)[..., n])))
                     for n, what in enumerate(("linear", "circular"))]  # fmt: skip
    for case, apart in (("two sources 30 beams apart", 30.0), ("3 beams apart", 3.0)):
        vis, sky = _field(apart)
        sigma = vis.noise_jy(300 * u.Jy) / np.sqrt(2)  # of one part of Stokes I
        stokes = np.stack([vis.with_noise(300 * u.Jy, seed + k).stokes()[..., 0] for k in range(draws)])
        total = OffsetSums(sky, np.arange(2))
        total.add(vis, stokes)
        flux, moved, spread = total.finish()
        rows.append((case, "flux with position", float(np.std((flux - sky.stokes_jy[:, 0]) / (sigma * spread[:, 0])))))
        rows += [(case, f"position in {x}", float(np.std(moved[..., n] / (sigma * spread[:, 1 + n]))))
                 for n, x in enumerate("lm")]  # fmt: skip
    return rows


def _crowd(rng, count):
    """l, m, n - 1 of `count` places within 4 deg, and Stokes of 50 mJy in the mean, a third polarized (count, 4)."""
    r, angle = np.deg2rad(4) * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    l, m = r * np.cos(angle), r * np.sin(angle)
    stokes = rng.exponential(0.05, count)[:, None] * np.insert(rng.normal(0, 0.3, (count, 3)), 0, 1, axis=1)
    return np.stack([l, m, np.sqrt(1 - r**2) - 1], axis=1), stokes


def _seen(vis, where, stokes, gain):
    """Visibilities (T, 1, B, 2, 2) of sources (S, 4) whose apparent flux goes with the gain (T, S)."""
    z = station_phases(vis.at.uvw_m * (vis.freq_hz[0] / LIGHT), where)
    out = np.empty(vis.data.shape, complex)
    for (p, q), part in zip(np.ndindex(2, 2), np.moveaxis(brightness(stokes).reshape(-1, 4), 1, 0), strict=True):
        both = (z * (part * gain)[:, None]) @ z.conj().transpose(0, 2, 1)
        out[:, 0, :, p, q] = both[:, vis.antenna1, vis.antenna2]
    return out


CONFUSION = (  # interval in min, sources measured, SEFD in Jy, fall of the beam at 4 deg, data flagged
    ("every 40 min", 40, 2, 0, 0.0, False),
    ("every 5 min", 5, 2, 0, 0.0, False),
    ("every 1 min", 1, 2, 0, 0.0, False),
    ("every 5 min, noise of the receivers as large", 5, 2, 300, 0.0, False),
    ("every 5 min, some data flagged", 5, 2, 0, 0.0, True),
    ("every 5 min, 20 sources in a beam that falls by 30 % at 4 deg", 5, 20, 0, 0.3, False),
)


def confusion(draws: int, seed: int = 0, cases: tuple[tuple, ...] = CONFUSION) -> list[Row]:
    """Fluxes and leakages by forced photometry beside 80 sources of 50 mJy that are not in the model, within 4 deg."""
    rows: list[Row] = []
    for case, minutes, count, sefd, fall, flagged in cases:
        vis, sky = _field(30, minutes=minutes)
        if count > 2:
            where, flux = _crowd(np.random.default_rng(seed), count)
            radec = dict(zip(("ra_rad", "dec_rad"), offset(vis.phase_centre, *where[:, :2].T), strict=True))
            sky = PointSky(names=tuple(map(str, range(count))), stokes_jy=20 * flux * [1, 0.3, 0.3, 0.3], **radec)
        if flagged:
            vis = vis.flagged(np.random.default_rng(seed).random(vis.data.shape[:3]) < 0.1)
        off, leaked = _confused(draws, seed, vis, sky, sefd, fall)
        # not the scatter: what is the same in all draws is an error too
        rows += [(case, f"Stokes {s}", _rms(off[:, n])) for n, s in enumerate("IQUV")]
        rows += [(case, f"{what} leakage", _rms(leaked[:, n])) for n, what in enumerate(("linear", "circular"))]
    return rows


def _rms(values):
    return float(np.sqrt(np.mean(values**2)))


def _confused(draws, seed, vis, sky, sefd, fall):
    """Of fluxes (N, 4) and leakages (N, 2): how far they lie from the mean apparent ones, over the error printed."""
    time = np.linspace(-1, 1, len(vis.data))[:, None]

    def gain(where):
        return 1 - fall * (time * np.hypot(*where[:, :2].T) / np.deg2rad(4)) ** 2

    targets = lmn(unit_vectors(sky.ra_rad, sky.dec_rad), vis.phase_centre)
    base = _seen(vis, targets, sky.stokes_jy, gain(targets))
    true = sky.stokes_jy * gain(targets).mean(axis=0)[:, None]
    percent = 100 * np.stack([np.hypot(*true[:, 1:3].T), np.abs(true[:, 3])], 1) / true[:, :1]
    plain = sky.with_fields(stokes_jy=sky.stokes_jy * [1, 0, 0, 0])
    off, leaked = [], []
    for k in range(draws):
        where, flux = _crowd(np.random.default_rng([seed, k]), 80)
        seen = vis.with_data(base + _seen(vis, where, flux, gain(where)))
        fluxes = ForcedPhotometry().measure(seen.with_noise(sefd * u.Jy, seed + k) if sefd else seen, plain)
        off.append((fluxes.stokes_jy[0] - true) / fluxes.error_jy[0])
        leak = leakage_of(fluxes, vis.phase_centre)
        found = np.stack([leak.linear_percent, leak.circular_percent], 1)
        error = leak.error_percent
        # below that errors are not those of first order; by the true leakage, for its own value would select
        leaked.append(((found - percent) / error)[(percent > 4 * error.mean(axis=0)).all(axis=1)])
    return np.concatenate(off), np.concatenate(leaked)


SCORED = (("polynomial", 1.0), ("pca", 1.0), ("gpr", 0.4), ("gmca", 0.2))  # removers, and their share of the draws


def scores(draws: int, seed: int = 0, removers: tuple[tuple[str, float], ...] = SCORED) -> list[Row]:
    """Scores of foreground removals without the truth about the true score of each draw; fewer draws of gpr and gmca.

    Leakage of 7.1 mK, 32 x 32 x 81; where a lower bound is said no error is printed and none is counted.
    """
    import instrument
    from instrument.image.mocks import leaked, noise_cube, polarized_screens
    from instrument.sky.screens import FINE

    frequencies = np.linspace(134, 166, 81) * u.MHz
    like = leaked(polarized_screens(pixels=32, pixel=2 * u.arcmin, frequencies=frequencies, screens=FINE, seed=1))
    truth = like.with_data(like.data * np.float32(7.1e-3 / like.data[:, 0].std()))
    rows: list[Row] = []
    for name, times in removers:
        remover = instrument.load("foregrounds", name)
        for noise, shaped in ((1, False), (10, False), (30, False), (20, True)):
            found = []
            for k in range(seed, seed + max(int(times * draws), 12)):
                data = truth.data + noise_cube(like, noise * u.mK, psf_shaped=shaped, seed=k).data
                split = remover.split(like.with_data(data))
                score = split.score(seed=k)
                if not score.bound:
                    found.append((score.value - split.score(foreground=truth).value, score.sigma))
            off, sigma = np.array(found).T
            case = f"{name}, {noise} mK of noise{' of the shape of the PSF' * shaped}"
            rms = float(np.sqrt(np.mean(sigma**2)))
            rows.append((case, f"score, {len(found)} draws", float(off.std() / rms)))
            rows.append((case, "score, mean offset in sigmas (should be 0)", float(off.mean() / rms)))
    return rows


AREAS: dict[str, Callable[[int, int], list[Row]]] = {
    "faraday": faraday,
    "spectra": spectra,
    "sources": sources,
    "confusion": confusion,
    "scores": scores,
}


def main() -> None:
    """Write the table beside this file."""
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asked.add_argument("--draws", type=int, default=1000)
    asked.add_argument("--areas", default=",".join(AREAS))
    given = asked.parse_args()
    path = Path(__file__).with_suffix(".md")
    before = path.read_text(encoding="utf-8").split("\n## ")[1:] if path.is_file() else []
    parts = {text.partition("\n")[0].lower(): text.strip() for text in before}
    for name in given.areas.split(","):
        begin = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InstrumentWarning)
            rows = AREAS[name](given.draws, 0)
        said = f"{AREAS[name].__doc__.splitlines()[0]} {given.draws} draws, {time.perf_counter() - begin:.0f} s; "
        said += f"{datetime.now(UTC):%Y-%m-%d}, instrument {__version__}, numpy {np.__version__}, "
        lines = [name.capitalize(), "", f"{said}Python {platform.python_version()}.", ""]
        lines += ["| case | what | pull |", "|---|---|---|"]
        parts[name] = "\n".join(lines + [f"| {case} | {what} | {pull:.3f} |" for case, what, pull in rows])
        print(f"## {parts[name]}", flush=True)
    text = "Made by [pulls.py](pulls.py), which says what a pull is. Asked for: 0.9 to 1.1."
    sections = [f"## {parts[name]}" for name in AREAS if name in parts]
    path.write_text("\n\n".join(["# Pulls of printed errors", text, *sections]) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
