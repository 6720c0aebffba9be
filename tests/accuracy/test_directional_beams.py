"""Directions through beams: what the data hardly see is held, errors are those of noise, and the sums are the sums."""

import importlib.util
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import JonesTable, Observation, Outcome, PointSky, Scene, mat2
from instrument.calibrate.cluster_common import Common
from instrument.calibrate.cluster_data import Block, Limits
from instrument.calibrate.cluster_equations import Equations
from instrument.calibrate.cluster_errors import errors_of, normal_matrix
from instrument.calibrate.cluster_rounds import TAU, Rounds
from instrument.calibrate.directional import DirectionalCal
from instrument.calibrate.gauge import GENERATORS, UNKNOWNS

where = Path(__file__).parent / "test_directional.py"
spec = importlib.util.spec_from_file_location("laboratory", where)
lab = importlib.util.module_from_spec(spec)
spec.loader.exec_module(lab)
PATTERNS = ("full", "diagonal", "scalar", "phase")
MINUTE = DirectionalCal(interval=60 * u.s, tolerance=1e-6)


@cache
def models(stations=12, clusters=3, slots=6, channels=1):
    """One prediction per cluster through the beams of LOFAR: two sources, unpolarized."""
    names = instrument.load("telescopes", "lofar-hba", beam=None).layout().names
    chosen = [names[i] for i in np.linspace(0, len(names) - 1, stations).astype(int)]
    array = instrument.load("telescopes", "lofar-hba", beam="full", stations=chosen)
    night = Observation(
        phase_centre=lab.CENTRE, transit="2012-12-07", duration=slots * 10 * u.s, interval=10 * u.s,
        frequencies=150 + 0.19 * np.arange(channels) << u.MHz, channel_width=0.19 * u.MHz,
    )  # fmt: skip
    out = {}
    for (x, y), flux in list(zip(lab.PLACES, lab.FLUXES, strict=True))[:clusters]:
        at = lab.CENTRE.spherical_offsets_by([x, x + 0.1] * u.deg, [y, y + 0.05] * u.deg)
        sky = PointSky.at(at, flux * np.array([0.7, 0.3]))
        out[f"{flux} Jy"] = Scene(instrument=array, sky=sky, observation=night).plan().run()
    return out


def truth(sky, pattern="full", rms=0.1):
    """Matrices (A, 2, 2) of each cluster: 1 + errors of some rms."""
    out = {}
    for k, (name, m) in enumerate(sky.items()):
        drawn = np.random.default_rng(k).normal(size=(len(m.layout), 2, 2, 2)).view(complex)[..., 0]
        j = np.eye(2) + rms / np.sqrt(2) * drawn * (1 if pattern == "full" else np.eye(2))
        j = j[:, :1, :1] * np.eye(2) if pattern == "scalar" else j
        out[name] = np.where(np.eye(2), np.exp(1j * np.angle(j)), 0) if pattern == "phase" else j
    return out


def total(sky, jones):
    tables = {n: JonesTable(values=j[None, None], slots_s=[0.0], freq_hz=[1.5e8]) for n, j in jones.items()}
    return next(iter(sky.values())).with_data(sum(m.corrupted(tables[n]).data for n, m in sky.items()))


def taken(clean, clusters, pattern="full", stations=12):
    """Share of the noise that the unknowns take, as an amplitude."""
    return np.sqrt(UNKNOWNS[pattern] * stations * clusters / (8 * clean.data[..., 0, 0].size))


def wrong(solution, sky, clean):
    return lab.rms(solution.predicted(sky) - clean)


# Right -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tolerance", [1e-6, 1e-10])
def test_without_noise_the_data_are_subtracted_to_the_tolerance(tolerance):
    sky = models()
    clean = total(sky, truth(sky))
    solution = MINUTE.with_fields(tolerance=tolerance).solve(clean, sky)
    solution.check()
    assert wrong(solution, sky, clean) < tolerance * lab.rms(clean)
    assert solution["80 Jy"].iterations.max() < 30


def test_with_noise_what_the_data_hardly_see_is_named_and_the_rest_is_right():
    sky = models()
    jones = truth(sky)
    clean = total(sky, jones)
    noisy = clean.with_noise(lab.SEFD, seed=3)
    solution = MINUTE.solve(noisy, sky)
    solution.check()
    assert solution["80 Jy"].iterations.max() < 20
    assert wrong(solution, sky, clean) == pytest.approx(taken(clean, 3) * lab.rms(noisy - clean), rel=0.1)
    for name, want in jones.items():
        own = solution[name]
        assert len(own.gauge.weak) == 3 and "3 common directions are weaker than the noise" in str(own)
        errors = own.common_error[0, 0]
        assert np.isinf(errors[0]) and np.all(errors[:4] > TAU) and np.all(errors[4:] < 0.05)
        assert np.all(np.diff(errors[1:]) <= 0)
        left = own.aligned(want[None, None]).jones[0, 0] - want
        assert np.sqrt(np.mean(np.abs(left) ** 2) / 2) == pytest.approx(np.sqrt(np.mean(own.error**2)), rel=0.2)
        raw = own.jones[0, 0] - want
        assert np.sqrt(np.mean(np.abs(raw) ** 2)) < 0.1  # and the weak ones have not run away


