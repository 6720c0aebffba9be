"""Solving several directions at once: what is left after subtraction, bias, outliers, and cases that have no answer."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from scipy.optimize import least_squares

import instrument
from instrument import InputError, JonesTable, Observation, Outcome, PointSky, Scene, SelfCal
from instrument.calibrate.directional import DirectionalCal
from instrument.errors import BeamStateError
from instrument.visibilities import BeamState

CENTRE = SkyCoord("08h13m36.0s +48d13m03s")
PLACES = [(0, 0), (2, 1), (-1.5, 2), (-2, -1.8), (1.2, -2.4)]  # deg
FLUXES = [80, 40, 30, 20, 10]  # Jy
SEFD = 2820 * u.Jy


def models(slots, stations=20, clusters=5, polarized=0.0):
    """One prediction per cluster: two sources, 0.11 deg apart."""
    names = instrument.load("telescopes", "lofar-hba", beam=None).layout().names
    chosen = [names[i] for i in np.linspace(0, len(names) - 1, stations).astype(int)]
    array = instrument.load("telescopes", "lofar-hba", beam=None, stations=chosen)
    night = Observation(
        phase_centre=CENTRE, transit="2012-12-07", duration=slots * 10 * u.s, interval=10 * u.s,
        frequencies=[150] * u.MHz, channel_width=0.19 * u.MHz,
    )  # fmt: skip
    out = {}
    for (x, y), flux in list(zip(PLACES, FLUXES, strict=True))[:clusters]:
        where = CENTRE.spherical_offsets_by([x, x + 0.1] * u.deg, [y, y + 0.05] * u.deg)
        stokes = flux * np.array([[0.7, 0, 0, 0], [0.3, 0.3 * polarized, 0.2 * polarized, 0]])
        out[f"{flux} Jy"] = Scene(instrument=array, sky=PointSky.at(where, stokes), observation=night).plan().run()
    return out


def truth(model, seed, hold=1, pattern="full", rms=0.1, period_s=3600.0):
    """Matrices (T, 1, A, 2, 2) of rms error `rms`, which turn over in `period_s`, held for `hold` integrations."""
    slots, _, stations, _ = model.at.shape
    drawn = np.random.default_rng(seed).normal(size=(2, stations, 2, 2, 2)).view(complex)[..., 0]
    a, b = rms / np.sqrt(2) * drawn * (1 if pattern == "full" else np.eye(2))
    phase = 2 * np.pi / period_s * 10 * (np.arange(slots) // hold * hold)[:, None, None, None]
    return (np.eye(2) + a * np.cos(phase) + b * np.sin(phase))[:, None]


@cache
def laboratory(slots=12, stations=20, hold=1, clusters=5, pattern="full"):
    """Data, models and true matrices."""
    sky = models(slots, stations, clusters)
    jones = {name: truth(m, k, hold, pattern) for k, (name, m) in enumerate(sky.items())}
    return total(sky, jones), sky, jones


def total(sky, jones):
    parts = [
        m.corrupted(JonesTable(values=jones[name], slots_s=m.at.slots_s, freq_hz=m.freq_hz)).data
        for name, m in sky.items()
    ]
    return next(iter(sky.values())).with_data(sum(parts))


def rms(vis):
    good = ~np.broadcast_to(vis.flag, vis.data.shape[:3])
    return np.sqrt(np.mean(np.abs(vis.data[good]) ** 2))


def held(jones, count):
    """Means over intervals of `count` integrations."""
    return jones.reshape(-1, count, *jones.shape[1:]).mean(axis=1)


def error_of(solution, jones, count):
    """Rms error over stations, elements and the intervals that were solved, the gauge removed."""
    want = held(jones, count)
    return np.sqrt(np.nanmean(np.abs(solution.aligned(want).jones - want) ** 2))


# Right -----------------------------------------------------------------------------------------------------------


def test_without_noise_clusters_are_subtracted_to_rounding_even_from_single_integrations():
    """24 stations: one integration has condition number 1e6 here, and is solved nevertheless."""
    data, sky, _ = laboratory(slots=2, stations=24)
    solution = DirectionalCal().solve(data, sky)
    solution.check()
    assert rms(solution.subtracted(data, sky)) < 1e-10 * rms(data)


@pytest.mark.parametrize("pattern", ["full", "diagonal"])
def test_each_cluster_may_have_its_own_interval_and_the_last_one_be_short(pattern):
    """12 integrations, a gap and 2 more: intervals of 4, 4, 4, 2 for the first cluster, 12 and 2 for the others."""
    _, sky, _ = laboratory(slots=40, clusters=3)
    first, *others = sky
    jones = {name: truth(m, 7, 12, pattern) for name, m in sky.items()} | {first: truth(sky[first], 8, 4, pattern)}
    whole = total(sky, jones)
    rows = np.r_[:12, 36:38]
    cut = {name: pick(vis, rows) for name, vis in (sky | {"data": whole}).items()}
    data = cut.pop("data")
    settings = DirectionalCal(interval=2 * u.min, intervals={first: 40 * u.s}, pattern=pattern)
    solution = settings.solve(data, cut)
    solution.check()
    assert solution[first].jones.shape[0] == 4
    assert solution[others[0]].jones.shape[0] == 2
    assert rms(solution.subtracted(data, cut)) < 1e-10 * rms(data)


def pick(vis, rows):
    at = vis.at
    return replace(vis, data=vis.data[rows], at=replace(at, earth=at.earth[rows], slots_s=at.slots_s[rows]))


@pytest.mark.parametrize("pattern", ["scalar", "phase"])
def test_fewer_unknowns_are_solved_as_well(pattern):
    data, sky, _ = laboratory(slots=3, clusters=3)
    jones = {name: truth(m, 7, 3, "diagonal") for name, m in sky.items()}
    for name, value in jones.items():
        first = value[..., :1, :1] * np.eye(2)
        jones[name] = (
            first if pattern == "scalar" else np.where(np.eye(2), value / np.where(value, np.abs(value), 1), 0)
        )
    data = total(sky, jones)
    solution = DirectionalCal(interval=30 * u.s, pattern=pattern).solve(data, sky)
    solution.check()
    assert rms(solution.subtracted(data, sky)) < 1e-10 * rms(data)


def test_one_cluster_is_what_selfcal_solves():
    data, sky, _ = laboratory(slots=6, hold=6, clusters=1)
    noisy = data.with_noise(SEFD, seed=1)
    (model,) = sky.values()
    one = SelfCal(interval=60 * u.s).solve(noisy, model)
    two = DirectionalCal(interval=60 * u.s, tolerance=1e-10).solve(noisy, sky)["80 Jy"]
    assert np.abs(two.aligned(one.jones).jones - one.jones).max() < 1e-8
    assert two.residual == pytest.approx(one.residual, rel=1e-8)


def test_solution_is_the_least_squares_one():
    """Slow twin: scipy's Levenberg-Marquardt on all unknowns, which starts from the truth."""
    data, sky, jones = laboratory(slots=3, stations=5, hold=3, clusters=2)
    noisy = data.with_noise(SEFD, seed=2)
    solution = DirectionalCal(interval=30 * u.s, tolerance=1e-9).solve(noisy, sky)
    solution.check()

    def left(x):
        x = x.view(complex).reshape(2, 5, 2, 2)
        j1, j2 = x[:, noisy.antenna1], x[:, noisy.antenna2]
        seen = sum(
            a @ m.data[:, 0] @ np.conj(np.swapaxes(b, -1, -2)) for a, b, m in zip(j1, j2, sky.values(), strict=True)
        )
        return (noisy.data[:, 0] - seen).ravel().view(float)

    begin = np.stack([j[0, 0] for j in jones.values()]).ravel().view(float)
    best = 2 * least_squares(left, begin, xtol=1e-12, ftol=1e-12).cost
    ours = np.sum(np.abs(solution.subtracted(noisy, sky).data) ** 2)
    assert ours == pytest.approx(best, rel=1e-9)


