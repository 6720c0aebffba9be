"""Cases of Mueller matrices, cross-polarization, and the error parameters of stations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from instrument import mat2
from instrument.analyze.ixr import ixr_of_leakage, leakage_of_ixr, removal_table
from instrument.calibrate.di_errors import NAMES, compare
from instrument.jones import mueller
from instrument.precision import truth
from instrument.stress.bench import observed, points, small_array
from instrument.stress.case import Answer, both, case, held

STOKES = np.array([[9, 1, 0, 0.5], [3, 0, -0.5, 0], [1, 0.2, 0.1, 0.1], [-2, 0, 0, 0.3], [0.5, 0, 0, 0]])


@case(
    "L3",
    "photometry",
    "sixteen entries of a Mueller matrix",
    "Stokes of J_a B J_b^H for each Stokes parameter, to 1e-14",
)
def sixteen(_: None) -> Answer:
    """Random matrices; first-order parameters fall as the square of the errors; their seven sums by hand."""
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(2, 50, 2, 2, 2)).view(complex)[..., 0]
    columns = []
    for k in range(4):
        i, q, u_, v = np.eye(4)[k]
        bright = truth.matrix(i + q, u_ + truth.I * v, u_ - truth.I * v, i - q)
        x = truth.product(truth.product(a, bright), truth.herm(b))
        pp, pq, qp, qq = x[..., 0, 0], x[..., 0, 1], x[..., 1, 0], x[..., 1, 1]
        columns.append(np.stack([(pp + qq) / 2, (pp - qq) / 2, (pq + qp) / 2, (pq - qp) / 2j], -1))
    due = np.stack(columns, -1).astype(complex)
    answers = [held(mueller.mueller(a, b), due, 1e-14)]
    sizes = []
    for small in (1e-2, 1e-3):
        one, two = np.eye(2) + small * a, np.eye(2) + small * b
        first = mueller.di_errors(one, two).first_order_mueller()
        sizes.append(float(np.abs(first - mueller.mueller(one, two)).max()))
    slope = np.log10(sizes[0] / sizes[1])
    linear, circular = mueller.leakage(due)
    m = np.abs(due)
    answers += [
        Answer(abs(slope - 2), 0.05),
        held(linear, np.hypot(m[:, 1, 0], m[:, 2, 0]) / m[:, 0, 0], 1e-13),
        held(circular, m[:, 3, 0] / m[:, 0, 0], 1e-13),
        held(mueller.stokes(mueller.brightness(STOKES)), STOKES, 1e-15),
    ]
    values = np.linalg.svd(a, compute_uv=False)
    high, low = mat2.singular_values(a)
    kappa = values[:, 0] / values[:, 1]
    answers += [
        held(high, values[:, 0], 1e-13),
        held(low / values[:, 1], np.ones(50), 1e-11),
        held(mueller.ixr_jones(a), ((kappa + 1) / (kappa - 1)) ** 2, 1e-10),
        held(mueller.ixr_mueller(a), (kappa**2 + 1) / (kappa**2 - 1), 1e-10),
        held(mat2.inverse(a), np.linalg.inv(a), 1e-11),
        held(mat2.det(a), np.linalg.det(a), 1e-13),
        held(mat2.sandwich(a, b, a), a @ b @ np.conj(np.swapaxes(a, 1, 2)), 1e-13),
    ]
    from scipy.linalg import expm

    return both(
        *answers, held(mat2.exponential(a), expm(a), 1e-13), held(mat2.exponential(1e-7 * a), expm(1e-7 * a), 1e-15)
    )


@case(
    "L4", "photometry", "IXR of a leakage, and back", "1/d and ((1 + sqrt(1 - d^2)) / d)^2; 70 % off 25 dB is 30.2 dB"
)
def decibels(_: None) -> Answer:
    """The paper prints 35 dB."""
    d = np.array([1e-9, 0.003, 0.3, 1.0])
    jones = ((1 + np.sqrt((1 - d) * (1 + d))) / d) ** 2
    table = removal_table(25.0, (0.0, 0.7))
    left = 10**-2.5 * 0.3
    return both(
        held(ixr_of_leakage(d), -10 * np.log10(d), 1e-14),
        held(ixr_of_leakage(d, "jones"), 10 * np.log10(jones), 1e-14),
        held(leakage_of_ixr(ixr_of_leakage(d)), d, 1e-13),
        held(leakage_of_ixr(ixr_of_leakage(d, "jones"), "jones"), d, 1e-13),
        held(table["ixr_m_db"], [25.0, 30.2287874528], 1e-11),
        held(table["leakage_percent"], [100 * 10**-2.5, 100 * left], 1e-13),
        held(table["power_left"], [1.0, 0.09], 1e-13),
        held(table["removed_percent"], [0, 70], 1e-13),
    )


@case("L5", "photometry", "errors of a solution that is the truth", "differences 0; those of the input by hand, in %")
def seven(_: None) -> Answer:
    """And of one that is 1 everywhere: linear as the input, quadratic by its Mueller matrices."""
    from instrument.calibrate.selfcal import SelfCal

    model = observed(small_array(6), points([2.15, 2.17], [0.84, 0.85], STOKES[:2]), 2)
    rng = np.random.default_rng(3)
    errors = 1e-3 * rng.normal(size=(1, 1, 6, 2, 2, 2)).view(complex)[..., 0]
    jones = np.asarray(np.eye(2) + np.repeat(errors, 2, 0), complex)
    a, b = model.antenna1, model.antenna2
    data = model.with_data(mat2.sandwich(jones[:, :, a], model.data, jones[:, :, b]))
    found = SelfCal(tolerance=1e-12).solve(data, model)
    good = compare(jones, found, a, b, 1e-3)
    ga, gb = errors[0, 0, a], np.conj(errors[0, 0, b])
    due = {
        "s": ga[:, 0, 0] + ga[:, 1, 1] + gb[:, 0, 0] + gb[:, 1, 1],
        "iq": ga[:, 0, 0] - ga[:, 1, 1] + gb[:, 0, 0] - gb[:, 1, 1],
        "uv": ga[:, 0, 0] - ga[:, 1, 1] - gb[:, 0, 0] + gb[:, 1, 1],
        "iu": ga[:, 0, 1] + ga[:, 1, 0] + gb[:, 0, 1] + gb[:, 1, 0],
        "qu": ga[:, 0, 1] - ga[:, 1, 0] + gb[:, 0, 1] - gb[:, 1, 0],
        "iv": ga[:, 0, 1] - ga[:, 1, 0] - gb[:, 0, 1] + gb[:, 1, 0],
        "qv": ga[:, 0, 1] + ga[:, 1, 0] - gb[:, 0, 1] - gb[:, 1, 0],
    }
    ones = np.broadcast_to(np.eye(2, dtype=complex), found.jones.shape)
    nothing = replace(found, term=found.term.with_fields(values=ones))
    bad = compare(jones, nothing, a, b, 1e-3)
    rms = [100 * np.sqrt((np.abs(due[n]) ** 2).mean()) / 1e-3 for n in NAMES]
    m = mueller.mueller(errors[0, 0, a], errors[0, 0, b])
    entries = [(0, 0), (0, 1), (3, 2), (0, 2), (1, 2), (0, 3), (3, 1)]
    square = [100 * np.sqrt((np.abs(2 * m[:, i, j]) ** 2).mean()) / 1e-3 for i, j in entries]
    input_, off = good.linear["input"], good.linear["difference, aligned"]
    return both(
        held([input_[n] for n in NAMES], rms, 1e-11),
        held([off[n] for n in NAMES], np.zeros(7), 1e-3, scale=1.0),
        held([bad.linear["difference, raw"][n] for n in NAMES], rms, 1e-11),
        held([bad.quadratic["difference, raw"][n] for n in NAMES], square, 1e-11),
    )
