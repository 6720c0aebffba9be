"""Self-calibrations that are hard to be right about, drawn at random, and a judge that knows the truth.

A case is wrong when an interval says CONVERGED and a visibility that is not flagged, corrected, differs from the true
sky by more than 1 % of the rms of the sky: on the data without noise and without interference, on every baseline, also
on those that did not count in the solve. It is said when the solution has words for it.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord

import instrument
from instrument import Composed, Observation, Outcome, PointSky, Scene, SelfCal, mat2
from instrument.observe.layout import Layout

CENTRE = SkyCoord(250 * u.deg, 50 * u.deg)
PATTERNS = ("full", "diagonal", "scalar", "phase")
WRONG = 0.01


@dataclass
class Case:
    """Data and model as the solver gets them; `clean` the data without noise and interference, `truth` the sky."""

    data: object
    model: object
    clean: object
    truth: object
    solver: object
    struck: np.ndarray | None = None  # (T, F, B): visibilities that no solution can be right about


@dataclass
class Verdict:
    """What came out of a case."""

    converged: int
    intervals: int
    worst: float  # of the intervals that converged
    said: str  # "" when nothing was said
    outcomes: dict


@cache
def array(stations, seed, beams=False):
    """An array of some stations within about 1 km; or stations of LOFAR with their beams."""
    if beams:
        names = np.array(instrument.load("telescopes", "lofar-hba", beam=None).layout().names)
        some = np.random.default_rng([stations, seed]).choice(len(names), stations, replace=False)
        return instrument.load("telescopes", "lofar-hba", stations=names[np.sort(some)].tolist(), element="hamaker")
    enu = np.random.default_rng([stations, seed]).normal(size=(stations, 3)) * [1e3, 1e3, 10]
    names = [f"s{k}" for k in range(stations)]
    place = {"longitude": 6.9 * u.deg, "latitude": 52.9 * u.deg, "height": 0 * u.m}
    return Composed(stations=Layout.from_enu(names, enu * u.m, **place))


def sky_of(rng, sources, polarized=0.3):
    """Directions and Stokes parameters of a few sources within 2 degrees, 0.1 to 10 Jy."""
    where = CENTRE.directional_offset_by(rng.uniform(0, 360, sources) * u.deg, rng.uniform(0, 2, sources) * u.deg)
    stokes = np.zeros((sources, 4))
    stokes[:, 0] = 10 ** rng.uniform(-1, 1, sources)
    stokes[:, 1:] = stokes[:, :1] * rng.uniform(-polarized, polarized, (sources, 3))
    return where, stokes


def seen(instrument, where, stokes, times=2, channels=1):
    """Visibilities of sources without any error."""
    night = Observation(
        phase_centre=CENTRE, start="2015-06-10T22:00:00", duration=times * 60 * u.s, interval=60 * u.s,
        frequencies=(150 + np.arange(channels)) * u.MHz, channel_width=1 * u.MHz,
    )  # fmt: skip
    return Scene(instrument=instrument, sky=PointSky.at(where, stokes), observation=night).plan(workers=1).run()


def jones_of(rng, pattern, shape, size=0.3, turn=np.pi):
    """Station matrices (T, F, A, 2, 2) of a pattern: errors of rms `size`, phases within +-`turn`."""
    if pattern == "full":
        j = np.eye(2) + size * rng.normal(size=(*shape, 2, 4)).view(complex) / np.sqrt(2)
        return j * np.exp(1j * rng.uniform(-turn, turn, (*shape, 1, 1)))
    g = np.exp(size * rng.normal(size=(*shape, 2)) + 1j * rng.uniform(-turn, turn, (*shape, 2)))
    g = g[..., :1] * np.ones(2) if pattern == "scalar" else g
    g = g / np.abs(g) if pattern == "phase" else g
    return g[..., None] * np.eye(2)


def put(model, jones):
    """What station matrices make of visibilities."""
    return model.with_data(mat2.sandwich(jones[:, :, model.antenna1], model.data, jones[:, :, model.antenna2]))


def noisy(rng, vis, share):
    """With noise of a share of the rms of the visibilities."""
    sigma = share * np.sqrt(np.mean(np.abs(vis.data) ** 2) / 2)
    return vis.with_data(vis.data + sigma * rng.normal(size=(*vis.data.shape, 2)).view(complex)[..., 0])


def graph(rng, kind, a, b, stations):
    """Which baselines (B,) of a kind of graph count."""
    group = np.arange(stations) % 2
    if kind == "between two groups":
        return group[a] != group[b]
    if kind == "within two groups":
        return group[a] == group[b]
    order = rng.permutation(stations)
    place = np.argsort(order)
    if kind == "tree":
        parent = {order[k]: order[rng.integers(k)] for k in range(1, stations)}
        return np.array([parent.get(i) == j or parent.get(j) == i for i, j in zip(a, b, strict=True)])
    apart = np.abs(place[a] - place[b])
    if kind == "ring":
        return (apart == 1) | (apart == stations - 1)
    if kind == "a pair cut off":
        return np.isin(place[a], (0, 1)) == np.isin(place[b], (0, 1))
    return rng.random(len(a)) < 0.5  # "half of the baselines"


GRAPHS = ("between two groups", "within two groups", "tree", "ring", "a pair cut off", "half of the baselines")
HARD = (
    *GRAPHS,
    "zero model on baselines",
    "one channel bipartite",
    "RFI x 1e3, one visibility",
    "RFI on one baseline",
    "RFI and noise",
    "amplitudes 10^(+-3)",
    "amplitudes 10^(+-6)",
    "two stations of 1e+-6",
    "dead and weak stations",
    "model lacks a source",
    "model of another sky",
    "model turned in time",
    "model not polarized",
    "model by a factor",
)
NORMAL = (
    "no noise",
    "noise",
    "noise above the signal",
    "minutes together",
    "channels together",
    "strong and weak stations, noise",
    "simpler pattern than the errors",
    "model lacks faint sources",
    "short baselines left out",
    "one source",
)


def drawn(kind, seed, beams=False):
    """One case of a kind; with beams in the model two in three skies have no polarization of their own."""
    rng = np.random.default_rng([seed, sum(map(ord, kind))])
    pattern = PATTERNS[seed % 4]
    stations = int(rng.integers(10, 15)) if kind.startswith("RFI") and seed % 3 else int(rng.integers(5, 10))
    times, channels = (2, 3) if kind in ("one channel bipartite", "channels together") else (2, 1)
    if kind == "minutes together":
        times = 6
    plain = bool(seed % 3) == beams
    where, stokes = sky_of(rng, int(rng.integers(2, 6)), 0.0 if plain else 0.3)
    if kind == "one source":
        where, stokes = where[:1], stokes[:1]
    inst = array(stations, seed % 5, beams)
    truth = seen(inst, where, stokes, times, channels)
    size = 0.3 if kind in HARD else 10 ** rng.uniform(-2.5, -0.7)
    steady = kind in ("minutes together", "channels together")
    jones = jones_of(rng, pattern, (1 if steady else times, 1 if steady else channels, stations), size)
    jones = np.broadcast_to(jones, (times, channels, stations, 2, 2)).copy()
    a, b = truth.antenna1, truth.antenna2
    data = model = clean = put(truth, jones)
    model, struck, settings = truth, None, {"pattern": pattern}
    if kind in GRAPHS:
        weight = np.broadcast_to(graph(rng, kind, a, b, stations).astype(float), truth.data.shape[:3])
        data = clean.weighted(weight)
    elif kind == "one channel bipartite":
        weight = np.ones(truth.data.shape[:3])
        weight[:, 1] = graph(rng, "between two groups", a, b, stations)
        data = clean.weighted(weight)
    elif kind == "zero model on baselines":
        zero = rng.random(len(a)) < rng.uniform(0.2, 0.8)
        model = truth.with_data(np.where(zero[:, None, None], 0.0, truth.data))
    elif kind.startswith("RFI"):
        struck = np.zeros(truth.data.shape[:3], bool)
        struck[0 if "one visibility" in kind else slice(None), 0, rng.integers(len(a))] = True
        hit = struck[..., None, None]
        level = np.sqrt(np.mean(np.abs(truth.data) ** 2))
        foreign = level * 10 ** rng.uniform(0, 6) * rng.normal(size=(*truth.data.shape, 2)).view(complex)[..., 0]
        data = clean.with_data(np.where(hit, 1e3 * clean.data if "1e3" in kind else clean.data + foreign, clean.data))
        if "noise" in kind:
            data = data.with_data(data.data + noisy(rng, clean, 0.003).data - clean.data)
    elif kind.startswith("amplitudes"):
        reach = 3 if "3" in kind else 6
        jones = jones * (10 ** rng.uniform(-reach, reach, (1, 1, stations, 1, 1)) if pattern != "phase" else 1)
        data = clean = put(truth, jones)
    elif kind.startswith("two stations"):
        if pattern != "phase":
            jones[:, :, 0] *= 1e6
            jones[:, :, 1] *= 1e-6
        data = clean = put(truth, jones)
    elif kind.startswith("dead"):
        jones[:, :, 0] = 0
        if pattern != "phase":
            jones[:, :, 1] *= 1e-9
        data = clean = put(truth, jones)
    elif kind == "model lacks a source":
        model = seen(inst, where[1:], stokes[1:], times, channels)
    elif kind == "model of another sky":
        model = seen(inst, *sky_of(rng, len(where)), times, channels)
    elif kind == "model turned in time":
        model = truth.with_data(np.conj(truth.data))
    elif kind == "model not polarized":
        stokes = stokes * [1, 0, 0, 0] if seed % 3 else stokes + stokes[:, :1] * [0, 0.2, 0, 0]
        model = seen(inst, where, stokes, times, channels)
    elif kind == "model by a factor":
        model = truth.with_data(truth.data * 10 ** rng.uniform(-6, 6))
    elif kind == "noise":
        data = noisy(rng, clean, 10 ** rng.uniform(-4, -0.5))
    elif kind == "noise above the signal":
        data, settings = noisy(rng, clean, 10 ** rng.uniform(-0.3, 0.5)), settings | {"unexplained": 1.0}
    elif kind == "minutes together":
        data, settings = noisy(rng, clean, 0.1), settings | {"interval": 180 * u.s}
    elif kind == "channels together":
        data, settings = noisy(rng, clean, 0.1), settings | {"channels": 3}
    elif kind.startswith("strong and weak"):
        data = put(truth, jones * (10 ** rng.uniform(-1.5, 1.5, (1, 1, stations, 1, 1)) if pattern != "phase" else 1))
        clean, data = data, noisy(rng, data, 10 ** rng.uniform(-3, -1))
    elif kind.startswith("simpler"):
        jones = jones_of(rng, "full", jones.shape[:3], 0.05)
        data = clean = put(truth, jones)
    elif kind == "model lacks faint sources":
        more, faint = sky_of(rng, 20)
        rest = seen(inst, more, faint * stokes[:, 0].sum() / faint[:, 0].sum() * rng.uniform(0.01, 0.3), times)
        data = clean = put(truth.with_data(truth.data + rest.data), jones)
    elif kind == "short baselines left out":
        length = np.linalg.norm(truth.uvw_m[0], axis=-1)
        settings = settings | {"min_baseline": float(np.sort(length)[len(a) // 10]) * u.m}
    return Case(data, model, clean, truth, SelfCal(**settings), struck)


def wrong(case, corrected, converged):
    """The largest error of what converged and is not flagged, over the rms of the sky."""
    flag = np.broadcast_to(corrected.flag, case.truth.data.shape[:3]).copy()
    if case.struck is not None:
        flag |= case.struck
    times, channels = flag.shape[:2]
    rows = np.arange(times) * converged.shape[0] // times
    columns = np.arange(channels) * converged.shape[1] // channels
    flag |= ~converged[np.ix_(rows, columns)][..., None]
    # where the model is zero the sky is still what it is
    wanted = np.where(case.model.data == 0, case.truth.data, case.model.data)
    off = np.abs(corrected.data - wanted).max(axis=(-2, -1))[~flag]
    return float(np.max(off, initial=0.0) / np.sqrt(np.mean(np.abs(case.model.data) ** 2)))


def judged(case):
    """Solve a case and hold the answer against the truth."""
    solution = case.solver.solve(case.data, case.model)
    worst = wrong(case, case.clean.corrected(solution.term), solution.converged)
    said = "; ".join(getattr(solution, "doubts", ()))
    names = {o.name: int((solution.outcome == o).sum()) for o in Outcome if (solution.outcome == o).any()}
    return Verdict(int(solution.converged.sum()), solution.outcome.size, worst, said, names)


def directional_rows(count):
    """Robust, noise, cases, right, wrong and silent, not converged: one visibility times 3 to 10 000."""
    import importlib.util
    from pathlib import Path

    from instrument.calibrate.directional import DirectionalCal

    path = Path(__file__).parents[1] / "accuracy/test_directional.py"
    spec = importlib.util.spec_from_file_location("laboratory", path)
    lab = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(lab)
    data, sky, _ = lab.laboratory(slots=6, stations=10, hold=6, clusters=2)
    found = {}
    for seed in range(count):
        rng = np.random.default_rng([seed, 60])
        settings = DirectionalCal(interval=60 * u.s, tolerance=1e-6, robust=5.0 if seed % 4 > 1 else None)
        before = data.with_noise(lab.SEFD, seed=seed) if seed % 2 else data
        wild = np.array(before.data)
        wild[rng.integers(6), 0, rng.integers(wild.shape[2])] *= 10 ** rng.uniform(0.5, 4)
        solution = settings.solve(before.with_data(wild), sky)
        row = found.setdefault((settings.robust is not None, bool(seed % 2)), [0, 0, 0, 0])
        row[0] += 1
        if solution["80 Jy"].outcome[0, 0] is not Outcome.CONVERGED:
            row[3] += 1
            continue
        wanted = settings.solve(before, sky).predicted(sky)
        off = lab.rms(solution.predicted(sky) - wanted) / lab.rms(data)
        row[1 if off <= WRONG else 2] += 1
    return [
        ("yes" if robust else "no", "yes" if noise else "no", *row) for (robust, noise), row in sorted(found.items())
    ]
