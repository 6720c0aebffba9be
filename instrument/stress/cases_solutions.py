"""More cases of calibrators: patterns and their errors, several directions, open graphs, hostile data."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument import mat2
from instrument.calibrate.base import Calibrator
from instrument.calibrate.gauge import GENERATORS, HELD_TO
from instrument.stress.bench import observed, points, small_array
from instrument.stress.case import Answer, Unfit, both, case, claim, held
from instrument.stress.cases_calibration import STATIONS, changed, gains, left, model_of, noise_like, put, seeds
from instrument.units import Complex, Float
from instrument.visibilities import Visibilities

STRONG = points([2.15, 2.17, 2.14], [0.84, 0.85, 0.83], [[9, 5, 2, 3], [3, 0, -2, 1], [1, 0.5, 0, -0.6]])
PATTERNS = ("full", "diagonal", "scalar", "phase")


def _errors_of(pattern: str) -> Complex:
    """True errors (1, 1, A, 2, 2) such as a pattern can have."""
    jones = gains(0.2, seed=9)
    if pattern == "full":
        return jones
    diagonal = np.where(np.eye(2), jones, 0)
    if pattern == "diagonal":
        return diagonal
    if pattern == "scalar":
        return np.asarray(jones[..., :1, :1] * np.eye(2))
    return np.where(np.eye(2), diagonal / np.where(np.eye(2), np.abs(diagonal), 1), 0)


@case(
    "C0",
    "calibrators",
    "every pattern, without noise",
    "corrected data are the model, to 1e-7; gains up to the gauge, 1e-6",
)
def patterns(calibrator: Calibrator) -> Answer:
    """Full, diagonal, scalar, phase; two intervals of two integrations."""
    answers = []
    model = model_of(times=4)
    for pattern in PATTERNS:
        jones = _errors_of(pattern)
        found = changed(calibrator, pattern=pattern, interval="120 s").solve(put(model, jones), model)
        if not found.converged.all():
            return claim(False, f"{pattern}: {found.outcome.ravel()[0].name}")
        due = np.broadcast_to(jones, found.jones.shape)
        answers += [
            Answer(left(put(model, jones), model, found), 1e-7),
            held(found.aligned(to=due).jones, due, 1e-6),
            claim(found.jones.shape[0] == 2, f"{found.jones.shape[0]} intervals of 2"),
        ]
    return both(*answers)


@case("C0b", "calibrators", "errors of every pattern", "pulls of 30 noises within 12 % of 1; sizes as sigma")
def standard_errors(calibrator: Calibrator) -> Answer:
    """A polarized model at a signal to noise of 100; twice the noise has errors twice as large."""
    answers = []
    for pattern in ("full", "diagonal", "phase"):
        jones, sizes = _errors_of(pattern), []
        for sigma in (0.01, 0.02):
            data, model, _j = seeds(1 / sigma, 30, STRONG, jones)
            found = changed(calibrator, pattern=pattern).solve(data, model)
            if not found.converged.all():
                return claim(False, f"{pattern}: {int((~found.converged).sum())} of 30 not converged")
            due = np.broadcast_to(jones, found.jones.shape)
            off = found.aligned(to=due).jones - due
            error = np.broadcast_to(found.error, off.shape)
            use = np.isfinite(error) & (error > 0)
            sizes.append(float(np.sqrt((error[use] ** 2).mean())))
            pull = np.sqrt((np.abs(off[use]) ** 2).mean() / (2 * error[use] ** 2).mean())
            answers.append(Answer(abs(float(pull) - 1), 0.12))
        answers.append(Answer(abs(sizes[1] / sizes[0] / 2 - 1), 0.1))
    return both(*answers)


def _changes(model: Visibilities, jones: Complex) -> Float:
    """What each real number of the matrices (A, 2, 2) does to the real numbers of all visibilities, (N, 8 A)."""
    a, b, columns = model.antenna1, model.antenna2, []
    for unit in np.eye(8 * len(jones)).reshape(-1, *jones.shape, 2).view(complex)[..., 0]:
        v = mat2.sandwich(unit[a], model.data, jones[b]) + mat2.sandwich(jones[a], model.data, unit[b])
        columns.append(np.ascontiguousarray(v).view(float).ravel())
    return np.array(columns).T


def _along(jones: Complex) -> Float:
    """Steps J G of all stations along common directions (8, 8 A), G those that keep full matrices."""
    steps = mat2.mul(jones[None], GENERATORS["full"][:, None])
    return np.asarray(steps.reshape(len(steps), -1).view(float))


@case("C0c", "calibrators", "errors of common directions", "those of the dense least squares of one interval, to 5 %")
def common_errors(calibrator: Calibrator) -> Answer:
    """Full matrices, 32 integrations; the covariance from a matrix of all derivatives, the free phase taken out."""
    model, sigma = observed(small_array(STATIONS), STRONG, 32), 0.05
    jones = gains(0.2, seed=9)
    data = put(model, jones)
    data = data.with_data(data.data + noise_like(data.data, sigma))
    found = changed(calibrator, pattern="full", interval="1920 s").solve(data, model)
    if found.common_error is None:
        raise Unfit("it gives no errors of common directions")
    change, steps = _changes(model, jones[0, 0]), _along(jones[0, 0])
    values, vectors = np.linalg.eigh(change.T @ change)
    kept = values > 1e-10 * values[-1]
    onto = np.linalg.pinv(steps @ steps.T) @ steps @ vectors[:, kept] / np.sqrt(values[kept])
    due = sigma * np.linalg.svd(onto, compute_uv=False)
    told = np.sort(found.common_error[0, 0])[::-1]
    free = claim(bool(np.isinf(told[0]) and np.isfinite(told[1:]).all()), f"infinite of {np.isinf(told).sum()}, due 1")
    return both(free, held(told[1:], due[:7], 0.05))


@case(
    "C0d", "calibrators", "common directions that noise fills", "data pull away from the start as the prior pulls back"
)
def weak_directions(calibrator: Calibrator) -> Answer:
    """4 % of polarization: along the step from the start, the slope of the misfit over that of the prior stated.

    1 of a fit held by it, 0 of one that is not held at all; below 0 the fit is too far out.
    """
    sky = points([2.15, 2.17], [0.84, 0.85], [[9, 0.4, 0, 0], [3, 0, 0.1, 0.05]])
    model = observed(small_array(STATIONS), sky)
    turn = mat2.exponential(0.05 * (GENERATORS["full"][1] + GENERATORS["full"][2])[None])
    data = put(model, np.broadcast_to(turn, (1, 1, STATIONS, 2, 2)))
    data = data.with_data(data.data + noise_like(data.data, 2.0, seed=3))
    found = changed(calibrator, pattern="full", interval="240 s").with_fields(tolerance=1e-9).solve(data, model)
    if not found.converged.all():
        return claim(False, found.outcome.ravel()[0].name)
    jones, start = found.jones[0, 0], np.broadcast_to(np.eye(2) + 0j, (STATIONS, 2, 2))
    steps = _along(start)
    y = np.linalg.pinv(steps @ steps.T) @ steps @ np.ascontiguousarray(jones - start).view(float).ravel()
    rest = np.ascontiguousarray(data.data - put(model, jones[None, None]).data).view(float).ravel()
    slope = 2 * _along(jones) @ _changes(model, jones).T @ rest
    variance = float(rest @ rest) / (len(rest) - 8 * STATIONS)
    share = float(slope @ y / (y @ y)) * HELD_TO**2 / (2 * variance)
    return claim(-0.1 < share < 1.1, f"{share:.2f} of the prior's slope")


@case("D1", "calibrators", "only baselines between two groups of three count", "not CONVERGED, or right to 1e-6 on all")
def bipartite(calibrator: Calibrator) -> Answer:
    """J -> J X in one group, J X^-H in the other fits as well; gains of 2 in one."""
    model = observed(small_array(6), points([2.15], [0.84], [9, 1, 0, 0.2]), 2)
    jones = gains(0.0, 6)
    jones[:, :, 3:] *= 2
    data = put(model, jones)
    within = (model.antenna1 < 3) == (model.antenna2 < 3)
    found = calibrator.solve(data.flagged(np.broadcast_to(within, data.data.shape[:3])), model)
    if not found.converged.any():
        return claim(True, told=found.outcome.ravel()[0].name)
    return Answer(left(data, model, found), 1e-6)


@case("D4", "calibrators", "amplitudes of 10^(-3 to 3), 20 draws", "right to 1e-5, or not CONVERGED")
def far_apart(calibrator: Calibrator) -> Answer:
    """Eight stations, one gain each."""
    model = model_of(times=1)
    rng = np.random.default_rng(6)
    right, said, worst = 0, 0, 0.0
    for _ in range(20):
        size = 10 ** rng.uniform(-3, 3, (1, 1, STATIONS, 1, 1))
        turn = np.exp(2j * np.pi * rng.random(size.shape))
        data = put(model, size * turn * np.eye(2))
        found = changed(calibrator, pattern="scalar").solve(data, model)
        if found.converged.all():
            worst = max(worst, left(data, model, found))
            right += 1
        else:
            said += 1
    return both(Answer(worst, 1e-5), claim(right >= 10, f"{right} of 20 converged, {said} said not"))


@case(
    "D5",
    "calibrators",
    "NaN data, fluxes x 1e170, 1e-170",
    "NaN weighs nothing; scaled data give the same gains",
    refusal=True,
)
def hostile(calibrator: Calibrator) -> Answer:
    """One visibility in ten NaN or infinite: as without them. A power of two changes no gain."""
    model = model_of()
    data = put(model, gains())
    bad = np.random.default_rng(1).random(data.data.shape[:3]) < 0.1
    spoilt = np.where(bad[..., None, None], np.nan, data.data)
    spoilt[np.nonzero(bad)[0][0], 0, np.nonzero(bad)[2][0]] = np.inf
    due = calibrator.solve(data.flagged(bad), model)
    answers = [held(calibrator.solve(data.with_data(spoilt), model).jones, due.jones, 1e-12)]
    plain = calibrator.solve(data, model)
    for power in (560, -560):
        scale = 2.0**power
        found = calibrator.solve(data.with_data(data.data * scale), model.with_data(model.data * scale))
        if found.converged.all():
            answers.append(held(found.aligned(to=plain.jones).jones, plain.jones, 1e-7))
    return both(*answers)


@case(
    "C1d", "calibrators", "two directions 1 deg apart, matrices of their own", "each found, to 1e-5; subtracted to 1e-6"
)
def two_directions(calibrator: Calibrator) -> Answer:
    """Eight integrations in one interval; one cluster kept; intervals of their own."""
    if "intervals" not in type(calibrator).model_fields:
        raise Unfit("it has no directions")
    array = small_array(STATIONS, spread=2000.0)
    names = {"a": points([2.15], [0.84], [5, 1, 0, 0.2]), "b": points([2.17], [0.85], [3, 0, 0.7, 0])}
    models = {n: observed(array, sky, 8) for n, sky in names.items()}
    truth = {n: gains(0.2, seed=k + 20) for k, n in enumerate(models)}
    parts = {n: put(m, truth[n]) for n, m in models.items()}
    data = parts["a"] + parts["b"]
    answers = []
    for more in ({"interval": "480 s"}, {"interval": "480 s", "intervals": {"b": "240 s"}}):
        found: Any = changed(calibrator, **more).solve(data, models)  # type: ignore[arg-type]
        if not all(found[n].converged.all() for n in models):
            return claim(False, f"{[found[n].outcome.ravel()[0].name for n in models]}")
        for n in models:
            due = np.broadcast_to(truth[n], found[n].jones.shape)
            answers.append(held(found[n].aligned(to=due).jones, due, 1e-5))
        empty, kept = found.subtracted(data, models), found.subtracted(data, models, keep="a")
        answers += [
            held(empty.data, 0 * data.data, 1e-6, scale=5.0),
            held(kept.data, parts["a"].data, 1e-6),
            held(found.predicted(models, only="b").data, parts["b"].data, 1e-6),
        ]
    return both(*answers)


@case("C2d", "calibrators", "noise beside two directions", "pulls of the gains within 15 % of 1")
def directional_errors(calibrator: Calibrator) -> Answer:
    """One gain a station and direction; 40 noises."""
    if "intervals" not in type(calibrator).model_fields:
        raise Unfit("it has no directions")
    array = small_array(STATIONS, spread=2000.0)
    models = {
        n: observed(array, points([ra], [dec], [f, 0, 0, 0]), 4)
        for n, ra, dec, f in (("a", 2.15, 0.84, 5), ("b", 2.17, 0.85, 3))
    }
    truth = {n: gains(matrices=False, seed=k + 30) for k, n in enumerate(models)}
    data = put(models["a"], truth["a"]) + put(models["b"], truth["b"])
    scalar, pulls = changed(calibrator, pattern="scalar", interval="240 s"), []
    for seed in range(20):
        found: Any = scalar.solve(data.with_data(data.data + noise_like(data.data, 0.05, seed)), models)  # type: ignore[arg-type]
        for n in models:
            if not found[n].converged.all():
                return claim(False, found[n].outcome.ravel()[0].name)
            due = np.broadcast_to(truth[n], found[n].jones.shape)
            off = (found[n].aligned(to=due).jones - due)[..., 0, 0]
            error = np.broadcast_to(found[n].error, due.shape)[..., 0, 0]
            pulls.append((np.abs(off) ** 2).mean() / (2 * error**2).mean())
    return Answer(abs(float(np.sqrt(np.mean(pulls))) - 1), 0.15)


@case("C3d", "calibrators", "a solution put back into a chain", "corrected and corrupted undo each other, to 1e-10")
def undone(calibrator: Calibrator) -> Answer:
    """By its term, by its inverse, and in the least squares of `aligned`."""
    model = model_of()
    data = put(model, gains())
    found = calibrator.solve(data, model)
    back = data.corrected(found.term).corrupted(found.term)
    other = data.corrupted(found.inverse())
    turned = mat2.mul(found.jones, np.broadcast_to(np.exp(0.7j) * np.eye(2), found.jones.shape))
    aligned = found.aligned(to=turned).jones
    return both(
        held(back.data, data.data, 1e-10),
        held(other.data, data.corrected(found.term).data, 1e-10),
        held(aligned, turned, 1e-7),
    )
