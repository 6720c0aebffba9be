"""Leakage of 36 unpolarized sources taken out again: with the beam they were seen through, and with a wrong one.

Run: python docs/reports/aw_correction.py [exact] [wide] [wrong]

`wide` is `exact` on a grid of 1 deg, down to 10 % power of the beam and below.
"""

from __future__ import annotations

import os
import sys
import time
import warnings
from pathlib import Path

import numpy as np
from astropy import units as u

import instrument
from instrument import BeamError, ImageGrid, Imager, Observation, Scene
from instrument.analyze.sources.photometry import ForcedPhotometry
from instrument.observe.directions import LIGHT

PIXELS, PIXEL, UV = 256, 1 * u.arcmin, (30.0, 800.0)
SKY = instrument.load("skies", "grid", shape=(6, 6), spacing=30 * u.arcmin, flux=10 * u.Jy)
NIGHT = Observation(
    phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=8 * u.hour, interval=20 * u.min,
    frequencies=[150] * u.MHz,
)  # fmt: skip
LOFAR = instrument.load("telescopes", "lofar-hba")
SEEDS = range(32)
PARTS = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, 1j], [-1j, 0]]])  # of I, Q, U, V


def seen_by(telescope):
    """Visibilities within the uv range, the beam towards the centre taken out, and their plan."""
    plan = Scene(instrument=telescope, sky=SKY, observation=NIGHT).plan(uv_range=UV)
    vis = plan.run()
    return plan, vis.without_beam(telescope)


def inside(vis):
    """Visibilities within the uv range, (T, B)."""
    uv = np.linalg.norm(vis.uvw_m[..., :2], axis=-1) * float(vis.freq_hz[0]) / LIGHT
    return (uv >= UV[0]) & (uv <= UV[1])


class Joint:
    """I, Q, U, V of every source from visibilities by direct sums, with the beams of a telescope."""

    def __init__(self, telescope, vis):
        from astropy.coordinates import SkyCoord

        self.inside = inside(vis)
        at = Scene(instrument=telescope, sky=SKY, observation=NIGHT).plan().problem.at
        places = SkyCoord(at.ra_rad, at.dec_rad, unit="rad")
        jones = telescope.beam(places, vis.times, vis.freq_hz * u.Hz, at.centre.skycoord, "differential")
        self.power = (np.abs(jones) ** 2).sum((-1, -2)).mean((0, 1, 2)) / 2
        self.waves = vis.antenna1, vis.antenna2
        self.uvw = vis.uvw_m * (float(vis.freq_hz[0]) / LIGHT)
        self.lmn, self.jones = at.lmn, jones[:, 0]
        total = 0.0
        for t in range(len(self.jones)):
            m = self.matrix(t)
            total = total + (m.conj().T @ m).real
        self.normal = total
        self.condition = np.linalg.cond(total)

    def matrix(self, t):
        """Visibilities of one time (N * 4,) of each Stokes parameter of each source, (N * 4, S * 4)."""
        keep = self.inside[t]
        a, b = (p[keep] for p in self.waves)
        cycles = self.uvw[t, keep] @ self.lmn.T
        fringe = np.exp(-2j * np.pi * (cycles - np.rint(cycles)))
        one, other = self.jones[t][a], self.jones[t][b].conj()
        found = np.einsum("nsij,qjk,nslk,ns->nilsq", one, PARTS, other, fringe, optimize=True)
        return found.reshape(4 * len(a), -1)

    def fit(self, vis):
        """Stokes (S, 4) of visibilities."""
        right = 0.0
        for t in range(len(self.jones)):
            right = right + (self.matrix(t).conj().T @ vis.data[t, 0, self.inside[t]].reshape(-1)).real
        return np.linalg.solve(self.normal, right).reshape(-1, 4)

    def rights(self, many):
        """The same of many sets of visibilities at once, (sets, S, 4)."""
        right = 0.0
        for t in range(len(self.jones)):
            data = np.stack([d[t, 0, self.inside[t]].reshape(-1) for d in many], axis=1)
            right = right + (self.matrix(t).conj().T @ data).real
        return np.linalg.solve(self.normal, right).T.reshape(len(many), -1, 4)