@pytest.mark.parametrize("seeds", [range(4), pytest.param(range(4, 12), marks=pytest.mark.long)], ids=str)
@pytest.mark.parametrize("kind", ["rms 0.5", "phases"])
def test_starts_far_from_the_truth_arrive(kind, seeds):
    """Errors of rms 0.5, or phases uniform in 2 pi, others for every station and cluster; with noise."""
    sky = models(6)
    for seed in seeds:
        rng = np.random.default_rng(seed)
        jones = {}
        for k, (name, m) in enumerate(sky.items()):
            jones[name] = truth(m, 100 * seed + k, 6, rms=0.5 if kind == "rms 0.5" else 0.1)
            if kind == "phases":
                jones[name] = jones[name] * np.exp(2j * np.pi * rng.random((20, 1, 1)))
        data = total(sky, jones)
        noisy = data.with_noise(SEFD, seed=seed)
        solution = DirectionalCal(interval=60 * u.s, tolerance=1e-5).solve(noisy, sky)
        solution.check()
        assert rms(solution.predicted(sky) - data) < 0.35 * rms(noisy - data)  # 0.29 by the degrees of freedom


# Noise -----------------------------------------------------------------------------------------------------------


@cache
def noisy_night():
    """40 intervals of 60 s."""
    data, sky, jones = laboratory(slots=240)
    noisy = data.with_noise(SEFD, seed=11)
    return data, noisy, sky, jones, DirectionalCal(interval=60 * u.s, tolerance=1e-6).solve(noisy, sky)