def test_intervals_of_their_own_channels_and_robust_weights():
    sky = models(channels=2)
    clean = total(sky, truth(sky))
    noisy = clean.with_noise(lab.SEFD, seed=4)
    for settings in (
        MINUTE.with_fields(intervals={"40 Jy": 30 * u.s}, channels=2),
        MINUTE.with_fields(intervals={"80 Jy": 20 * u.s}, robust=5.0),
    ):
        solution = settings.solve(noisy, sky)
        solution.check()
        assert wrong(solution, sky, clean) < 0.6 * lab.rms(noisy - clean)
        assert all(np.isfinite(s.error).all() and np.all(s.error > 0) for s in solution.clusters.values())
        exact = settings.solve(clean, sky)
        exact.check()
        assert wrong(exact, sky, clean) < 1e-6 * lab.rms(clean)


@pytest.mark.long
@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("noise", [True, False])
def test_starts_anywhere_arrive_at_the_same(pattern, noise):
    sky = models()
    clean = total(sky, truth(sky, pattern))
    data = clean.with_noise(lab.SEFD, seed=5) if noise else clean
    found = []
    for factor in (1, 1e6, -1, 1j, 1e-6):
        start = JonesTable(values=factor * np.eye(2)[None, None, None] + 0j, slots_s=[0.0], freq_hz=[1.5e8])
        solution = MINUTE.with_fields(pattern=pattern, start=start).solve(data, sky)
        solution.check()
        found.append(wrong(solution, sky, clean))
    if not noise:
        assert max(found) < 1e-6 * lab.rms(clean)
    else:
        assert np.ptp(found) < 1e-3 * found[0]
        assert found[0] == pytest.approx(taken(clean, 3, pattern) * lab.rms(data - clean), rel=0.2)


@pytest.mark.long
def test_59_stations_are_as_wrong_as_the_unknowns_make_them():
    sky = models(stations=59, clusters=5)
    clean = total(sky, truth(sky))
    power = []
    for seed in range(20):
        noisy = clean.with_noise(lab.SEFD, seed=seed)
        solution = MINUTE.solve(noisy, sky)
        solution.check()
        power.append((wrong(solution, sky, clean) / lab.rms(noisy - clean)) ** 2)
    assert np.sqrt(np.mean(power)) == pytest.approx(taken(clean, 5, stations=59), rel=0.05)


# Errors ----------------------------------------------------------------------------------------------------------


def pulls(pattern, robust, sefd, draws):
    """Squares of errors over printed ones (draws, clusters, elements), half of both parts each."""
    sky = models()
    jones = truth(sky, pattern)
    clean = total(sky, jones)
    settings = MINUTE.with_fields(pattern=pattern, robust=robust)
    out = []
    for seed in range(draws):
        solution = settings.solve(clean.with_noise(sefd * u.Jy, seed=1000 + seed), sky)
        solution.check()
        row = []
        for name, want in jones.items():
            own = solution[name]
            left, error = own.aligned(want[None, None]).jones[0, 0] - want, own.error[0, 0]
            use = error > 0
            row.append(np.abs(left[use] / error[use]) ** 2 / 2)
        out.append(row)
    return np.array(out)


@pytest.mark.long
@pytest.mark.parametrize("pattern, robust", [(p, None) for p in PATTERNS] + [("full", 5.0), ("phase", 5.0)])
def test_pulls_of_all_gains_are_one(pattern, robust):
    """A pull of one element over 40 draws scatters by 0.08."""
    found = pulls(pattern, robust, 2820, 40)
    each = np.sqrt(found.mean(axis=0))
    assert np.all(np.abs(np.sqrt(found.mean(axis=(0, 2))) - 1) < 0.1)
    assert each.min() > 0.6 and each.max() < 1.5


@pytest.mark.long
@pytest.mark.parametrize("pattern", ["full", "diagonal"])
def test_pulls_are_one_where_a_common_direction_makes_the_errors(pattern):
    """All stations then have one error: 100 draws of 3 clusters are 300 numbers, whose mean square scatters by 0.08."""
    assert abs(pulls(pattern, None, 28.2, 100).mean() - 1) < 4 * np.sqrt(2 / 300)