def linear(stokes):
    """P / I, (..., S), of (..., S, 4)."""
    return np.hypot(stokes[..., 1], stokes[..., 2]) / np.abs(stokes[..., 0])


def row(*cells):
    print("| " + " | ".join(str(c) for c in cells) + " |", flush=True)


def removed(name, stokes, before, where, seconds=None):
    """A row of the first table."""
    left = linear(stokes)
    share = 100 * (1 - left[where] / before[where])
    row(
        name, f"{share.min():.4f}", f"{np.median(share):.4f}", f"{left[where].max():.1e}",
        f"{np.abs(stokes[where, 3] / stokes[where, 0]).max():.1e}", f"{np.abs(stokes[where, 0] / 10 - 1).max():.1e}",
        "" if seconds is None else f"{seconds:.0f}",
    )  # fmt: skip


def exact(tolerances=(1e-5, 1e-6)):
    plan, vis = seen_by(LOFAR)
    joint = Joint(LOFAR, vis)
    sky = instrument.PointSky.at(joint_places(plan), [[1.0, 0, 0, 0]] * 36)
    before = linear(ForcedPhotometry(uv_range=UV).measure(vis, sky).stokes_jy[0])
    where = joint.power >= 0.1
    print(f"{len(where)} sources, {int(where.sum())} at 10 % power and more, {int((joint.power >= 0.5).sum())} at "
          f"50 %; {int(inside(vis).sum())} visibilities; P/I before {before.min():.1e} to {before.max():.1e}; "
          f"condition of the joint solution {joint.condition:.2f}\n")  # fmt: skip
    row("way", "removed, %, least", "median", "left P/I, most", "V/I, most", "I wrong by", "s")
    row(*["---"] * 7)
    t0 = time.perf_counter()
    found = joint.fit(vis)
    removed("direct sums, joint at the known places", found, before, where, time.perf_counter() - t0)
    grid = ImageGrid(pixels=PIXELS, pixel=PIXEL)
    y, x = pixels_of(plan)
    mask = np.zeros((PIXELS, PIXELS), bool)
    mask[y, x] = True
    settings = {"pixels": PIXELS, "pixel": PIXEL, "uv_range": UV}
    dirty = Imager(**settings).image(vis).data[0][:, y, x].T
    removed("dirty image, nothing corrected", dirty, before, where)
    for tolerance in tolerances:
        t0 = time.perf_counter()
        operator = plan.operator(grid, tolerance)
        if tolerance == 1e-5:
            cube = instrument.BeamImager(way="normalised", **settings).image(vis, operator)
            removed(f"normalised, operator {tolerance:.0e}, image", cube.data[0][:, y, x].T, before, where,
                    time.perf_counter() - t0)  # fmt: skip
            t0 = time.perf_counter()
        imager = instrument.BeamImager(way="joint", iterations=30, mask=mask, tolerance=tolerance / 10, **settings)
        made = imager.imaged(vis, operator)
        model = made.beside["model"].data[0][:, y, x].T
        seconds = time.perf_counter() - t0
        name = f"joint, operator {tolerance:.0e}, {made.record['beam'][0]['iterations']} iterations"
        removed(f"{name}, components", model, before, where, seconds)
        removed(f"{name}, restored image", made.cube.data[0][:, y, x].T, before, where)


def wide():
    global PIXELS, SKY
    PIXELS, SKY = 384, instrument.load("skies", "grid", shape=(6, 6), spacing=60 * u.arcmin, flux=10 * u.Jy)
    exact((1e-5, 3e-6))  # 1e-6 takes a w-gridder for each of its nodes: tens of minutes


