"""Stiff and extreme calibrations through the beams of LOFAR, and a judge that knows the truth.

A case ends right, or with an outcome or a sentence that says why not. Right without noise: what is predicted is off by
less than ten times the tolerance. Right with noise: it is off by what the unknowns take of the noise (Cramer-Rao),
and the printed errors are those of the gains.
"""

import warnings
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord

import instrument
from instrument import DirectionalCal, InputError, JonesTable, Observation, PointSky, Scene, SelfCal
from instrument.calibrate.reasons import FAINT

CENTRE = SkyCoord("08h13m36.0s +48d13m03s")
PLACES = [(0, 0), (2, 1), (-1.5, 2)]  # deg
FLUXES = [80, 40, 30]  # Jy
SEFD = {"SNR 0.01": 2.6e7}  # Jy; 2820 else
TOLERANCE = 1e-6
AWAY = {"start at 1e6": 1e6, "start at -1": -1.0, "start at i": 1j}
SINGLES = {"1 integration of 5 stations": 5, "1 integration of 12 stations": 12, "1 integration of 24 stations": 24}
KINDS = (
    "ordinary", "two stations", "one source", "three stations", "all polarized alike", "all polarized",
    "circularly polarized", "all in one place", "1 arcsec apart", "a cluster without flux", "a cluster of 1e-9",
    *AWAY, "islands", "between two groups", *SINGLES, "SNR 0.01", "null of both receptors", "null of one receptor",
    "null of some stations", "null of one receptor of some stations", "null of one cluster",
)  # fmt: skip


@cache
def seen(stations=12, slots=6, place=(0, 0), stokes=(80.0, 0.0, 0.0, 0.0), two=True):
    """Visibilities of one or two sources through the beams of some stations."""
    names = instrument.load("telescopes", "lofar-hba", beam=None).layout().names
    chosen = [names[i] for i in np.linspace(0, len(names) - 1, stations).astype(int)]
    array = instrument.load("telescopes", "lofar-hba", beam="full", stations=chosen)
    night = Observation(
        phase_centre=CENTRE, transit="2012-12-07", duration=slots * 10 * u.s, interval=10 * u.s,
        frequencies=[150] * u.MHz, channel_width=0.19 * u.MHz,
    )  # fmt: skip
    (x, y), share = place, np.array([[0.7], [0.3]] if two else [[1.0]])
    at = CENTRE.spherical_offsets_by([x, x + 0.1][: len(share)] * u.deg, [y, y + 0.05][: len(share)] * u.deg)
    return Scene(instrument=array, sky=PointSky.at(at, share * stokes), observation=night).plan().run()


@dataclass
class Case:
    """Data, models by cluster, the data without noise, the true matrices (A, 2, 2) of each cluster, and the solver."""

    data: object
    sky: dict
    clean: object
    jones: dict
    solver: object
    noise: float  # rms


@dataclass
class Verdict:
    """How a case ended: off without noise in the rms of the data, with noise in what Cramer and Rao allow."""

    outcome: str
    said: str
    off: float = np.nan
    squares: np.ndarray = field(default_factory=lambda: np.zeros(0))  # of pulls of gains that are not noise
    iterations: int = 0


def put(sky, jones):
    """What the matrices of each cluster make of its model, all added up."""
    tables = {n: JonesTable(values=j[None, None], slots_s=[0.0], freq_hz=[1.5e8]) for n, j in jones.items()}
    return next(iter(sky.values())).with_data(sum(m.corrupted(tables[n]).data for n, m in sky.items()))


def scaled(vis, gains):
    """A model with other beams: matrices (A, 2, 2) on both sides."""
    return vis.corrupted(JonesTable(values=gains[None, None], slots_s=[0.0], freq_hz=[1.5e8]))


def clusters(kind):
    """Models by cluster (one source each with `two` False)."""
    stations = {"two stations": 2, "three stations": 3, **SINGLES}.get(kind, 12)
    slots = 1 if kind in SINGLES else 6
    if kind == "one source":
        return {"a": seen(two=False)}
    ways = np.array([[1, 0, 0, 0]] * 3, float)
    if kind == "all polarized alike":
        ways[:, 1] = 1
    if kind == "circularly polarized":
        ways[:, 3] = 1
    if kind == "all polarized":
        ways[:, 1:] = [[1, 0, 0], [0.6, 0.8, 0], [0, 0.6, 0.8]]
    places = [(0, 0), (0, 1 / 3600), (2, 1)] if kind == "1 arcsec apart" else PLACES
    sky = {}
    for name, place, flux, way in zip("abc", places, FLUXES, ways, strict=True):
        sky[name] = seen(stations, slots, place, tuple(flux * way))
    if kind == "all in one place":
        sky["b"] = sky["a"].with_data(0.5 * sky["a"].data)
    if kind in ("a cluster without flux", "a cluster of 1e-9", "null of one cluster"):
        factor = {"a cluster without flux": 0.0, "a cluster of 1e-9": 1e-9, "null of one cluster": 1e-4}[kind]
        sky["c"] = sky["c"].with_data(factor * sky["c"].data)
    if kind.startswith("null of") and kind != "null of one cluster":
        gains = np.array([np.eye(2)] * 12, complex)
        some = slice(4) if "some" in kind else slice(None)
        gains[some] = np.diag([1, 1e-4]) if "one receptor" in kind else 1e-4 * np.eye(2)
        sky = {name: scaled(m, gains) for name, m in sky.items()}
    return sky