def test_a_cluster_that_is_too_faint_is_said():
    sky = models()
    sky = {name: m.with_data(m.data * (1 if name == "80 Jy" else 0.02)) for name, m in sky.items()}
    clean = total(sky, truth(sky))
    solution = MINUTE.solve(clean.with_noise(lab.SEFD, seed=1), sky)
    assert "too faint" not in str(solution["80 Jy"])
    for name in ("40 Jy", "30 Jy"):
        assert solution[name].converged.all() and "too faint" in " ".join(solution[name].doubts)
        assert np.sqrt(np.mean(solution[name].error ** 2)) > 0.3


# Stiff and extreme -----------------------------------------------------------------------------------------------


def test_noise_above_the_signal_is_a_poor_fit():
    sky = models()
    clean = total(sky, truth(sky))
    solution = MINUTE.solve(clean.with_noise(2820 * 2600 * u.Jy, seed=3), sky)
    assert {o for s in solution.clusters.values() for o in s.outcome.ravel()} == {Outcome.POOR_FIT}


@pytest.mark.parametrize("kind", ["two stations", "one place", "null"])
def test_what_says_little_is_right_or_said(kind):
    sky = models()
    clean = total(sky, truth(sky))
    noisy = clean.with_noise(lab.SEFD, seed=6)
    if kind == "two stations":
        noisy = noisy.flagged(((noisy.antenna1 > 1) | (noisy.antenna2 > 1))[None, None])
    if kind == "one place":
        sky = {"a": sky["80 Jy"], "b": sky["80 Jy"]}
    if kind == "null":
        sky = {"a": sky["80 Jy"].with_data(1e-9 * sky["80 Jy"].data)}
    solution = MINUTE.with_fields(iterations=40).solve(noisy, sky)
    if kind == "null":
        assert "too faint" in str(solution)
    else:
        assert all(s.outcome[0, 0] is Outcome.SINGULAR for s in solution.clusters.values())


def test_single_integrations_are_solved():
    sky = models(stations=40, slots=1)
    clean = total(sky, truth(sky))
    noisy = clean.with_noise(lab.SEFD, seed=6)
    for data, most in ((noisy, 0.6 * lab.rms(noisy - clean)), (clean, 1e-6 * lab.rms(clean))):
        solution = MINUTE.with_fields(interval=10 * u.s).solve(data, sky)
        solution.check()
        assert wrong(solution, sky, clean) < most


# Sums ------------------------------------------------------------------------------------------------------------


def block(pattern="full", robust=None):
    """Six stations, two pieces of three samples, two clusters: one for both pieces, one for each."""
    rng = np.random.default_rng(8)
    a1, a2 = np.triu_indices(6, 1)
    draw = lambda *shape: rng.normal(size=(*shape, 2)).view(complex)[..., 0]  # noqa: E731
    return Block(
        data=draw(2, 3, len(a1), 2, 2), models=draw(2, 2, 3, len(a1), 2, 2),
        weight=rng.uniform(0.5, 2, (2, 3, len(a1))), a1=a1, a2=a2, stations=6, column=np.array([[0, 1], [0, 2]]),
        limits=Limits(pattern, 1e-6, 50, robust, 1.0),
    )  # fmt: skip


def state(pattern):
    """A block, matrices x (A, 2, K, 2) of the pattern, their equations and what they leave."""
    one = block(pattern)
    x = np.random.default_rng(9).normal(size=(6, 2, 3, 2, 2)).view(complex)[..., 0]
    x = x if pattern == "full" else x * np.eye(2)[:, None, :]
    if pattern == "scalar":
        x[:, 1, :, 1] = x[:, 0, :, 0]
    x = one.onto(x)
    z, left = one.seen(x)
    return one, x, Equations(one, x, z, one.w), left


def flat(step):
    return np.ascontiguousarray(step).reshape(-1).view(float)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_forms_of_common_directions_are_what_steps_do(pattern):
    _, x, equations, left = state(pattern)
    common, near = Common(x, pattern), Common(x[::-1], pattern)
    many = len(GENERATORS[pattern])
    steps = [common.along(y) for y in np.eye(3 * many).reshape(-1, 3, many)]
    curvature = equations.curvature(left)
    for form, does in (
        (common.seen_form(equations), equations.both),
        (common.own_form(equations), equations.own),
        (common.bent_form(curvature), lambda d: equations.bent(d, curvature)),
        (near.prior_form(common), lambda d: near.spread(near.coordinates(d))),
    ):
        want = np.array([common.against(does(d)).ravel() for d in steps])
        assert np.abs(form - want).max() < 1e-12 * np.abs(want).max()