def joint_places(plan):
    from astropy.coordinates import SkyCoord

    at = plan.problem.at
    return SkyCoord(at.ra_rad, at.dec_rad, unit="rad")


def pixels_of(plan):
    """Row and column of every source: they are on centres of pixels."""
    step = float(PIXEL.to_value(u.rad))
    x, y = PIXELS // 2 - plan.problem.at.lmn[:, 0] / step, PIXELS // 2 + plan.problem.at.lmn[:, 1] / step
    assert max(np.abs(v - v.round()).max() for v in (x, y)) < 1e-3
    return y.round().astype(int), x.round().astype(int)


def wrong():
    _, vis = seen_by(LOFAR)
    joint = Joint(LOFAR, vis)
    row("stations", "drawn", "rms", "left P/I, rms over the FWHM and seeds", "of a seed", "most")
    row(*["---"] * 6)
    points = {}
    everywhere = LOFAR.layout().names
    core = [n for n in everywhere if n.startswith("CS")]  # all that have baselines within the uv range
    for names in (everywhere, core, core[::2], core[::4]):
        some = LOFAR.with_fields(stations=names)
        joint = Joint(some, seen_by(some)[1])
        for common in (False, True):
            if common and len(names) < len(everywhere):
                continue
            for rms in (0.1, 0.01):
                if rms == 0.01 and len(names) < len(everywhere):
                    continue
                made = [
                    seen_by(some.with_fields(terms=[BeamError(rms=rms, seed=k, common=common)]))[1].data for k in SEEDS
                ]
                left = linear(joint.rights(made))
                near = joint.power >= 0.5
                size = float(np.sqrt((left[:, near] ** 2).mean()))
                each = np.sqrt((left[:, near] ** 2).mean(axis=1))
                row(len(names), "once for all" if common else "per station", rms, f"{size:.3e}",
                    f"{each.min():.1e} to {each.max():.1e}", f"{left.max():.1e}")  # fmt: skip
                points[len(names), common, rms] = size, each
    for common in (False, True):
        ratio = points[59, common, 0.1][0] / points[59, common, 0.01][0]
        print(f"\n{'once for all' if common else 'per station'}: rms 0.1 over rms 0.01: {ratio:.4f}")
    most = points[48, False, 0.1][0] * np.sqrt(48)
    share = ", ".join(f"{n}: {points[n, False, 0.1][0] * np.sqrt(n) / most:.3f}" for n in (24, 12))
    print(f"\nleft times sqrt(stations), over that of 48: {share}")
    draw(points)


def draw(points):
    """Left P/I against the number of stations, and what one draw for all leaves."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    counts = np.array([12, 24, 48])
    for k, n in enumerate(counts):
        axes.plot(np.full(len(SEEDS), n), points[n, False, 0.1][1], ".", color="0.6",
                  label="each seed" if k == 0 else None)  # fmt: skip
    sizes = np.array([points[n, False, 0.1][0] for n in counts])
    axes.plot(counts, sizes, "o-", color="C0", label="drawn for each station, rms over seeds")
    axes.plot(counts, sizes[-1] * np.sqrt(48 / counts), "--", color="C0", label="1 / sqrt(stations)")
    axes.axhline(points[59, True, 0.1][0], color="C3", label="one draw for all, 59 stations")
    axes.set(xscale="log", yscale="log", xlabel="stations", ylabel="P/I left inside the FWHM")
    axes.set_xticks(counts, [str(n) for n in counts])
    axes.minorticks_off()
    axes.set_title("36 unpolarized sources corrected with a beam that is wrong by 0.1")
    axes.legend(fontsize=8)
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=130)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    asked = sys.argv[1:] or ["exact", "wrong", "wide"]  # the last changes the sky
    print(f"{os.cpu_count()} cores\n")
    for what in asked:
        {"exact": exact, "wrong": wrong, "wide": wide}[what]()
        print()
