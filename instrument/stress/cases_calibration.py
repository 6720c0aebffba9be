"""Cases of calibrators: what no data determine, starts far away, weights, noise, interference, incomplete models."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from instrument import mat2
from instrument.calibrate.base import Calibrator, Solution
from instrument.jones.gain import GainTerm
from instrument.sky.points import PointSky
from instrument.stress.bench import field, observed, points, small_array
from instrument.stress.case import Answer, Unfit, both, case, claim, held
from instrument.units import Complex
from instrument.visibilities import Visibilities

STATIONS = 8


@cache
def model_of(polarized: bool = True, times: int = 2) -> Visibilities:
    """Three sources on 28 baselines, one channel."""
    return observed(small_array(STATIONS), field(polarized), times)


def gains(size: float = 0.3, stations: int = STATIONS, seed: int = 5, matrices: bool = True) -> Complex:
    """Errors (1, 1, A, 2, 2): phases of up to 1 rad, and matrices of so much, or one number each."""
    rng = np.random.default_rng(seed)
    turn = np.exp(1j * rng.uniform(-1, 1, (stations, 1, 1)))
    errors = size * rng.normal(size=(stations, 2, 4)).view(complex) / 2 if matrices else 0.0
    return np.asarray(((np.eye(2) + errors) * turn)[None, None])


def put(model: Visibilities, jones: Complex) -> Visibilities:
    """A model behind matrices (T | 1, F | 1, A, 2, 2)."""
    a, b = model.antenna1, model.antenna2
    return model.with_data(mat2.sandwich(jones[:, :, a], model.data, jones[:, :, b]))


def noise_like(like: Complex, sigma: float, seed: int = 7) -> Complex:
    """Noise of so much in each part."""
    return np.asarray(sigma * np.random.default_rng(seed).normal(size=(*like.shape, 2)).view(complex)[..., 0])


def changed(calibrator: Calibrator, **fields: Any) -> Calibrator:
    """The same with other settings; a calibrator that lacks them does not fit the case."""
    lacking = sorted(set(fields) - set(type(calibrator).model_fields))
    if lacking:
        raise Unfit(f"it has no setting '{lacking[0]}'")
    return calibrator.with_fields(**fields)


def left(data: Visibilities, model: Visibilities, found: Solution) -> float:
    """Rms of corrected data less model over that of the model, where there is a solution; NaN where there is none."""
    off = data.corrected(found.term)
    use = np.broadcast_to(off.whole_weight > 0, off.data.shape[:3])
    if not use.any():
        return np.nan
    return float(np.sqrt((np.abs(off.data - model.data)[use] ** 2).mean() / (np.abs(model.data)[use] ** 2).mean()))


@case("28", "calibrators", "a model without polarization", "exactly one U(2) is free: 4 real parameters, all unitary")
def unitary(calibrator: Calibrator) -> Answer:
    """Full matrices; a polarized model leaves the phase alone."""
    full = changed(calibrator, pattern="full")
    plain, polarized = (full.solve(put(model_of(p), gains()), model_of(p)) for p in (False, True))
    told = f"{plain.gauge.count} free of I, {polarized.gauge.count} of I, Q, U, V"
    free = plain.gauge.count == 4 and plain.gauge.unitary and polarized.gauge.count == 1
    return claim(free and bool(plain.converged.all() and polarized.converged.all()), told)


@case("30", "calibrators", "two islands of stations", "not CONVERGED, or right to 1e-6 on all", refusal=True)
def islands(calibrator: Calibrator) -> Answer:
    """Baselines between stations 0-3 and 4-7 are flagged in the solve; all are looked at."""
    model = model_of()
    jones = gains(matrices=False)
    data = put(model, jones)
    cut = (model.antenna1 < 4) != (model.antenna2 < 4)
    found = calibrator.solve(data.flagged(np.broadcast_to(cut, data.data.shape[:3])), model)
    if not found.converged.any():
        return claim(True, told=found.outcome.ravel()[0].name)
    return Answer(left(data, model, found), 1e-6)


@case("31", "calibrators", "two stations, full Jones matrices", "under-determined, and said: not CONVERGED, or a gauge")
def two_stations(calibrator: Calibrator) -> Answer:
    """16 unknowns, 8 numbers of one baseline: a sum of two terms is seen, no more."""
    model = observed(small_array(2), field(), 1)
    jones = gains(0.2, 2)
    found = changed(calibrator, pattern="full").solve(put(model, jones), model)
    told = ", ".join(sorted({o.name for o in found.outcome.ravel()}))
    if not found.converged.any():
        return claim(True, told=told)
    due = np.broadcast_to(jones, found.jones.shape)
    off = float(np.abs(found.aligned(to=due).jones - due).max())
    return claim(off < 1e-6, f"{told}, {found.gauge.count} free, and off by {off:.1e} beyond them")


@case("33", "calibrators", "starts of 1e6, 1e-6, -1 and i", "the same fit: corrected data to 100 times the tolerance")
def starts(calibrator: Calibrator) -> Answer:
    """All stations start at that number."""
    data = put(model_of(), gains())
    answers = []
    for start in (1e6, 1e-6, -1.0, 1j):
        values = np.full((1, 1, STATIONS, 2), start, complex)
        found = changed(calibrator, start=GainTerm(values=values)).solve(data, model_of())
        if not found.converged.all():
            return claim(False, f"start {start:g}: {found.outcome.ravel()[0].name}")
        answers.append(Answer(left(data, model_of(), found), 100 * calibrator.tolerance + 1e-12))
    return both(*answers)


@case("34", "calibrators", "weights from 0 to 1e12", "equals deletion of the light ones, to 1e-10")
def weights(calibrator: Calibrator) -> Answer:
    """A third of the data with noise of 0.3 Jy, the rest of 3e-7: 1/sigma^2 as weight, 0 for the third, and flagged."""
    model = model_of()
    data = put(model, gains(matrices=False))
    data = data.with_data(data.data + noise_like(data.data, 3e-7, seed=8))
    bad = np.random.default_rng(3).random(data.data.shape[:3]) < 0.3
    spoilt = data.with_data(data.data + np.where(bad[..., None, None], noise_like(data.data, 0.3), 0.0))
    ways = (spoilt.flagged(bad), spoilt.weighted(np.where(bad, 0.0, 1.0)), spoilt.weighted(np.where(bad, 1.0, 1e12)))
    tight = calibrator.with_fields(tolerance=1e-12)
    if "pattern" in type(tight).model_fields:
        tight = tight.with_fields(pattern="scalar")  # nothing is weak then but the common phase
    due, *found = (tight.solve(way, model) for way in ways)
    return both(*(held(f.aligned(to=due.jones).jones, due.jones, 1e-10) for f in found))


def seeds(
    snr: float, seeds: int, sky: PointSky | None = None, jones: Complex | None = None
) -> tuple[Visibilities, Visibilities, Complex]:
    """So many noises of one integration, as integrations; the model, and the true gains."""
    one = observed(small_array(STATIONS), sky or points([2.15], [0.84], [1, 0, 0, 0]), 1)
    at = one.at
    slots = at.slots_s[0] + 60.0 * np.arange(seeds)
    earth = type(at.earth)(np.repeat(at.earth.matrices, seeds, 0), np.repeat(at.earth.velocity, seeds, 0))
    model = replace(one, at=replace(at, slots_s=slots, earth=earth), data=np.repeat(one.data, seeds, axis=0),
                    interval_s=60.0)  # fmt: skip
    jones = gains(matrices=False) if jones is None else jones
    data = put(model, np.broadcast_to(jones, (seeds, *jones.shape[1:])))
    return data.with_data(data.data + noise_like(data.data, 1 / snr)), model, jones


@case(
    "35",
    "calibrators",
    "signal to noise 0.01 to 1e4, 100 seeds",
    "scatter that of its errors +-5 %; none CONVERGED at 0.01",
)
def cramer_rao(calibrator: Calibrator) -> Answer:
    """One gain a station, a point of 1 Jy: the scatter of 100 solutions over their own standard errors."""
    scalar = changed(calibrator, pattern="scalar")
    answers = []
    for snr in (0.01, 10.0, 100.0, 1e4):
        data, model, jones = seeds(snr, 100 if snr > 1 else 20)
        found = scalar.solve(data, model)
        if snr < 1:
            answers.append(claim(not found.converged.any(), f"{found.converged.sum()} of 20 noises CONVERGED"))
            continue
        if not found.converged.all():
            return claim(False, f"S/N {snr:g}: {int((~found.converged).sum())} of 100 not converged")
        due = np.broadcast_to(jones, found.jones.shape)
        off = (found.aligned(to=due).jones - due)[..., 0, 0]
        error = np.broadcast_to(found.error, found.jones.shape)[..., 0, 0]
        pull = float(np.sqrt((np.abs(off) ** 2).mean() / (2 * error**2).mean()))
        answers.append(Answer(abs(pull - 1), 0.05))
    return both(*answers)


@case("36", "calibrators", "a model of zeros", "refused, or none CONVERGED", refusal=True)
def no_model(calibrator: Calibrator) -> Answer:
    """Data of 9 Jy, model of nothing."""
    found = calibrator.solve(put(model_of(), gains()), model_of().with_data(np.zeros_like(model_of().data)))
    told = ", ".join(sorted({o.name for o in found.outcome.ravel()}))
    return claim(not found.converged.any(), told, told)


@case("36b", "calibrators", "a dead station", "the others bitwise as without its data; it has no solution")
def dead(calibrator: Calibrator) -> Answer:
    """Station 3 flagged with noise, and with other noise, under the flags."""
    data = put(model_of(), gains())
    its = (data.antenna1 == 3) | (data.antenna2 == 3)
    flag = np.broadcast_to(its, data.data.shape[:3])
    found = []
    for level in (1.0, 1e3):
        spoilt = np.where(flag[..., None, None], noise_like(data.data, level), data.data)
        found.append(calibrator.solve(data.with_data(spoilt).flagged(flag), model_of()).jones)
    same = np.array_equal(np.delete(found[0], 3, axis=2), np.delete(found[1], 3, axis=2))
    whole = np.isfinite(np.delete(found[0], 3, axis=2)).all()
    return claim(same and whole and np.isnan(found[0][:, :, 3]).all(), "what is flagged changes the answer")


@case("37", "calibrators", "one visibility wrong by 1e3", "robust: unmoved (1e-6); otherwise not CONVERGED, or named")
def outlier(calibrator: Calibrator) -> Answer:
    """Baseline 0-5 of the first integration."""
    model = model_of()
    data = put(model, gains(matrices=False))
    wrong = data.data.copy()
    wrong[0, 0, 4] *= 1e3
    spoilt = data.with_data(wrong)
    if "robust" in type(calibrator).model_fields:
        found = calibrator.with_fields(robust=2.0).solve(spoilt, model)
        if not found.converged.all():
            return claim(False, f"robust, and {found.outcome.ravel()[0].name}")
        return Answer(left(data, model, found), 1e-6)
    found = calibrator.solve(spoilt, model)
    off = left(data.block(slice(0, 1), slice(None)), model.block(slice(0, 1), slice(None)), found)
    if not found.converged[0].any():
        return claim(True, told=found.outcome.ravel()[0].name)
    return claim(off < 1e-6 or bool(found.spoilt), f"CONVERGED, off by {off:.1e}; said: {'; '.join(found.doubts)}")


@case(
    "32",
    "calibrators",
    "two directions 1 arcsec apart",
    "the sum solved; the split not CONVERGED, or right",
)
def close(calibrator: Calibrator) -> Answer:
    """Two sources of 1 Jy, one matrix of errors for each, 500 m baselines: the fringes differ by 1e-5."""
    if "intervals" not in type(calibrator).model_fields:
        raise Unfit("it has no directions")
    array = small_array(STATIONS)
    models = {n: observed(array, points([2.15 + d], [0.84], [1, 0.1, 0, 0])) for n, d in (("a", 0.0), ("b", 7e-6))}
    truth = {n: gains(matrices=False, seed=k) for k, n in enumerate(models)}
    parts = [put(m, np.broadcast_to(truth[n], (4, *truth[n].shape[1:]))) for n, m in models.items()]
    data = parts[0] + parts[1]
    found: Any = calibrator.solve(data, models)  # type: ignore[arg-type]
    if not all(found[n].converged.all() for n in models):
        return claim(True, told=", ".join(sorted({o.name for n in models for o in found[n].outcome.ravel()})))
    whole = found.predicted(models)
    total = held(whole.data, data.data, 1e-5)
    off = max(float(np.abs(np.abs(found[n].jones[..., 0, 0]) - 1).max()) for n in models)
    return both(total, claim(off < 1e-3, f"the split is off by {off:.1e}, and said to have converged"))


@case(
    "39",
    "calibrators",
    "a model that lacks a source of 1e-5",
    "gains off by the first-order answer, to 1e-3",
)
def ghost(calibrator: Calibrator) -> Answer:
    """To first order g_a + g_b* = what is missing on each baseline over the model: solved beside, by SVD."""
    array = small_array(STATIONS)
    sky = points([2.15, 2.17], [0.84, 0.85], [[1, 0, 0, 0], [1e-5, 0, 0, 0]])
    data, model = (observed(array, s, 1) for s in (sky, sky.select([0])))
    tight = changed(calibrator, pattern="scalar").with_fields(tolerance=1e-12)
    found = tight.solve(data, model)
    due = np.broadcast_to(np.eye(2, dtype=complex), found.jones.shape)
    off = found.aligned(to=due).jones[0, 0, :, 0, 0] - 1
    ratio = (data.data / np.where(model.data == 0, 1, model.data))[0, 0, :, 0, 0] - 1
    a, b = model.antenna1, model.antenna2
    rows = np.zeros((2 * len(a), 2 * STATIONS))
    for k, (p, q) in enumerate(zip(a, b, strict=True)):
        rows[2 * k, [p, q]] = 1
        rows[2 * k + 1, STATIONS + p], rows[2 * k + 1, STATIONS + q] = 1, -1
    first = np.linalg.lstsq(rows, np.stack([ratio.real, ratio.imag], axis=1).ravel(), rcond=None)[0]
    wanted = first[:STATIONS] + 1j * first[STATIONS:]
    return held(off - 1j * off.imag.mean(), wanted, 1e-3, condition=float(np.linalg.cond(rows[:, :STATIONS])))