@pytest.mark.parametrize("pattern", PATTERNS)
def test_gradient_and_second_order_are_those_of_the_cost(pattern):
    """Along a path in the pattern, by differences: f(t) = f - 2 g t + (H - bent) t^2."""
    one, x, equations, left = state(pattern)
    step = equations.within(np.random.default_rng(3).normal(size=(6, 2, 3, 2, 2)).view(complex)[..., 0])

    def cost(t):
        moved = x * np.exp(1j * t * (np.conj(x) * step).imag) if pattern == "phase" else x + t * step
        return one.cost(one.seen(moved)[1], one.w)

    h = 1e-3
    slope = (cost(h) - cost(-h)) / (2 * h)
    bend = (cost(h) - 2 * cost(0) + cost(-h)) / h**2
    gradient = np.vdot(step, equations.sums(left)).real
    second = np.vdot(step, equations.both(step) - equations.bent(step, equations.curvature(left))).real
    assert slope == pytest.approx(-2 * gradient, rel=1e-5)
    assert bend == pytest.approx(2 * second, rel=1e-5)


def test_the_normal_matrix_is_what_steps_do():
    _, x, equations, _ = state("full")
    step = np.random.default_rng(4).normal(size=(*x.shape, 2)).view(complex)[..., 0]
    matrix = normal_matrix(equations)
    assert np.abs(matrix @ flat(step) - flat(equations.both(step))).max() < 1e-12 * np.abs(matrix).max()
    assert np.abs(matrix - matrix.T).max() < 1e-13 * np.abs(matrix).max()


def test_errors_are_those_of_the_normal_matrix_as_it_stands():
    """Slow twin: (H + p W^T W)^-1 H (H + p W^T W)^-1, loose directions projected out."""
    sky = models(stations=8, clusters=2)
    clean = total(sky, truth(sky))
    noisy = clean.with_noise(lab.SEFD, seed=2)
    one = Block(
        data=noisy.data.reshape(1, -1, *noisy.data.shape[2:]),
        models=np.stack([m.data.reshape(1, -1, *noisy.data.shape[2:]) for m in sky.values()]),
        weight=np.ones((1, 6, len(noisy.antenna1))), a1=noisy.antenna1, a2=noisy.antenna2, stations=8,
        column=np.array([[0, 1]]), limits=Limits("full", 1e-6, 50, None, 0.7),
    )  # fmt: skip
    rounds = Rounds(one, np.eye(2)[None, :, None] * np.ones((8, 1, 2, 1)) + 0j)
    rounds.run()
    x = rounds.x
    found = errors_of(one, x, rounds.left, rounds.prior)
    h = normal_matrix(Equations(one, x, rounds.z, one.w))
    common = Common(x, "full")
    w = np.array([flat(common.spread(y)) for y in np.eye(16).reshape(-1, 2, 8)])
    a = np.linalg.inv(h + rounds.prior * w.T @ w)
    free = rounds.prior * np.trace(w @ a @ w.T)
    variance = one.cost(rounds.left, one.w) / (8 * one.used - one.unknowns + free)
    place = np.arange(len(h)).reshape(*x.shape, 2)
    for k in range(2):
        loose = []
        for g in found.loose[k]:
            d = np.zeros_like(x)
            d[:, :, k] = x[:, :, k] @ g
            loose.append(flat(d))
        assert len(loose) == 4
        q = np.linalg.qr(np.array(loose).T)[0]
        p = np.eye(len(h)) - q @ q.T
        want = np.sqrt(variance * np.diag(p @ a @ h @ a @ p)[place[:, :, k]].mean(axis=-1))
        assert found.gains[k] == pytest.approx(want, rel=1e-5)


def test_exponentials_of_matrices():
    from scipy.linalg import expm

    drawn = np.random.default_rng(1).normal(size=(20, 2, 2, 2)).view(complex)[..., 0]
    for size in (1.0, 1e-3, 1e-6, 0.0):
        assert (
            np.abs(mat2.exponential(size * drawn) - expm(size * drawn)).max() < 1e-13 * np.abs(expm(size * drawn)).max()
        )
    nilpotent = np.array([[0, 1], [0, 0]], complex)
    assert np.array_equal(mat2.exponential(nilpotent), np.eye(2) + nilpotent)


def test_a_solution_of_an_interval_without_weak_directions_stays_so():
    sky = models()
    own = MINUTE.solve(total(sky, truth(sky)), sky)["80 Jy"]
    assert not len(own.gauge.weak) and not own.looser and "weaker than the noise" not in str(own)
    assert replace(own).gauge is own.gauge
