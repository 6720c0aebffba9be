"""Standard errors of gains and of common directions, from the normal matrix of an interval and what is left over."""

from __future__ import annotations

import numpy as np
from scipy.linalg import lapack

from instrument.calibrate.factor import Factor
from instrument.units import Bool, Complex, Float


def gain_errors(
    factor: Factor, jones: Complex, basis: Float, directions: Complex, free: Bool, most: float, each: bool = True
) -> tuple[Float, Float]:
    """Of every gain (A, 2, 2) and along common `directions` (n, 2, 2), for noise of variance 1 per real number.

    factor of the normal matrix of steps jones_a exp(e_a), whose R is used up; jones (A, 2, 2), basis (8, k) their real
    coordinates. That of a direction is of y in exp(sum_k y_k G_k), as the data alone have it without a prior, and
    infinite where it is `free` (n,), or above ten times what the prior holds it to. That of a gain is the rms of its
    real and its imaginary part, without what it has along directions that are free or whose error is above `most`; NaN
    unless `each`. What a prior P of weight w pulls is no noise: the covariance is A - w A P^T P A for A the inverse.
    """
    stations, size = len(jones), basis.shape[1]
    turn = _left(jones) @ basis  # (A, 8, k): of e to J e
    tangents = np.einsum("aij,njk->naik", jones, directions).reshape(len(directions), stations, 4)
    real = np.ascontiguousarray(tangents).view(float)  # (n, A, 8)
    right = np.einsum("nax,axk->nak", real, turn).reshape(len(directions), -1)
    flat = real.reshape(len(right), -1)
    gram = flat @ flat.T
    back = np.linalg.pinv(gram, hermitian=True)

    along = np.einsum("nak,axk->nax", factor.solve(right.T).T.reshape(len(right), stations, size), turn)
    common = back @ flat @ along.reshape(len(right), -1).T @ back
    alone = _without_prior(common, factor.now, free)
    if not each:
        return np.full(jones.shape, np.nan), np.sqrt(alone)
    variance = ((turn @ _own_blocks(factor, stations)) * turn).sum(axis=2)
    # what a prior adds to the inverse as it weakens, and what it pulls
    grown = factor.grown()
    beside = np.einsum("akn,axk->nax", factor.back.reshape(stations, size, -1), turn)
    # no more than all of it, where noise bends the data the other way
    pulled = grown * np.minimum(factor.now * grown, 1 / np.maximum(factor.values, 1e-300))
    variance += np.einsum("n,nax->ax", (factor.weight - factor.now) * grown - pulled, beside**2)
    along = along - np.einsum("nm,max->nax", right @ factor.back * pulled, beside)
    both = flat @ along.reshape(len(right), -1).T
    few = alone > most**2
    near = np.linalg.pinv(gram[np.ix_(few, few)], hermitian=True)
    once = (real[few] * np.tensordot(near, along[few], 1)).sum(axis=0)
    twice = (real[few] * np.tensordot(near @ both[np.ix_(few, few)] @ near, real[few], 1)).sum(axis=0)
    variance = np.maximum(variance - 2 * once + twice, 0.0).reshape(stations, 2, 2, 2).mean(axis=3)
    return np.sqrt(variance), np.sqrt(alone)


def _without_prior(common: Float, weight: float, free: Bool) -> Float:
    """Variances (n,) along directions as the data alone have them, of covariances (n, n) with a prior of a weight.

    Where the prior has 100 times the weight of the data, or noise bends them the other way, they are infinite.
    """
    out = np.full(len(common), np.inf)
    if free.all():
        return out
    known = np.linalg.pinv(common[np.ix_(~free, ~free)], hermitian=True)
    values, vectors = np.linalg.eigh(known - weight * np.eye(len(known)))
    least = max(0.01 * weight, 1e-300)
    variances = vectors**2 @ (1 / np.maximum(values, least))
    out[~free] = np.where(vectors**2 @ (values < least) > 0.5, np.inf, variances)
    return out


def _own_blocks(factor: Factor, stations: int) -> Float:
    """Blocks of stations on the diagonal of (R^T R)^-1, (A, k, k)."""
    inverse, _ = lapack.dtrtri(factor.upper, lower=0, overwrite_c=1)
    size = len(inverse) // stations
    own, lower = np.empty((stations, size, size)), np.tril_indices(size, -1)
    for a in range(stations):  # below the diagonal nothing was written
        rows = np.array(inverse[a * size : (a + 1) * size, a * size :])
        rows[lower] = 0.0
        own[a] = rows @ rows.T
    return own


def _left(jones: Complex) -> Float:
    """Real matrices (A, 8, 8) of e -> J e, in re and im of 00, 01, 10, 11."""
    out = np.zeros((len(jones), 2, 2, 2, 2, 2, 2))  # i, k, part of J e; j, k, part of e
    for k in range(2):
        out[:, :, k, 0, :, k, 0] = out[:, :, k, 1, :, k, 1] = jones.real
        out[:, :, k, 0, :, k, 1], out[:, :, k, 1, :, k, 0] = -jones.imag, jones.imag
    return out.reshape(len(jones), 8, 8)