def test_with_noise_the_rest_is_the_noise_less_what_the_unknowns_take():
    data, noisy, sky, jones, solution = noisy_night()
    solution.check()
    samples = 6 * len(noisy.antenna1) * 8
    unknowns = 5 * (20 * 8 - 4)  # a unitary matrix of each cluster is free
    noise = rms(noisy - data)
    # what the matrices turn within an interval no constant follows
    steady = {name: np.repeat(held(value, 6), 6, axis=0) for name, value in jones.items()}
    turning = rms(data - total(sky, steady)) / noise
    left = rms(solution.subtracted(noisy, sky)) / noise
    assert left == pytest.approx(np.sqrt(1 - unknowns / samples + turning**2), rel=0.01)
    assert turning < 0.2
    # the error of the prediction is what the unknowns took
    wrong = rms(solution.predicted(sky) - data) / noise
    assert wrong == pytest.approx(np.sqrt(unknowns / samples + turning**2), rel=0.02)


def test_solved_matrices_are_unbiased():
    """Mean error of each element over the intervals in units of its standard error, squared, over all stations."""
    _, _, _, jones, solution = noisy_night()
    for name, value in jones.items():
        want = held(value, 6)
        error = (solution[name].aligned(want).jones - want).reshape(len(want), -1).view(float)
        count = len(error)
        t2 = count * error.mean(axis=0) ** 2 / error.var(axis=0, ddof=1)
        # t^2 of `count` intervals follows F(1, count - 1)
        mean = (count - 1) / (count - 3)
        spread = mean * np.sqrt(2 * (count - 2) / (count - 5) / t2.size)
        assert abs(t2.mean() - mean) < 3 * spread, name


def test_more_is_left_above_the_noise_by_a_solve_for_one_direction():
    data, noisy, sky, _, solution = noisy_night()
    model = data.with_data(sum(m.data for m in sky.values()))
    one = SelfCal(interval=60 * u.s, tolerance=1e-6).solve(noisy, model)
    apart = [rms(p - data) for p in (model.corrupted(one.term), solution.predicted(sky))]
    assert apart[0] > 5 * apart[1]


