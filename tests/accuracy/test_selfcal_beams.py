"""Self-calibration with beams in the model: right to the tolerance given, its errors those that noise makes."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
from astropy import units as u
from scipy.linalg import cholesky, expm

import instrument
from instrument import Chain, FeedTerm, GainTerm, Observation, Outcome, Scene, SelfCal, mat2
from instrument.calibrate.errors import _without_prior, gain_errors
from instrument.calibrate.factor import Factor
from instrument.calibrate.gauge import GENERATORS
from instrument.calibrate.lanes import Lanes
from instrument.calibrate.normal import BASIS, normal_matrix
from instrument.files.solutions import write_h5parm
from instrument.jones.table import JonesTable


def model(stations=10, integrations=3, sources=(5, 5), stokes=None):
    """Visibilities of a grid of sources that are not polarized, through the beams of some LOFAR stations."""
    names = instrument.load("telescopes", "lofar-hba", beam=None).layout().names
    chosen = [names[k] for k in np.linspace(0, len(names) - 1, stations).astype(int)]
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=10 * integrations * u.s,
        interval=10 * u.s, frequencies=[150] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    sky = instrument.load("skies", "grid", shape=sources, spacing=1 * u.deg, flux=10 * u.Jy)
    if stokes is not None:
        found = sky.about(night.phase_centre)
        sky = found.with_fields(stokes_jy=np.tile(stokes, (len(found.names), 1)))
    lofar = instrument.load("telescopes", "lofar-hba", stations=chosen, element="hamaker")
    return Scene(instrument=lofar, sky=sky, observation=night).plan().run()


@pytest.fixture(scope="module")
def seen():
    return model()


def errors(rms, seed=1):
    return Chain(GainTerm(rms=rms, seed=seed), FeedTerm(rms=rms, seed=seed + 1))


def rms(values):
    return float(np.sqrt(np.mean(np.abs(values) ** 2)))


def off(solution, data, sky):
    """Corrected less model, in the rms of the model."""
    return rms(data.corrected(solution.term).data - sky.data) / rms(sky.data)


@pytest.mark.parametrize("size", [1e-3, 1e-2, 1e-1])
@pytest.mark.parametrize("tolerance", [1e-4, 1e-7, 1e-10])
def test_what_converges_is_right_to_its_tolerance(seen, size, tolerance):
    data = seen.corrupted(errors(size))
    solution = SelfCal(tolerance=tolerance).solve(data, seen)
    assert solution.converged.all() and solution.iterations.max() <= 15
    assert off(solution, data, seen) <= 10 * tolerance


@pytest.mark.parametrize("sefd", [2820, 282, 28])
@pytest.mark.parametrize("size", [1e-2, 1e-1])
def test_with_noise_all_converge(seen, size, sefd):
    data = seen.corrupted(errors(size)).with_noise(sefd * u.Jy, seed=3)
    solution = SelfCal(tolerance=1e-8).solve(data, seen)
    assert solution.converged.all() and solution.iterations.max() <= (15 if sefd > 100 else 25)


@pytest.mark.parametrize(("start", "most"), [(1e6, 1e-8), (-1.0, 1e-9), (1j, 1e-9), (1e-3, 1e-9)])
def test_starts_far_away(seen, start, most):
    data = seen.corrupted(errors(0.1))
    term = JonesTable(values=np.full((1, 1, 10, 1, 1), start) * np.eye(2), slots_s=[0.0], freq_hz=[0.0])
    solution = SelfCal(tolerance=1e-10, start=term).solve(data, seen)
    assert solution.converged.all() and off(solution, data, seen) <= most


@pytest.mark.parametrize("pattern", ["full", "diagonal", "scalar", "phase"])
def test_patterns(seen, pattern):
    gains = errors(0.1).jones(seen.at)[:, :, :, 0]
    if pattern != "full":
        gains = gains * np.eye(2)
    if pattern == "scalar":
        gains = gains[..., :1, :1] * np.eye(2)
    if pattern == "phase":
        gains = np.where(np.eye(2), gains / np.where(np.eye(2), np.abs(gains), 1), 0)
    true = JonesTable(values=gains, slots_s=seen.at.slots_s, freq_hz=seen.at.freq_hz)
    data = seen.corrupted(true)
    solution = SelfCal(tolerance=1e-10, pattern=pattern).solve(data, seen)
    assert solution.converged.all() and off(solution, data, seen) <= 1e-9


def test_weak_directions_are_told_and_gains_are_off_by_their_errors(seen):
    term = errors(0.1)
    clean, pulls, truth = seen.corrupted(term), [], None
    for seed in range(20):
        solution = SelfCal(tolerance=1e-8).solve(clean.with_noise(2820 * u.Jy, seed=seed), seen)
        truth = solution.truth(term, seen.at) if truth is None else truth
        apart = solution.aligned(truth).jones - truth
        pulls.append(np.stack([apart.real, apart.imag]) / solution.error)
    assert solution.gauge.count == 1 and len(solution.gauge.weak) == 3
    assert np.all(solution.common_error[..., :4] > 0.3) and np.all(solution.common_error[..., 4:] < 0.01)
    assert "3 common directions are weaker than the noise, and held near the start" in str(solution)
    each = np.sqrt(np.mean(np.square(pulls), axis=(0, 1, 2, 3)))  # (A, 2, 2): 120 draws of a number
    assert 0.95 < np.sqrt(np.mean(np.square(pulls))) < 1.05
    assert each.min() > 0.8 and each.max() < 1.2  # 3 of their own standard errors


def test_each_interval_has_its_own_weak_directions(seen):
    """What the error of a gain leaves out is what `aligned` turns along, in that interval."""
    solution = SelfCal(tolerance=1e-8).solve(seen.corrupted(errors(0.1)), seen)
    error = np.full((3, 1, 8), 0.01)
    error[..., 0], error[1, 0, 2], error[2, 0, 2:4] = np.inf, 0.5, 0.4
    gauge, others = solution.gauge.with_errors(error)
    assert len(gauge.weak) == 1 and {where: len(g.weak) for where, g in others.items()} == {(0, 0): 0, (2, 0): 2}
    parted = replace(solution, gauge=gauge, looser=others)
    turn = mat2.exponential(0.3 * solution.gauge.directions[2:4].sum(axis=0))
    to = solution.jones @ turn
    apart = np.abs(parted.aligned(to).jones - to).max(axis=(1, 2, 3, 4))
    assert apart[2] < 1e-5 and apart[0] > 0.05 and apart[1] > 0.05


def test_errors_of_gains_without_beams():
    """There they come from how stations hang together, not from the whole normal matrix."""
    sky = model(stations=10, integrations=2)
    sky = sky.with_data(sky.data[..., :1, :1] * np.eye(2))
    term = errors(0.1)
    clean, pulls = sky.corrupted(term), []
    for seed in range(20):
        solution = SelfCal(tolerance=1e-8).solve(clean.with_noise(282 * u.Jy, seed=seed), sky)
        truth = solution.truth(term, sky.at)
        apart = solution.aligned(truth).jones - truth
        pulls.append(np.stack([apart.real, apart.imag]) / solution.error)
    assert solution.gauge.count == 4 and not len(solution.gauge.weak)
    assert 0.93 < np.sqrt(np.mean(np.square(pulls))) < 1.07


@pytest.mark.parametrize(
    ("of", "ends"),
    [
        ({"stations": 2}, {Outcome.CONVERGED, Outcome.SINGULAR}),
        ({"stations": 4, "sources": (1, 1)}, {Outcome.CONVERGED}),
        ({"stations": 4, "stokes": [1.0, 1.0, 0.0, 0.0]}, {Outcome.CONVERGED, Outcome.SINGULAR}),
    ],
)
def test_stiff_input_is_right_or_said(of, ends):
    """Two stations, one source, all of it polarized."""
    sky = model(integrations=1, **of)
    data = sky.corrupted(errors(0.1))
    solution = SelfCal(tolerance=1e-8).solve(data, sky)
    assert {*solution.outcome.ravel()} <= ends
    if solution.converged.all():
        assert off(solution, data, sky) <= 1e-6


def test_noise_a_hundred_times_the_signal_is_said(seen):
    data = seen.corrupted(errors(0.1)).with_noise(2820e3 * u.Jy, seed=1)
    solution = SelfCal(tolerance=1e-6).solve(data, seen)
    assert not solution.converged.any() or solution.doubts
    for ended in solution.outcome.ravel():
        assert ended in (Outcome.CONVERGED, Outcome.POOR_FIT, Outcome.ITERATION_LIMIT)


def test_errors_of_a_solve_from_another_start_are_exact_too(seen, monkeypatch):
    """Where the first start leads nowhere, what is tried again has a normal matrix of its own."""
    data, first = seen.corrupted(errors(0.1)).with_noise(2820 * u.Jy, seed=5), Lanes.iterate

    def nowhere(self, jones, *far):
        found, step, count, history = first(self, jones, *far)
        monkeypatch.setattr(Lanes, "iterate", first)
        return 3 * found, np.full_like(step, np.inf), count, history

    monkeypatch.setattr(Lanes, "iterate", nowhere)
    solution = SelfCal(tolerance=1e-8).solve(data, seen)
    assert Lanes.iterate is first and solution.converged.all()
    again = SelfCal(tolerance=1e-8, start=solution.term).solve(data, seen)
    assert solution.error == pytest.approx(again.error, rel=0.02)


def test_without_noise_errors_of_weak_directions_are_not_known(seen):
    solution = SelfCal(tolerance=1e-10).solve(seen.corrupted(errors(0.01)), seen)
    assert np.isinf(solution.common_error[..., 0]).all() and np.isnan(solution.common_error[..., 1:]).all()


def test_errors_of_gains_can_be_left_out(seen):
    data = seen.corrupted(errors(0.1)).with_noise(2820 * u.Jy, seed=1)
    full, bare = (SelfCal(tolerance=1e-8, errors=wanted).solve(data, seen) for wanted in (True, False))
    assert np.isnan(bare.error).all() and np.isfinite(full.error).all()
    assert bare.common_error == pytest.approx(full.common_error, rel=0.05)
    assert np.array_equal(bare.jones, full.jones) and len(bare.gauge.weak) == len(full.gauge.weak) == 3


def test_the_errors_are_in_the_file(seen, tmp_path):
    data = seen.corrupted(errors(0.1)).with_noise(282 * u.Jy, seed=1)
    solution = SelfCal(tolerance=1e-8).solve(data, seen)
    write_h5parm(tmp_path / "gains.h5", solution, at=seen.at)
    with h5py.File(tmp_path / "gains.h5") as file:
        amplitude, phase = (file[f"sol000/{kind}000"] for kind in ("amplitude", "phase"))
        found = amplitude["error"][:].reshape(solution.error.shape)
        assert found == pytest.approx(solution.error)
        assert phase["error"][:] * amplitude["val"][:] == pytest.approx(amplitude["error"][:])


# The pieces, against their definitions ----------------------------------------------------------------------------


def laboratory(seed=1, stations=4):
    rng = np.random.default_rng(seed)
    a1, a2 = np.triu_indices(stations, 1)
    m = rng.normal(size=(2 * len(a1), 2, 4)).view(complex)
    jones = np.eye(2) + 0.3 * rng.normal(size=(stations, 2, 4)).view(complex)
    one, other = np.tile(a1, 2), np.tile(a2, 2)
    v = jones[one] @ m @ np.conj(np.swapaxes(jones[other], 1, 2)) + 0.3 * rng.normal(size=(len(m), 2, 4)).view(complex)
    return v, m, a1, a2, jones


@pytest.mark.parametrize("pattern", list(BASIS))
def test_the_normal_matrix_is_the_second_derivative(pattern):
    v, m, a1, a2, jones = laboratory()
    basis, one, other = BASIS[pattern], np.tile(a1, 2), np.tile(a2, 2)
    size = len(jones) * basis.shape[1]

    def power(x, of):
        e = (x.reshape(len(jones), -1) @ basis.T).copy().view(complex).reshape(jones.shape)
        j = jones @ mat2.exponential(e)
        return 0.5 * float((np.abs(of - j[one] @ m @ np.conj(np.swapaxes(j[other], 1, 2))) ** 2).sum())

    fit = jones[one] @ m @ np.conj(np.swapaxes(jones[other], 1, 2))
    left = np.zeros(jones.shape, complex)
    for n, (p, q) in enumerate(zip(one, other, strict=True)):
        e = v[n] - fit[n]
        left[p] += jones[p].conj().T @ e @ jones[q] @ m[n].conj().T
        left[q] += jones[q].conj().T @ e.conj().T @ jones[p] @ m[n]
    h = 1e-4 * np.eye(size)
    for of, rest in ((fit, None), (v, left)):
        found = np.tril(normal_matrix(of, m, a1, a2, jones, pattern, rest))
        for i in range(0, size, 3):
            for j in range(0, i + 1, 2):
                four = [power(s * h[i] + t * h[j], of) * s * t for s in (1, -1) for t in (1, -1)]
                assert sum(four) / 4e-8 == pytest.approx(found[i, j], abs=1e-6 * np.abs(found).max())


@pytest.mark.parametrize("now", [3.0, 0.7, 1e-9, 0.0])
def test_errors_are_those_of_the_inverse(now):
    """Whatever the weight of the prior was when the factor was made."""
    v, m, a1, a2, jones = laboratory(stations=5)
    normal = np.tril(normal_matrix(v, m, a1, a2, jones, "full"))
    normal = normal + np.tril(normal, -1).T + 1e-3 * np.eye(len(normal))
    prior = np.random.default_rng(3).normal(size=(8, len(normal)))
    factor = Factor(np.asfortranarray(cholesky(normal + 3.0 * prior.T @ prior)), prior, 3.0, jones)
    factor.now, directions = now, GENERATORS["full"]
    free = np.arange(8) < 3
    right = np.eye(len(normal))[:, :3]
    inverse = np.linalg.inv(normal + now * prior.T @ prior)
    assert factor.exact(now) and factor.solve(right) == pytest.approx(inverse @ right, rel=1e-9, abs=1e-12)
    error, common = gain_errors(factor, jones, BASIS["full"], directions, free, 1e9)
    turn = np.zeros(normal.shape)
    for k, unit in enumerate(np.eye(len(normal))):
        turn[:, k] = (jones @ unit.view(complex).reshape(jones.shape)).copy().view(float).ravel()
    covariance = turn @ (inverse - now * inverse @ prior.T @ prior @ inverse) @ turn.T
    tangents = np.stack([(jones @ g).copy().view(float).ravel() for g in directions], axis=1)
    q = np.linalg.qr(tangents[:, :3])[0]
    apart = np.eye(len(normal)) - q @ q.T
    wanted = np.diag(apart @ covariance @ apart).reshape(5, 2, 2, 2).mean(axis=-1)
    assert error == pytest.approx(np.sqrt(wanted), rel=1e-9)
    assert np.all(np.isinf(common[:3]))
    if now <= 1e-9:  # a prior on other directions than these is not taken away
        back = np.linalg.pinv(tangents)
        assert common[3:] == pytest.approx(np.sqrt(np.diag(back @ covariance @ back.T))[3:], rel=1e-7)


def test_common_errors_without_their_prior():
    """Of the covariance with it; nothing is said of what is singular, free, or known by the prior alone."""
    data = np.array([[4.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 1e-6]])  # normal matrix of three directions
    found = _without_prior(np.linalg.inv(data + 0.5 * np.eye(3)), 0.5, np.zeros(3, bool))
    assert found[:2] == pytest.approx(np.diag(np.linalg.inv(data[:2, :2])), rel=1e-9) and np.isinf(found[2])
    assert np.isinf(_without_prior(np.zeros((3, 3)), 0.5, np.array([True, False, False]))).all()
    assert np.isinf(_without_prior(np.eye(3), 0.5, np.ones(3, bool))).all()


def test_exponentials_are_those_of_scipy():
    rng = np.random.default_rng(1)
    matrices = rng.normal(size=(40, 2, 4)).view(complex) * np.logspace(-9, 0.5, 40)[:, None, None]
    matrices[0] = [[0, 1], [0, 0]]  # no eigenvectors
    assert mat2.exponential(matrices) == pytest.approx(expm(matrices), rel=1e-13, abs=1e-15)
