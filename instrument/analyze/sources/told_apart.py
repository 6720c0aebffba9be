"""Normal equations solved, with errors or by iteration, and whether sources are told apart by an array."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from instrument.errors import Outcome
from instrument.patience import Patience
from instrument.units import Float, Int

NEAR = 3e-9  # reciprocal condition of the PSF matrix below which sources are not told apart
CLOSE = 1e-4  # of 1 / longest baseline in wavelengths: sources nearer than this cannot be told apart


def positive_solve(matrix: Float, right: Float) -> tuple[Float, Float] | None:
    """matrix^-1 right and the diagonal of matrix^-1 by Cholesky; `None` where the matrix, overwritten, is singular.

    That is below 3e-9: two sources nearer than 5e-5 of the beam, the errors of which are 1e4 times those of one.
    """
    from scipy.linalg import LinAlgError, cho_factor, cho_solve, lapack

    # parts of a patch that nearly cancel make its row large: that alone is no singularity
    scale = np.sqrt(matrix.diagonal())
    if not np.all(scale > 0):
        return None
    matrix /= scale
    matrix /= scale[:, None]
    size = max(float(np.abs(matrix[:, k : k + 256]).sum(axis=0).max()) for k in range(0, len(matrix), 256))
    try:
        factor = cho_factor(matrix, lower=True)
    except LinAlgError:
        return None
    reciprocal, _ = lapack.dpocon(factor[0], size, uplo="L")
    if reciprocal < NEAR:
        return None
    found = cho_solve(factor, right / scale[:, None]) / scale[:, None]
    inverse, _ = lapack.dpotri(factor[0], lower=1, overwrite_c=1)
    return found, inverse.diagonal() / scale**2


def mirrored(matrix: Float, rows: int) -> None:
    """Fill the lower half of a matrix (S, S) from its upper one, some rows at a time: 4571 sources are 167 MB."""
    for first in range(0, len(matrix), rows):
        some = slice(first, first + rows)
        square = np.triu(matrix[some, some])
        matrix[some, some] = square + np.triu(square, 1).T
        matrix[some, :first] = matrix[:first, some].T


def conjugate_gradients(
    normal: Callable[[Float], Float], right: Float, flux: Float, accuracy: float, iterations: int
) -> tuple[Float, Outcome, int]:
    """normal(f) = right (G, 4) for the four Stokes parameters at once, each with its own step, from a first `flux`."""
    residual = right - normal(flux)
    direction, power = residual.copy(), (residual**2).sum(axis=0)
    target, patience = accuracy**2 * (right**2).sum(axis=0).max(), Patience()
    for count in range(1, iterations + 1):
        if np.all(power <= target):
            return flux, Outcome.CONVERGED, count
        if patience.lost(power.max())[0]:
            return flux, Outcome.ITERATION_LIMIT, count
        image = normal(direction)
        curve = (direction * image).sum(axis=0)
        step = np.divide(power, curve, out=np.zeros(4), where=curve > 0)
        flux = flux + step * direction
        residual = residual - step * image
        new = (residual**2).sum(axis=0)
        direction = residual + np.divide(new, power, out=np.zeros(4), where=power > 0) * direction
        power = new
    return flux, Outcome.ITERATION_LIMIT, iterations


def coincide(where: Float, longest: float, group: Int, mix: Float) -> bool:
    """Whether groups of sources at the same places, with the same shapes, are linearly dependent.

    `where` (S, 9) are l, m, n and the axes of each source, `longest` the longest baseline in wavelengths, `group` (S,)
    and `mix` (S,) the group of each source and its share in it.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    sources, count = len(group), int(group.max()) + 1
    if longest == 0:
        return count > 1
    near = KDTree(where).query_pairs(CLOSE / longest, output_type="ndarray")
    places = connected_components(coo_matrix((np.ones(len(near)), near.T), (sources, sources)))[1]
    groups = np.unique(group[near])
    shares = coo_matrix((mix, (group, places)), (count, sources)).tocsr()[groups]
    if len(groups) < 2 or len(groups) > len(np.unique(shares.indices)):
        return len(groups) > 1
    gram = (shares @ shares.T).toarray()
    scale = np.sqrt(gram.diagonal())
    return bool(np.linalg.eigvalsh(gram / scale / scale[:, None])[0] < 1e-9)