def test_robust_weights_hold_against_interference():
    """1 % of the visibilities with 100 Jy of interference: as good as without it; a plain solve says what spoils it."""
    data, sky, jones = laboratory(slots=24)
    noisy = data.with_noise(SEFD, seed=11)
    rng = np.random.default_rng(5)
    hit = rng.random(noisy.data.shape[:3])[..., None, None] < 0.01
    struck = noisy.with_data(noisy.data + 100 * hit * rng.normal(size=(*noisy.data.shape, 2)).view(complex)[..., 0])
    settings = DirectionalCal(interval=60 * u.s, tolerance=1e-5)
    clean, plain = settings.solve(noisy, sky), settings.solve(struck, sky)
    robust = settings.with_fields(robust=5).solve(struck, sky)
    robust.check()
    # plain is some 5 times worse than robust, and no interval passes for right
    assert not plain["80 Jy"].converged.any()
    assert "stand out" in str(plain["80 Jy"])
    again = settings.solve(struck.flagged(plain["80 Jy"].suspects), sky)
    for name, value in jones.items():
        errors = [error_of(s[name], value, 6) for s in (clean, robust, again)]
        assert errors[1] < 1.15 * errors[0]
        assert errors[2] < 1.15 * errors[0]


# Stiff and extreme -----------------------------------------------------------------------------------------------


def spoiled(kind, vis):
    """Data with something wrong, and what must be flagged of them (T, B)."""
    of_3 = (vis.antenna1 == 3) | (vis.antenna2 == 3)
    late = np.arange(12)[:, None] >= 6
    data = vis.data.copy()
    if kind == "dead station":
        data[:, :, of_3] = 0
        return vis.with_data(data), np.broadcast_to(of_3, (12, len(of_3)))
    if kind == "station without baselines":
        return vis.flagged(of_3[None, None]), np.broadcast_to(of_3, (12, len(of_3)))
    if kind == "no weight in an interval":
        return vis.weighted(np.where(late, 0.0, 1.0)[..., None]), np.broadcast_to(late, (12, len(of_3)))
    if kind == "NaN in an interval":
        data[6:] = np.nan
        return vis.with_data(data), np.broadcast_to(late, (12, len(of_3)))
    data[2, 0, 5], data[8, 0, 7, 1, 1] = np.nan, np.inf
    return vis.with_data(data), ~np.isfinite(data).all(axis=(1, 3, 4))


@pytest.mark.parametrize(
    "kind", ["dead station", "station without baselines", "no weight in an interval", "NaN in an interval", "NaN"]
)
def test_what_has_no_answer_is_flagged_and_the_rest_is_right(kind):
    data, sky, _ = laboratory(hold=6)
    spoilt, bad = spoiled(kind, data)
    solution = DirectionalCal(interval=60 * u.s).solve(spoilt, sky)
    left = solution.subtracted(spoilt, sky)
    assert np.array_equal(np.broadcast_to(left.flag, left.data.shape[:3])[:, 0], bad)
    assert np.isfinite(left.data).all()
    assert rms(left) < 1e-9 * rms(data)
    assert all((o is Outcome.REFUSED) == bad[6].all() for o in solution["10 Jy"].outcome[1])


def nearly(vis):
    """The same with phases that differ by 1e-3."""
    turn = np.random.default_rng(0).normal(size=vis.data.shape[:3])[..., None, None]
    return vis.with_data(vis.data * np.exp(1e-3j * turn))


