"""SelfCal: the solve is exact without noise, optimal with it, and never wrong without saying so."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

import instrument
from instrument import Chain, FeedTerm, GainTerm, InputError, JonesTable, Observation, Outcome, PointSky, Scene, SelfCal
from instrument.errors import InstrumentError

CENTRE = SkyCoord("08h13m36.0s +48d13m03s")
FEW = ["CS001HBA0", "CS003HBA1", "CS011HBA0", "CS013HBA1", "CS101HBA0", "CS302HBA1"]
FEW += ["RS106HBA", "RS205HBA", "RS406HBA", "RS508HBA"]


def model(sky=None, stations=(), slots=16, frequencies=(150,), seconds=10):
    sky = sky or instrument.load("skies", "grid", shape=(5, 5), spacing=1 * u.deg, flux=5 * u.Jy)
    observation = Observation(
        phase_centre=CENTRE, transit="2012-12-07", duration=slots * seconds * u.s, interval=seconds * u.s,
        frequencies=frequencies * u.MHz, channel_width=0.19 * u.MHz,
    )  # fmt: skip
    chosen = {"stations": list(stations)} if len(stations) else {}
    array = instrument.load("telescopes", "lofar-hba", beam=None, **chosen)
    return Scene(instrument=array, sky=sky, observation=observation).plan().run()


def errors(rms, seed=1):
    return Chain(GainTerm(rms=rms, seed=seed), FeedTerm(rms=rms, seed=seed + 1))


def rms(x):
    return float(np.sqrt(np.mean(np.abs(x) ** 2)))


def off(data, solution, truth):
    """Corrected minus model over the model, where it is not flagged."""
    corrected = data.corrected(solution.term)
    good = ~np.broadcast_to(corrected.flag, data.data.shape[:3])
    return rms((corrected.data - truth.data)[good]) / rms(truth.data[good]) if good.any() else np.nan


@pytest.mark.parametrize("size", [1e-3, 1e-2, 1e-1])
def test_full_jones_errors_are_solved_to_1e_10_without_noise(size):
    truth = model()
    data = truth.corrupted(errors(size))
    solution = SelfCal().solve(data, truth)
    solution.check()
    assert off(data, solution, truth) <= 1e-10
    assert solution.iterations.max() < 20


def test_single_precision_data_are_solved_to_their_rounding():
    truth = model()
    data = truth.corrupted(errors(1e-2))
    stored = data.with_data(data.data.astype(np.complex64).astype(complex))
    solution = SelfCal().solve(stored, truth)
    assert off(stored, solution, truth) <= 5e-8  # 3e-8 is the rounding of complex64


@pytest.mark.parametrize("pattern", ["full", "diagonal", "scalar", "phase"])
def test_each_pattern_solves_errors_of_its_kind(pattern):
    truth = model(stations=FEW)
    rng = np.random.default_rng(3)
    g = 1 + 0.2 * (rng.normal(size=(1, 1, 10, 2)) + 1j * rng.normal(size=(1, 1, 10, 2)))
    if pattern == "scalar":
        g = g[..., :1] * np.ones(2)
    if pattern == "phase":
        g = g / np.abs(g)
    term = errors(0.1) if pattern == "full" else GainTerm(values=g)
    data = truth.corrupted(term)
    solution = SelfCal(pattern=pattern).solve(data, truth)
    solution.check()
    assert off(data, solution, truth) < 1e-9
    if pattern != "full":
        assert np.abs(solution.jones[..., 0, 1]).max() == 0
    if pattern == "phase":
        assert np.abs(np.abs(solution.jones[..., 0, 0]) - 1).max() < 1e-12


def test_a_simpler_pattern_leaves_what_it_cannot_have():
    truth = model(stations=FEW)
    data = truth.corrupted(errors(1e-2))
    assert 1e-3 < off(data, SelfCal(pattern="diagonal").solve(data, truth), truth) < 3e-2


def test_gauge_of_a_model_is_its_null_space_and_comparisons_remove_it():
    where = CENTRE.spherical_offsets_by([0, 1, -1] * u.deg, [0, 1, 2] * u.deg)
    kinds = {
        "unitary matrix": (np.array([[5.0, 0, 0, 0]] * 3), 4),
        "every source of the model has the same polarization": (np.array([[5.0, 1, 0, 0]] * 3), 4),
        "one rotation": (np.array([[5.0, 1, 0, 0], [5, 2, 0, 0], [5, 0, 0, 0]]), 2),
        "the common phase": (np.array([[5.0, 1, 0, 0], [5, 0, 1, 0], [5, 0, 0, 1]]), 1),
    }
    term = errors(0.1)
    for words, (stokes, count) in kinds.items():
        truth = model(PointSky.at(where, stokes), stations=FEW)
        data = truth.corrupted(term)
        solution = SelfCal(tolerance=1e-12, iterations=2000).solve(data, truth)
        assert solution.gauge.count == count
        assert words in str(solution.gauge)
        wanted = solution.truth(term_as_table(term, data), data.at)
        raw = rms(solution.jones - wanted)
        aligned = solution.aligned(to=wanted)
        assert rms(aligned.jones - wanted) < 1e-8 < raw
        # the gauge is a freedom of the model: both correct the data alike, where the sky is that of the model
        assert off(data, solution, truth) < 1e-9
        assert off(data, aligned, truth) < 1e-9


def term_as_table(term, vis):
    values = np.broadcast_to(term.jones(vis.at)[:, :, :, 0], (len(vis.at.slots_s), 1, 10, 2, 2))
    return JonesTable(values=values, slots_s=vis.at.slots_s, freq_hz=vis.at.freq_hz)


def test_solution_is_unchanged_by_a_common_phase_of_the_data():
    truth = model(stations=FEW)
    data = truth.corrupted(errors(0.1))
    common = GainTerm(values=np.exp(0.7j) * np.ones((1, 1, 1, 2)))
    one, two = (SelfCal().solve(d, truth) for d in (data, data.corrupted(common)))
    assert np.abs(one.jones - two.jones).max() < 1e-12


def test_intervals_channels_and_weights_are_those_asked_for():
    truth = model(stations=FEW, slots=10, frequencies=(149, 150, 151))
    still = GainTerm(values=1 + 0.1j * np.arange(20).reshape(1, 1, 10, 2))
    data = truth.corrupted(still)
    solution = SelfCal(interval=40 * u.s, channels=2).solve(data, truth)
    assert solution.jones.shape == (3, 2, 10, 2, 2)  # 4 + 4 + 2 slots, 2 + 1 channels
    assert solution.term.slots_s == pytest.approx(truth.at.slots_s[0] + np.array([15.0, 55.0, 95.0]))
    assert off(data, solution, truth) < 1e-9
    wrong = np.array(data.data)
    wrong[:, :, 3] = 1e6  # a broken baseline without weight
    weight = np.ones((1, 1, data.data.shape[2]))
    weight[..., 3] = 0
    found = SelfCal(interval=40 * u.s).solve(data.with_data(wrong).weighted(weight), truth)
    assert off(data, found, truth) < 1e-9


def test_short_baselines_are_left_out_when_asked():
    truth = model(stations=FEW)
    data = truth.corrupted(errors(1e-2))
    lengths = np.linalg.norm(data.uvw_m[0], axis=-1)
    wrong = np.array(data.data)
    wrong[:, :, lengths < 1000] *= 3
    assert off(data, SelfCal(min_baseline=1 * u.km).solve(data.with_data(wrong), truth), truth) < 1e-9


def test_a_start_near_the_answer_saves_iterations():
    truth = model(stations=FEW)
    data = truth.corrupted(errors(0.3))
    cold = SelfCal().solve(data, truth)
    warm = SelfCal(start=cold.term).solve(data, truth)
    assert warm.iterations.max() <= 5 < cold.iterations.min()


@pytest.mark.parametrize("count", [40, pytest.param(100, marks=pytest.mark.long)])
def test_hard_and_hopeless_cases_are_right_or_say_so(count):
    """Starts far from the truth (rms 0.5, phases uniform in 2 pi), and models that have nothing to do with the data."""
    truth = model(stations=FEW, slots=count)
    rng = np.random.default_rng(196)
    shape = (count, 1, 10, 2, 2)
    gains = np.eye(2) + 0.5 * (rng.normal(size=shape) + 1j * rng.normal(size=shape)) * np.sqrt(0.5)
    gains[count // 2 :] *= np.exp(2j * np.pi * rng.random((count // 2, 1, 10, 1, 1)))
    far = JonesTable(values=gains, slots_s=truth.at.slots_s, freq_hz=truth.at.freq_hz)
    hard = truth.corrupted(far)
    nonsense = truth.with_data(rng.normal(size=truth.data.shape) + 1j * rng.normal(size=truth.data.shape))
    right = wrong_and_silent = 0
    for data in (hard, nonsense):
        solution = SelfCal().solve(data, truth)
        corrected = data.corrected(solution.term)
        for t in range(count):
            claimed = solution.outcome[t, 0] is Outcome.CONVERGED
            good = rms(corrected.data[t] - truth.data[t]) < 1e-6 * rms(truth.data)
            right += claimed and good
            wrong_and_silent += claimed and not good
            if not claimed:
                assert np.broadcast_to(corrected.flag, data.data.shape[:3])[t].all()
    assert wrong_and_silent == 0
    assert right >= 0.95 * count  # of those that have an answer


def test_scatter_of_gains_is_the_cramer_rao_bound_for_a_point_source():
    """Scalar gains, a source of flux S: var(Re, Im of g) = sigma^2 / (2 (A-1) S^2) each, to 1/A (two correlations)."""
    flux, count = 50.0, 20
    names = instrument.load("telescopes", "lofar-hba").stations[:count]
    truth = model(PointSky.at(CENTRE, [flux]), stations=names, slots=600)
    sigma = truth.noise_jy(2820 * u.Jy)
    noisy = truth.with_noise(2820 * u.Jy, seed=5)
    solution = SelfCal(pattern="diagonal", unexplained=1.0, tolerance=1e-8).solve(noisy, truth)
    g = np.stack([solution.jones[..., 0, 0], solution.jones[..., 1, 1]])
    g = g * np.exp(-1j * np.angle(g.mean(axis=-1, keepdims=True)))  # the phase of each receptor is a gauge
    # inverse Fisher matrix of V_ab = S g_a g_b^*, noise sigma per real part: amplitudes (D + W)^-1, phases (D - W)^+
    w = flux**2 / sigma**2 * (np.ones((count, count)) - np.eye(count))
    d = np.diag(w.sum(axis=1))
    amplitude = np.diag(np.linalg.inv(d + w)).mean()
    phase = np.diag(np.linalg.pinv(d - w)).mean()
    assert np.var(g.real) == pytest.approx(amplitude, rel=0.1)
    assert np.var(g.imag) == pytest.approx(phase, rel=0.1)


def test_dead_weak_strong_and_missing_stations():
    truth = model(stations=FEW)
    for factor in (1e-6, 1e6):
        g = np.ones((1, 1, 10, 2), complex)
        g[0, 0, 4] = factor
        data = truth.corrupted(GainTerm(values=g)).corrupted(errors(1e-2))
        solution = SelfCal().solve(data, truth)
        solution.check()
        assert off(data, solution, truth) < 1e-8
    g[0, 0, 4] = 0
    dead = truth.corrupted(GainTerm(values=g))
    solution = SelfCal().solve(dead, truth)
    corrected = dead.corrected(solution.term)
    hit = (dead.antenna1 == 4) | (dead.antenna2 == 4)
    assert corrected.flag[..., hit].all()
    assert not corrected.flag[..., ~hit].any()
    assert rms((corrected.data - truth.data)[..., ~hit, :, :]) < 1e-9 * rms(truth.data)
    missing = truth.corrupted(errors(1e-2)).flagged(hit[None, None])
    solution = SelfCal().solve(missing, truth)
    solution.check()
    assert np.isnan(solution.jones[:, :, 4]).all()
    assert off(missing, solution, truth) < 1e-9


def test_what_has_no_answer_says_why_and_is_flagged():
    truth = model(stations=FEW)
    data = truth.corrupted(errors(1e-2))
    nothing = truth.with_data(0 * truth.data)
    cases = {
        Outcome.REFUSED: (data, nothing),
        Outcome.NON_FINITE: (data, truth.with_data(truth.data * np.nan)),
        Outcome.POOR_FIT: (data, truth.with_data(np.conj(truth.data)[:, :, ::-1])),
    }
    for outcome, (d, m) in cases.items():
        solution = SelfCal(iterations=60 if outcome is Outcome.POOR_FIT else 200).solve(d, m)
        assert np.all((solution.outcome == outcome) | (solution.outcome == Outcome.ITERATION_LIMIT))
        assert solution.outcome[0, 0] in (outcome, Outcome.ITERATION_LIMIT)
        assert np.broadcast_to(d.corrected(solution.term).flag, d.data.shape[:3]).all()
        with pytest.raises(InstrumentError, match="intervals did not converge"):
            solution.check()
    weight = np.ones((16, 1, 1))
    weight[3] = 0
    solution = SelfCal().solve(data.weighted(weight), truth)
    assert solution.outcome[3, 0] is Outcome.REFUSED
    assert (solution.outcome == Outcome.CONVERGED).sum() == 15
    two = model(stations=FEW[:2])
    assert np.all(SelfCal().solve(two, two).outcome == Outcome.SINGULAR)
    broken = np.array(data.data)
    broken[2, 0, 7] = np.inf
    broken[4] = np.nan
    solution = SelfCal().solve(data.with_data(broken), truth)
    assert solution.outcome[2, 0] is Outcome.CONVERGED
    assert solution.outcome[4, 0] is Outcome.REFUSED
    with pytest.raises(InputError, match="do not pair"):
        SelfCal().solve(data, model(stations=FEW, slots=8))


def test_one_source_a_high_dynamic_range_and_a_model_wrong_by_a_factor():
    one = model(PointSky.at(CENTRE, [3.0]), stations=FEW)
    data = one.corrupted(errors(0.1))
    assert off(data, SelfCal().solve(data, one), one) < 1e-9
    where = CENTRE.spherical_offsets_by([0, 1] * u.deg, [0, 1] * u.deg)
    deep = model(PointSky.at(where, [1e8, 1.0]), stations=FEW)
    data = deep.corrupted(errors(1e-2))
    faint = model(PointSky.at(where[1:], [1.0]), stations=FEW)
    corrected = data.corrected(SelfCal(tolerance=1e-14).solve(data, deep).term)
    bright = deep.data - faint.data
    assert rms(corrected.data - bright - faint.data) < 1e-3 * rms(faint.data)
    solution = SelfCal().solve(data, deep.with_data(4 * deep.data))
    solution.check()
    assert np.abs(solution.jones).mean() == pytest.approx(
        0.5 * np.abs(SelfCal().solve(data, deep).jones).mean(), rel=1e-6
    )


def test_a_singular_true_jones_is_solved_or_refused_and_never_passed_on():
    truth = model(stations=FEW)
    j = np.zeros((1, 1, 10, 2, 2), complex) + np.eye(2)
    j[0, 0, 6] = [[1, 1], [1, 1]]
    data = truth.corrupted(JonesTable(values=j, slots_s=truth.at.slots_s[:1], freq_hz=truth.at.freq_hz))
    solution = SelfCal().solve(data, truth)
    hit = (data.antenna1 == 6) | (data.antenna2 == 6)
    corrected = data.corrected(solution.term)
    flag = np.broadcast_to(corrected.flag, data.data.shape[:3])
    assert solution.converged.sum() >= 10  # the others stop at the iteration limit, and say so
    for t in range(16):
        if solution.converged[t, 0]:
            assert not flag[t, 0, ~hit].any()
            assert rms((corrected.data - truth.data)[t, 0, ~hit]) < 1e-8 * rms(truth.data)
        else:
            assert flag[t].all()
    good = ~flag
    assert flag[solution.converged[:, 0]][..., hit].all() or rms((corrected.data - truth.data)[good]) < 1e-6 * rms(
        truth.data
    )


def test_solutions_interpolate_in_time_and_refuse_to_reach_outside():
    truth = model(stations=FEW, slots=9)
    ramp = np.eye(2) * (1 + 0.1 * np.arange(2.0)[:, None, None, None, None]) * np.ones((2, 1, 10, 1, 1))
    ends = truth.at.slots_s[[0, -1]]
    table = JonesTable(values=ramp, slots_s=ends, freq_hz=truth.at.freq_hz, interpolation="linear")
    assert table.jones(truth.at)[:, 0, 0, 0, 0, 0].real == pytest.approx(1 + 0.1 * np.linspace(0, 1, 9))
    nearest = table.with_fields(interpolation="nearest").jones(truth.at)[:, 0, 0, 0, 0, 0].real
    assert set(np.round(nearest, 6)) == {1.0, 1.1}
    later = replace(truth.at, slots_s=truth.at.slots_s + 500)
    with pytest.raises(InputError, match="outside it"):
        table.jones(later)
    half = JonesTable(values=ramp, slots_s=ends, freq_hz=truth.at.freq_hz, stations=tuple("abcdefghij"))
    with pytest.raises(InputError, match="other stations"):
        half.jones(truth.at)


def test_every_integration_is_corrected_with_its_own_interval_also_in_a_short_last_one():
    truth = model(stations=FEW, slots=8)
    steps = np.repeat([1.0, 2.0], [6, 2])  # intervals of 6 and 2
    gains = GainTerm(values=steps[:, None, None, None] * np.ones((8, 1, 10, 2)), slots_s=truth.at.slots_s)
    data = truth.corrupted(gains)
    assert off(data, SelfCal(interval=60 * u.s).solve(data, truth), truth) < 1e-9


def tangents(pattern, jones, model):
    """Derivatives of the visibilities by every real number of the gains, by central differences."""
    a, b = model.antenna1, model.antenna2
    where = [(s, k, part) for s in range(len(jones)) for k in range(2) for part in (1, 1j)]
    if pattern == "phase":
        where = [(s, k, 1j * jones[s, k, k]) for s in range(len(jones)) for k in range(2)]
    columns = []
    for s, k, part in where:
        ends = []
        for sign in (1, -1):
            moved = jones.copy()
            moved[s, k, k] += sign * 1e-6 * part
            ends.append(moved[a] @ model.data[0, 0] @ np.conj(np.swapaxes(moved[b], 1, 2)))
        columns.append(((ends[0] - ends[1]) / 2e-6).ravel())
    d = np.stack(columns, axis=1)
    return np.concatenate([d.real, d.imag])


@pytest.mark.parametrize("pattern", ["diagonal", "phase"])
def test_errors_of_gains_are_the_cramer_rao_bound_of_a_strongly_polarized_model(pattern):
    """As for an unpolarized model those of p and q were 1.2 and 0.5 times it, and 0 of phases."""
    from instrument.stress.bench import observed, points, small_array

    model = observed(small_array(8), points([2.15], [0.84], [9, 5, 2, 3]), 40)  # at the centre: the same at all times
    rng = np.random.default_rng(4)
    gains = np.exp(1j * rng.uniform(-1, 1, (8, 2))) * (1 if pattern == "phase" else rng.uniform(0.8, 1.2, (8, 2)))
    jones = gains[:, :, None] * np.eye(2)
    clean = jones[model.antenna1] @ model.data @ np.conj(np.swapaxes(jones[model.antenna2], 1, 2))
    noise = 0.01 * rng.normal(size=(*clean.shape, 2)).view(complex)[..., 0]
    found = SelfCal(pattern=pattern).solve(model.with_data(clean + noise), model)
    d = tangents(pattern, jones, model.block(slice(0, 1), slice(None)))
    bound = 0.01 * np.sqrt(np.diagonal(np.linalg.pinv(d.T @ d, rcond=1e-9)).reshape(8, 2, -1).sum(axis=2) / 2)
    said = np.sqrt((found.error**2).mean(axis=(0, 1)))[:, [0, 1], [0, 1]]
    np.testing.assert_allclose(said / bound, 1, atol=0.06)  # sigma is measured: 1 / sqrt(2 x 200) a time
