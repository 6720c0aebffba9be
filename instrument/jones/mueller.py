"""Mueller matrices of baselines, the seven direction-independent error parameters, and the IXR."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from instrument import mat2
from instrument.checked import checked
from instrument.units import Complex, Float

# vec(B) row-wise (pp, pq, qp, qq) of Stokes (I, Q, U, V), for B = [[I+Q, U+iV], [U-iV, I-Q]]
TO_LINEAR: Complex = np.array([[1, 1, 0, 0], [0, 0, 1, 1j], [0, 0, 1, -1j], [1, -1, 0, 0]])
TO_STOKES: Complex = np.linalg.inv(TO_LINEAR)
TO_LINEAR.setflags(write=False)
TO_STOKES.setflags(write=False)


@checked
def brightness(stokes: Float) -> Complex:
    """Brightness matrices (..., 2, 2) of Stokes I, Q, U, V (..., 4): [[I+Q, U+iV], [U-iV, I-Q]]."""
    i, q, u, v = np.moveaxis(np.asarray(stokes, float), -1, 0)
    return mat2.pack(i + q, u + 1j * v, u - 1j * v, i - q)


@checked
def stokes(matrices: Complex) -> Complex:
    """Stokes (..., 4), complex, of 2x2 matrices: I = (pp+qq)/2, Q = (pp-qq)/2, U = (pq+qp)/2, V = (pq-qp)/2i."""
    pp, pq, qp, qq = (matrices[..., i, j] for i in range(2) for j in range(2))
    return np.stack([(pp + qq) / 2, (pp - qq) / 2, (pq + qp) / 2, (pq - qp) / 2j], axis=-1)


@checked
def mueller(jones_a: Complex, jones_b: Complex) -> Complex:
    """Mueller matrices S^-1 (J_a kron conj(J_b)) S, complex (..., 4, 4); real where both stations share one Jones.

    conj(J_b), not J_b^H: with the transpose the circular leakage is wrong by 4 to 16 %.
    """
    a, b = np.broadcast_arrays(jones_a, np.conj(jones_b))
    kron = np.einsum("...ij,...kl->...ikjl", a, b).reshape(*a.shape[:-2], 4, 4)
    return np.asarray(TO_STOKES @ kron @ TO_LINEAR)


@dataclass(frozen=True)
class DIErrors:
    """The seven direction-independent error parameters of a baseline (Sault, Hamaker & Bregman 1996), complex (...).

    For J = [[1+g_p, e_p], [-e_q, 1+g_q]] of stations a and b: `s` and `iq` from the sum and the difference of the
    gains, `iu` and `qu` from e_p -+ e_q with the conjugate of b added, `uv`, `qv` and `iv` with it subtracted.
    """

    s: Complex
    iq: Complex
    uv: Complex
    iu: Complex
    qu: Complex
    iv: Complex
    qv: Complex

    def first_order_mueller(self) -> Complex:
        """Mueller matrix to first order in the errors, (..., 4, 4); the error falls as their square.

        Row V, column Q is +i delta_QV / 2 (the published table prints it without the i).
        """
        s, iq, uv, iu, qu, iv, qv = np.broadcast_arrays(self.s, self.iq, self.uv, self.iu, self.qu, self.iv, self.qv)
        out = np.empty((*s.shape, 4, 4), complex)
        rows = (
            (s, iq, iu, -1j * iv),
            (iq, s, qu, -1j * qv),
            (iu, -qu, s, 1j * uv),
            (-1j * iv, 1j * qv, -1j * uv, s),
        )
        for i, row in enumerate(rows):
            for j, entry in enumerate(row):
                out[..., i, j] = entry / 2
        return np.asarray(out + np.eye(4))


@checked
def di_errors(jones_a: Complex, jones_b: Complex) -> DIErrors:
    """The seven parameters of baselines from the Jones matrices (..., 2, 2) of their stations, errors about 1."""

    def parts(j: Complex) -> tuple[Complex, Complex, Complex, Complex]:
        return j[..., 0, 0] - 1, j[..., 1, 1] - 1, j[..., 0, 1], -j[..., 1, 0]

    ap, aq, ea_p, ea_q = parts(jones_a)
    bp, bq, eb_p, eb_q = (x.conj() for x in parts(jones_b))
    return DIErrors(
        s=ap + aq + bp + bq,
        iq=ap - aq + bp - bq,
        uv=ap - aq - bp + bq,
        iu=ea_p - ea_q + eb_p - eb_q,
        qu=ea_p + ea_q + eb_p + eb_q,
        iv=ea_p + ea_q - eb_p - eb_q,
        qv=ea_p - ea_q - eb_p + eb_q,
    )


@checked
def ixr_jones(jones: Complex) -> Float:
    """Intrinsic cross-polarization ratio ((k+1)/(k-1))^2, k the condition number of J (Carozzi & Woan 2011).

    Infinity for a multiple of a unitary matrix, 1 for a singular one.
    """
    high, low = mat2.singular_values(jones)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(high > low, ((high + low) / (high - low)) ** 2, np.inf))


@checked
def ixr_mueller(jones: Complex) -> Float:
    """Mueller IXR (k^2+1)/(k^2-1) of a station's Jones matrix: the inverse of its largest leakage from I."""
    high, low = mat2.singular_values(jones)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(high > low, (high**2 + low**2) / (high**2 - low**2), np.inf))


@checked
def leakage(matrices: Complex) -> tuple[Float, Float]:
    """Leakage of I into linear and circular polarization, fractions of M11 (...), of Mueller matrices (..., 4, 4)."""
    m11 = np.abs(matrices[..., 0, 0])
    linear = np.sqrt(np.abs(matrices[..., 1, 0]) ** 2 + np.abs(matrices[..., 2, 0]) ** 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        return linear / m11, np.abs(matrices[..., 3, 0]) / m11