@pytest.mark.parametrize(
    "spoil, outcome",
    [
        (lambda d, m: (d, m | {"10 Jy": m["20 Jy"]}), Outcome.SINGULAR),  # two clusters that are one
        (lambda d, m: (d, m | {"10 Jy": nearly(m["20 Jy"])}), Outcome.SINGULAR),
        (lambda d, m: (d.flagged(((d.antenna1 > 1) | (d.antenna2 > 1))[None, None]), m), Outcome.SINGULAR),
        (lambda d, m: (d, m | {"10 Jy": d.with_data(np.nan * d.data)}), Outcome.NON_FINITE),
        (lambda d, m: (d.weighted(np.zeros((1, 1, 1))), m), Outcome.REFUSED),
        (lambda d, m: (d.with_data(0 * d.data), m), Outcome.REFUSED),
    ],
    ids=["alike", "nearly alike", "two stations", "NaN model", "no weight", "no data"],
)
def test_hopeless_solves_say_so_and_everything_is_flagged(spoil, outcome):
    data, sky, _ = laboratory()
    data, sky = spoil(data, sky)
    solution = DirectionalCal(interval=60 * u.s, iterations=20).solve(data, sky)
    assert all(o is not Outcome.CONVERGED for s in solution.clusters.values() for o in s.outcome.ravel())
    assert solution["10 Jy"].outcome[0, 0] is outcome
    left = solution.subtracted(data, sky)
    assert left.flag.all()
    assert np.isfinite(left.data).all()


def test_gains_of_1e6_are_solved_or_refused():
    data, sky, _ = laboratory(hold=6)
    gain = np.ones(20)
    gain[4], gain[5] = 1e6, 1e-6
    table = JonesTable(values=(gain[:, None, None] * np.eye(2))[None, None], slots_s=[0.0], freq_hz=[1.5e8])
    strange = data.corrupted(table)
    left = DirectionalCal(interval=60 * u.s).solve(strange, sky).subtracted(strange, sky)
    assert left.flag.all() or rms(left.corrected(table)) < 1e-6 * rms(data)


def test_a_cluster_without_flux_in_an_interval_is_refused_there_and_does_not_disturb_the_others():
    _, sky, jones = laboratory(hold=6)
    dark = sky["10 Jy"].data.copy()
    dark[6:] = 0
    sky = sky | {"10 Jy": sky["10 Jy"].with_data(dark)}
    data = total(sky, jones)
    solution = DirectionalCal(interval=60 * u.s).solve(data, sky)
    assert solution["10 Jy"].outcome.ravel().tolist() == [Outcome.CONVERGED, Outcome.REFUSED]
    left = solution.subtracted(data, sky)
    assert not left.flag.any()  # nothing is there to subtract
    assert rms(left) < 1e-9 * rms(data)


def test_kept_clusters_stay_in_the_data():
    data, sky, jones = laboratory(hold=6)
    solution = DirectionalCal(interval=60 * u.s).solve(data, sky)
    want = total({"20 Jy": sky["20 Jy"]}, jones)
    assert rms(solution.subtracted(data, sky, keep=["20 Jy"]) - want) < 1e-9 * rms(data)


def test_bad_input_is_named():
    data, sky, _ = laboratory()
    settings = DirectionalCal(interval=60 * u.s)
    with pytest.raises(InputError, match="models is empty"):
        settings.solve(data, {})
    with pytest.raises(InputError, match="cluster '20 Jy' is zero everywhere"):
        settings.solve(data, sky | {"20 Jy": data.with_data(0 * data.data)})
    with pytest.raises(InputError):
        settings.solve(data, models(slots=6, clusters=1))
    with pytest.raises(BeamStateError):
        settings.solve(data, sky | {"20 Jy": replace(sky["20 Jy"], beam_state=BeamState("centre"))})
    with pytest.raises(InputError, match=r"intervals names '90 Jy'.*did you mean"):
        settings.with_fields(intervals={"90 Jy": 1 * u.min}).solve(data, sky)
    with pytest.raises(InputError, match="needs a unit convertible to s"):
        DirectionalCal(intervals={"20 Jy": 60})
    with pytest.raises(InputError, match="positive"):
        DirectionalCal(intervals={"20 Jy": 0 * u.s})
    with pytest.raises(InputError, match="no cluster '90 Jy'"):
        settings.solve(data, sky)["90 Jy"]


def test_settings_survive_their_json():
    given = DirectionalCal(interval=1 * u.min, intervals={"a": 2 * u.min}, robust=5)
    assert DirectionalCal.from_json(given.to_json()) == given
    assert given.with_fields(robust=None).intervals == {"a": "120.0 s"}
