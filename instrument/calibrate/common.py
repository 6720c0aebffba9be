"""What all stations have in common: the few directions J_a exp(G) that data see hardly at all, and a prior on them."""

from __future__ import annotations

import numpy as np

from instrument.calibrate.gauge import BLIND, GENERATORS, HELD_TO, UNKNOWNS, common_form, second_moment
from instrument.units import Bool, Complex, Float, Int

WEAK = 0.1  # share of the model's power below which sweeps and averages do not find a common direction


class CommonPart:
    """Common matrices exp(sum_k y_k G_k) of some lanes (L), (L, A) tied stations, (L,) samples.

    Through beams the data see some of them with 1e-8 of their power: a step J (1 + y G) leaves the data by y², of which
    they see more than of y itself, and noise moves y without end. So steps are exponentials, and y, the least-squares
    projection of J - J_start onto J_start G, has a prior of standard deviation `HELD_TO`. Its weight s² / `HELD_TO`² is
    taken from what is left of the data, s² per real number: without noise there is no prior.
    """

    def __init__(self, model: Complex, total: Float, active: Bool, samples: Int, pattern: str) -> None:
        moment = second_moment(model)
        self.generators = GENERATORS[pattern]
        self.form, self.model_power = common_form(moment, pattern), np.einsum("lii->l", moment).real
        self.eigen = np.linalg.eigh(self.form)
        self.active = active
        self.total = np.maximum(total, 1e-300)
        self.unknowns = UNKNOWNS[pattern] * active.sum(axis=1)
        self.freedom = np.maximum(8 * samples - self.unknowns, 1)
        power = np.where(self.model_power > 0, self.model_power, 1.0)[:, None]
        self.free, below = self.eigen[0] <= BLIND * power, self.eigen[0] <= WEAK * power
        self.weak = below & ~self.free
        # onto those that data hardly see
        self.hidden = np.einsum("lik,lk,ljk->lij", self.eigen[1], below | self.free, self.eigen[1])

    def begin(self, start: Complex) -> None:
        """Hold the common directions near matrices (L, A, 2, 2)."""
        self.start = start.copy()
        tangents = np.einsum("laij,njk->lnaik", start, self.generators)
        flat = tangents.reshape(*self.form.shape[:2], -1)
        gram = (flat.conj() @ np.swapaxes(flat, 1, 2)).real
        size = np.trace(gram, axis1=1, axis2=2)[:, None, None]
        gram = gram / np.where(size > 0, size, 1.0) + 1e-12 * np.eye(gram.shape[1])
        back = np.where(size > 0, np.linalg.inv(gram) / np.where(size > 0, size, 1.0), 0.0)
        # y of J is the real part of sum conj(tangents) (J - start)
        self.tangents = (back @ flat).reshape(tangents.shape)
        self.weight = np.full(len(start), np.inf)

    def moved(self, lane: int, jones: Complex) -> Float:
        """How far matrices (A, 2, 2) of a lane have gone from the start along each common direction, y (n,)."""
        apart = (jones - self.start[lane]).reshape(-1)
        return np.asarray((self.tangents[lane].reshape(-1, len(apart)).conj() @ apart).real)

    def moves(self, lane: int, jones: Complex) -> Float:
        """What steps J_a exp(e_a) of (A, 2, 2) do to `moved` of a lane, (n, 8 A): re, im of e00, e01, e10, e11."""
        each = np.conj(np.swapaxes(jones, 1, 2)) @ self.tangents[lane]
        return np.ascontiguousarray(each).reshape(len(each), -1).view(float)

    def weigh(self, lane: int, share: float) -> float:
        """The weight of the prior of a lane, lowered to what a share of the data's power that is left makes of it."""
        found = max(share, 0.0) * self.total[lane] / self.freedom[lane] / HELD_TO**2
        self.weight[lane] = min(self.weight[lane], found)
        return float(self.weight[lane])
