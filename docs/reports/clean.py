"""CLEAN beside radler with the same settings and the same major cycles. Run: python docs/reports/clean.py

Needs the extra `radler`. A crowded field of 150 points, one with extended sources, and 2000 iterations timed in turn.
"""

from __future__ import annotations

import time
import warnings

import numpy as np
from astropy import units as u

import instrument
from instrument import CleanImager, ImageGrid, Observation, PointSky, Scene
from instrument.image.minor import Lobes, Search, minor_cycle
from instrument.image.radler import radler_cycle

PIXEL = 0.5 * u.arcmin
NIGHT = Observation(
    phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=8 * u.hour, interval=16 * u.min,
    frequencies=[150] * u.MHz, channel_width=0.19 * u.MHz,
)  # fmt: skip


def field(pixels, count, wide=0, seed=7):
    """Visibilities of sources on pixels, some with Q and U, `wide` of them of 6', with noise; their places and I."""
    rng = np.random.default_rng(seed)
    grid = ImageGrid(pixels=pixels, pixel=PIXEL, centre=NIGHT.phase_centre)
    y, x = rng.integers(pixels // 16, pixels - pixels // 16, (2, count))
    flux = np.minimum(0.05 * (1 - rng.uniform(size=count)) ** (-1 / 1.2), 10)
    stokes = np.zeros((count, 4))
    stokes[:, 0] = flux
    stokes[: count // 5, 1:3] = flux[: count // 5, None] * [0.2, -0.1]
    size = np.where(np.arange(count) < wide, np.deg2rad(0.1), 0.0)
    stokes[:wide, 0] = flux[:wide] = 3.0
    ra, dec = grid.at(y.astype(float), x.astype(float))
    shape = {"major_rad": size, "minor_rad": size, "angle_rad": 0 * size} if wide else {}
    sky = PointSky(names=tuple(map(str, range(count))), ra_rad=ra, dec_rad=dec, stokes_jy=stokes, **shape)
    array = instrument.load("telescopes", "lofar-hba", beam=None)
    seen = Scene(instrument=array, sky=sky, observation=NIGHT).plan(engine="matrix").run()
    return seen.with_noise(2820 * u.Jy / np.sqrt(60), seed=1), y, x, flux


def beside(name, seen, y, x, flux, **settings):
    """One row: both backends on the same visibilities."""
    made = {}
    for backend in ("own", "radler"):
        imager = CleanImager(pixel=PIXEL, uv_range=(30, 800), backend=backend, accuracy=1e-5, **settings)
        made[backend] = imager.imaged(seen)
    rms = {k: m.beside["residual"].data[0, 0].std() for k, m in made.items()}
    polarized = {k: m.beside["residual"].data[0, 1].std() for k, m in made.items()}
    fluxes = {k: m.cube.data[0, 0, y, x] for k, m in made.items()}
    bright = flux > 0.1
    ratio = np.abs(fluxes["own"] / fluxes["radler"] - 1)[bright]
    ends = {k: m.record["clean"][0] for k, m in made.items()}
    row = [
        name, *(f"{1e3 * rms[k]:.4f}" for k in rms), f"{rms['own'] / rms['radler']:.4f}",
        f"{polarized['own'] / polarized['radler']:.4f}", f"{int(bright.sum())}", f"{100 * ratio.max():.4f} %",
        f"{made['own'].beside['model'].data[0, 0].sum() / made['radler'].beside['model'].data[0, 0].sum():.5f}",
        *(f"{e['components']}, {e['ended']}" for e in ends.values()),
    ]  # fmt: skip
    print("| " + " | ".join(map(str, row)) + " |", flush=True)


def speed(pixels=480, count=2000):
    """Seconds of so many iterations of Hogbom's loop on every pixel, three times in turn."""
    rng = np.random.default_rng(0)
    uv = rng.normal(0, 0.06, (3000, 2))
    cells = np.zeros((pixels, pixels))
    for sign in (1, -1):
        place = sign * np.rint(uv[np.hypot(*uv.T) < 0.2] * pixels).astype(int)
        np.add.at(cells, (place[:, 0] % pixels, place[:, 1] % pixels), 1)
    psf = np.fft.fftshift(np.fft.ifft2(cells).real)
    psf /= psf.max()
    sky = np.zeros((pixels, pixels))
    sky[tuple(rng.integers(40, pixels - 40, (2, 150)))] = rng.pareto(1.2, 150) + 0.2
    one = np.ones((1, 1))
    search, lobes = Search(one, one[None], 0.1, np.ones((pixels, pixels), bool)), Lobes(psf[None])
    dirty = lobes.folding.back(lobes.folding.transform(sky) * lobes.response)[0][None, None]
    minor_cycle(dirty.copy(), lobes, search, 0.0, 10)
    for _ in range(3):
        begin = time.perf_counter()
        minor_cycle(dirty.copy(), lobes, search, 0.0, count)
        ours = time.perf_counter() - begin
        begin = time.perf_counter()
        radler_cycle(dirty.copy(), lobes, search, 0.0, count, 1e-4)
        theirs = time.perf_counter() - begin
        print(
            f"| {pixels} x {pixels}, {count} iterations | {ours:.3f} | {theirs:.3f} | {ours / theirs:.2f} |", flush=True
        )


def main():
    heads = (
        "field", "residual rms of I, ours, mJy", "radler", "ratio", "of Q", "sources above 0.1 Jy",
        "largest difference of restored flux", "total of the model, ratio", "ours: components, end", "radler",
    )  # fmt: skip
    print("| " + " | ".join(heads) + " |\n|" + "---|" * len(heads))
    seen = field(480, 150)
    for peaks in ("each", "joint"):
        beside(f"150 points, 480 x 480, Hogbom, {peaks}", *seen, pixels=480, peaks=peaks, cycles=6)
    seen = field(256, 10, wide=3, seed=5)
    scales = [0, 6, 12, 24] * u.arcmin
    multi = {"algorithm": "multiscale", "scales": tuple(scales), "cycles": 8}
    beside("7 points, 3 of 6', 256 x 256, multiscale", *seen, pixels=256, iterations=6000, **multi)
    print("\n| | ours, s | radler, s | ratio |\n|---|---|---|---|")
    speed()


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