def case(kind, solver="self", noisy=False, seed=0, rms=0.1, **settings):
    """A case of a kind for "self" or "towards"."""
    sky = clusters(kind)
    first = next(iter(sky.values()))
    stations = len(first.layout)
    if solver == "self":
        sky = {"all": first.with_data(sum(m.data for m in sky.values()))}
    jones = {}
    for k, name in enumerate(sky):
        drawn = np.random.default_rng([k, stations]).normal(size=(stations, 2, 4)).view(complex)
        jones[name] = np.eye(2) + rms / np.sqrt(2) * drawn
    clean = put(sky, jones)
    data = clean.with_noise(SEFD.get(kind, 2820) * u.Jy, seed=seed) if noisy else clean
    noise = float(np.sqrt(np.mean(np.abs(data.data - clean.data) ** 2)))
    a, b = first.antenna1, first.antenna2
    group = np.arange(stations) % 2
    if kind == "islands":
        data = data.flagged((group[a] != group[b])[None, None])
    if kind == "between two groups":
        data = data.flagged((group[a] == group[b])[None, None])
    if kind in AWAY:
        values = AWAY[kind] * np.eye(2)[None, None, None] + 0j
        settings["start"] = JonesTable(values=values, slots_s=[0.0], freq_hz=[0.0])
    made = SelfCal if solver == "self" else DirectionalCal
    settings = {"interval": 60 * u.s, "tolerance": TOLERANCE, **settings}
    return Case(data, sky, clean, jones, made(**settings), noise)


def judged(one):
    """Solve a case and hold it against the truth; RuntimeWarnings are errors."""
    alone = isinstance(one.solver, SelfCal)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        try:
            found = one.solver.solve(one.data, one.sky["all"] if alone else one.sky)
        except InputError as error:
            return Verdict("InputError", str(error))
        said = str(found)
    by = {"all": found} if alone else found.clusters
    outcomes = sorted({o.name for s in by.values() for o in s.outcome.ravel()})
    count = max(int(s.iterations.max()) for s in by.values())
    verdict = Verdict("+".join(outcomes), said, iterations=count)
    if outcomes != ["CONVERGED"]:
        return verdict
    predicted = put(one.sky, {n: s.jones[0, 0] for n, s in by.items()})
    use = ~np.broadcast_to(predicted.flag | one.data.flag, predicted.data.shape[:3])
    apart = np.sqrt(np.mean(np.abs((predicted.data - one.clean.data)[use]) ** 2))
    verdict.off = apart / np.sqrt(np.mean(np.abs(one.clean.data[use]) ** 2))
    if one.noise:
        loose = sum(s.gauge.loose for s in by.values())  # what is held near the start takes no noise
        unknowns = 8 * len(by) * len(one.data.layout) - loose
        verdict.off = apart / one.noise / np.sqrt(unknowns / (8 * use.sum()))
        verdict.squares = np.concatenate([_pulls(s, one.jones[name]) for name, s in by.items()])
    return verdict


def _pulls(solution, truth):
    """Squares of errors over printed ones of the gains that are not noise."""
    near = (
        solution.error[0, 0] < FAINT * np.sqrt(np.mean(np.abs(solution.jones[0, 0]) ** 2, axis=(-2, -1)))[:, None, None]
    )
    left = solution.aligned(truth[None, None]).jones[0, 0] - truth
    return np.abs(left[near] / solution.error[0, 0][near]) ** 2 / 2


# How they end: whether right, and words of what is printed, of SelfCal without noise, with noise, of DirectionalCal
GROUPS, PIECES, ONE = "none inside a group", "in pieces of 6, 6", "one polarization only"
RIGHT = (True, "")
ENDS = {
    "two stations": [(False, GROUPS)] * 4,
    "islands": [(False, PIECES)] * 4,
    "between two groups": [(False, GROUPS)] * 4,
    "1 integration of 5 stations": [RIGHT] * 2 + [(False, "80 numbers do not give 120 unknowns")] * 2,
    "all polarized alike": [RIGHT] * 2 + [(False, "differ by 0.23 % of themselves")] * 2,
    "all polarized": [RIGHT] * 2 + [(False, ONE)] * 2,
    "circularly polarized": [RIGHT, (True, "are noise")] + [(False, ONE)] * 2,
    "all in one place": [RIGHT] * 2 + [(False, "'b' and 'a' differ by")] * 2,
    "1 arcsec apart": [RIGHT] * 2 + [(False, "'a' and 'b' differ by 34 % of themselves")] * 2,
    "a cluster without flux": [RIGHT] * 2 + [(False, "'c' is zero everywhere: leave it out")] * 2,
    "a cluster of 1e-9": [RIGHT] * 3 + [(True, "the cluster is too faint")],
    "null of one cluster": [RIGHT] * 3 + [(True, "the cluster is too faint")],
    "SNR 0.01": [RIGHT, (False, "noise above the signal")] * 2,
    "null of both receptors": [RIGHT, (False, "noise above the signal")] * 2,
    "null of one receptor": [(False, ONE)] * 4,
    "null of some stations": [RIGHT, (True, "are noise")] * 2,
    "null of one receptor of some stations": [RIGHT, (True, "are noise"), (False, ONE), (False, ONE)],
}


def ends(kind, solver, noisy):
    """Whether a case is right, and words that are printed."""
    return ENDS.get(kind, [RIGHT] * 4)[2 * (solver == "towards") + noisy]


def table():
    """Lines of docs/calibrating.md: how the cases end."""
    out = ["| case | SelfCal | DirectionalCal, three clusters |", "| --- | --- | --- |"]
    for kind in KINDS:
        cells = []
        for solver in ("self", "towards"):
            clean, noisy = (_cell(*ends(kind, solver, noise)) for noise in (False, True))
            cells.append(clean if clean == noisy else f"{clean}; with noise {noisy}")
        out.append(f"| {kind} | {cells[0]} | {cells[1]} |")
    return out


def _cell(right, words):
    said = f'"{words}"'
    return (f"right, said: {said}" if words else "right") if right else f"no solution: {said}"
