"""Gauge: matrices X common to all stations that a model cannot see, J_a X M_ab X^H J_b^H = J_a M_ab J_b^H."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np

from instrument.units import Complex, Float

_SIGMA = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, -1j], [1j, 0]]], complex)
# generators G of X = exp(G) that keep the pattern of the station matrices: 8, 4, 2 or 2 real directions
GENERATORS: dict[str, Complex] = {
    "full": np.concatenate([1j * _SIGMA, _SIGMA]),
    "diagonal": np.concatenate([1j * _SIGMA[:2], _SIGMA[:2]]),
    "scalar": np.concatenate([1j * _SIGMA[:1], _SIGMA[:1]]),
    "phase": 1j * _SIGMA[:2],
}
UNKNOWNS = {"full": 8, "diagonal": 4, "scalar": 2, "phase": 2}  # real numbers per station
HELD_TO = 0.3  # standard deviation of the prior on a common direction, about the start: errors of receivers are smaller
BLIND = 1e-12  # share of the model's power that a direction may change and still count as unseen


@dataclass(frozen=True, eq=False)
class Gauge:
    """Null space of a solve: X = exp(sum_k x_k G_k) with G (n, 2, 2), common to all stations.

    `seen` is how strongly the model constrains each common direction, relative to its power, weakest first: exactly
    zero is a gauge freedom, a small number is a direction that noise will fill. Those that noise fills beyond what a
    solve holds near its start are `weak` (m, 2, 2): generators as well, which `nearest` turns along too. `directions`
    (n, 2, 2) are all of them, in the order of `seen`.
    """

    generators: Complex
    seen: Float
    pattern: str
    weak: Complex = field(default_factory=lambda: np.zeros((0, 2, 2), complex))
    directions: Complex = field(default_factory=lambda: np.zeros((0, 2, 2), complex))

    @property
    def count(self) -> int:
        """Number of real parameters that no data can determine."""
        return len(self.generators)

    @property
    def loose(self) -> int:
        """Number of those, and of the directions that are weak."""
        return len(self.generators) + len(self.weak)

    @property
    def unitary(self) -> bool:
        """Whether all of its X are unitary (they are for an unpolarized model)."""
        return bool(np.abs(self.generators + np.conj(np.swapaxes(self.generators, 1, 2))).max(initial=0.0) < 1e-9)

    def __str__(self) -> str:
        many = len(self.weak)
        what = "1 common direction is" if many == 1 else f"{many} common directions are"
        return self._free() + (f"; {what} weaker than the noise, and held near the start" if many else "")

    def _free(self) -> str:
        if self.count == 4 and self.unitary:
            return "free: a unitary matrix common to all stations (the model is unpolarized)"
        names = {
            0: "nothing is left free",
            1: "free: the common phase",
            2: "free: the common phase and one rotation of polarization (the model is polarized along one axis)",
            4: "free: a matrix common to all stations (every source of the model has the same polarization)",
        }
        return names.get(self.count, f"free: {self.count} parameters common to all stations")

    def with_errors(self, error: Float, most: float = HELD_TO) -> tuple[Gauge, dict[tuple[int, int], Gauge]]:
        """This gauge, weak where the error (t, f, n) of a common direction is in the median above `most`.

        And those of the intervals where other directions are: one for each set of them.
        """
        known = np.isfinite(error).any(axis=-1)
        if not known.any():
            return self, {}
        bound = np.arange(len(self.seen)) >= self.count
        usual = (np.median(error[known], axis=0) > most) & bound
        kinds: dict[bytes, Gauge] = {}
        others = {}
        for t, f in np.argwhere(known & (((error > most) & bound) != usual).any(axis=-1)):
            weak = (error[t, f] > most) & bound
            others[int(t), int(f)] = kinds.setdefault(weak.tobytes(), replace(self, weak=self.directions[weak]))
        return replace(self, weak=self.directions[usual]), others

    def nearest(self, jones: Complex, to: Complex) -> Complex:
        """The X (..., 2, 2) of this gauge that brings jones (..., A, 2, 2) nearest to `to`; NaN does not vote."""
        good: Any = np.isfinite(jones).all(axis=(-2, -1)) & np.isfinite(to).all(axis=(-2, -1))
        a, b = (np.where(good[..., None, None], x, 0.0) for x in (jones, to))
        x = np.broadcast_to(np.eye(2, dtype=complex), (*a.shape[:-3], 2, 2)).copy()
        generators = np.concatenate([self.generators, self.weak])
        if not len(generators):
            return x
        if self.count == 4 and self.unitary and not len(self.weak):
            u, _, vh = np.linalg.svd(np.einsum("...aji,...ajk->...ik", a.conj(), b))  # of sum J^H T
            return np.asarray(u @ vh)
        from scipy.linalg import expm

        many, damping, rest = len(generators), np.zeros(x.shape[:-2]), _apart(a, x, b)
        for _ in range(100):  # Levenberg and Marquardt on the few parameters, from the left over of T - J X
            turned = a @ x[..., None, :, :]
            moves = np.einsum("...aij,njk->...naik", turned, generators)
            left = (b - turned)[..., None, :, :, :]
            gradient = np.einsum("...naij,...naij->...n", moves.conj(), np.broadcast_to(left, moves.shape)).real
            gram = np.einsum("...naij,...maij->...nm", moves.conj(), moves).real
            size = np.maximum(np.einsum("...nn->...", gram) / many, 1e-300)
            ridge = ((1e-14 + damping) * size)[..., None, None] * np.eye(many)
            y = np.linalg.solve(gram + ridge, gradient[..., None])[..., 0]
            length = np.linalg.norm(y, axis=-1)
            y = y / np.maximum(length, 1.0)[..., None]  # where matrices are noise, whole steps run away
            tried = x @ expm(np.einsum("...n,nij->...ij", y, generators))
            new = _apart(a, tried, b)
            good = (new <= rest) | (length < 1e-6)
            x, rest = np.where(good[..., None, None], tried, x), np.where(good, new, rest)
            damping = np.where(good, np.where(damping > 1e-6, damping / 10, 0.0), np.maximum(10 * damping, 1e-3))
            if np.max(length) < 1e-13:
                break
        return x


def _apart(jones: Complex, x: Complex, to: Complex) -> Float:
    """Power (...) of T - J X, of matrices (..., A, 2, 2) and X (..., 2, 2)."""
    return np.asarray((np.abs(to - jones @ x[..., None, :, :]) ** 2).sum(axis=(-3, -2, -1)))


def second_moment(model: Complex, weight: Float | None = None) -> Complex:
    """Sum w m m^H (..., 4, 4) of model matrices (..., N, 2, 2) read row-wise, with weights (..., N), 1 by default."""
    m = model.reshape(*model.shape[:-2], 4)
    return np.swapaxes(m if weight is None else m * weight[..., None], -1, -2) @ m.conj()


@cache
def _products(pattern: str) -> Complex:
    """T_i^H T_j of the generators of a pattern, T of M read row-wise, (n, n, 4, 4)."""
    eye = np.eye(2)
    maps = np.stack([np.kron(g, eye) + np.kron(eye, g.conj()) for g in GENERATORS[pattern]])
    return np.asarray(np.einsum("iba,jbc->ijac", maps.conj(), maps))


def common_form(moment: Complex, pattern: str) -> Float:
    """Re sum w tr(T_i^H T_j), T = G M + M G^H: what a common change of all stations does to the model, (..., n, n)."""
    return np.asarray(np.einsum("ijac,...ca->...ij", _products(pattern), moment).real)


def common(form: Float, power: float, pattern: str) -> Gauge:
    """The gauge of a `common_form` (n, n) of a model of some power, for station matrices of a pattern."""
    use = GENERATORS[pattern]
    values, vectors = np.linalg.eigh(form / (power if power > 0 else 1.0))
    directions = np.einsum("kn,kij->nij", vectors, use)
    return Gauge(directions[values <= BLIND], values, pattern, directions=directions)


def free_counts(values: Float, powers: Float) -> Any:
    """How many directions (L,) models of some power leave open, of the eigenvalues (L, n) of their forms."""
    return (values <= BLIND * np.where(powers > 0, powers, 1.0)[:, None]).sum(axis=1)


def gauge_of(model: Complex, weight: Float, pattern: str = "full") -> Gauge:
    """The gauge of a model (T, F, B, 2, 2) with weights (T, F, B), for station matrices of a pattern."""
    with np.errstate(over="ignore", invalid="ignore"):
        moment = second_moment(model.reshape(-1, 2, 2)) if np.all(weight == 1) else np.full((4, 4), np.nan + 0j)
        if not _sound(moment):  # weights, a model that is not finite everywhere, or of 1e170 Jy
            w = np.where(np.isfinite(model).all(axis=(-2, -1)), weight, 0.0).reshape(-1)
            m: Complex = np.where((w > 0)[:, None, None], model.reshape(-1, 2, 2), 0.0 + 0j)
            moment = second_moment(m, w)
            if not _sound(moment):  # near 1: the square of 1e170 Jy is infinite
                size, top = (max(float(np.abs(x).max(initial=0.0)), 1e-300) for x in (m.view(float), w))
                moment = second_moment(m / (size + 0j), w / top)
    return common(common_form(moment, pattern), float(np.trace(moment).real), pattern)


def _sound(moment: Complex) -> bool:
    return bool(np.all(np.isfinite(moment)) and np.trace(moment).real > 1e-200)
