"""The graph of the baselines that count: which stations they tie together, and what they leave open.

Where J_a M_ab J_b^H is all that is measured, stations in different pieces of the graph know nothing of each other, and
in a piece whose cycles are all even (two groups, baselines between them only; a tree) J -> J X in one group and
J -> J X^-H in the other fits as well: only an odd cycle fixes amplitudes. Phases alone need one piece, of any shape.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.calibrate.gauge import BLIND, GENERATORS, common_form
from instrument.units import Bool, Complex, Float, Int

ROUNDING = 1e-24  # of the largest power: a model of less on a baseline is zero but for rounding


def counted(power: Float) -> Bool:
    """Which powers (L, B) or (L, B, 2, 2), of weighted models, are more than rounding."""
    top = power.reshape(len(power), -1).max(axis=1, initial=0.0)
    return np.asarray(power > ROUNDING * top.reshape(-1, *[1] * (power.ndim - 1)))


def tied(used: Bool, a1: Int, a2: Int, stations: int, pattern: str) -> Bool:
    """Stations (L, A) whose matrices the baselines fix but for a matrix common to all; used (L, B, 2, 2) correlations.

    Of several pieces the one with most stations counts, if it holds more than half of the stations that have data.
    """
    if len(used) > 1 and np.all(used == used[:1]):  # as a rule
        return np.repeat(tied(used[:1], a1, a2, stations, pattern), len(used), axis=0)
    apart = pattern in ("diagonal", "phase")  # each receptor is a node: correlations pq and qp tie the two together
    nodes = 2 if apart else 1
    links = np.zeros((len(used), stations, nodes, stations, nodes), bool)
    own: Any = used if apart else np.asarray(used.any(axis=(-2, -1)))[..., None, None]
    links[:, a1, :, a2, :] = np.moveaxis(own, 1, 0)
    links |= links.transpose(0, 3, 4, 1, 2)
    active: Bool = np.asarray(links.any(axis=(2, 3, 4)))
    out = active.copy()
    known: dict[bytes, Bool] = {}
    missing = active[:, :, None] & active[:, None, :] & ~np.eye(stations, dtype=bool)
    whole = np.all(links[:, :, range(nodes), :, range(nodes)] | ~missing, axis=(0, 2, 3)) & (active.sum(axis=1) > 2)
    for k in np.flatnonzero(~whole & active.any(axis=1)):
        key = links[k].tobytes()
        if key not in known:
            known[key] = _main(links[k], active[k], pattern != "phase")
        out[k] = known[key]
    return out


def _main(links: Bool, active: Bool, odd: bool) -> Bool:
    """Stations (A,) of the piece that is determined, of links (A, n, A, n); none where it has no more than half."""
    from scipy.sparse import bmat, csr_array
    from scipy.sparse.csgraph import connected_components

    stations, nodes = links.shape[:2]
    flat = csr_array(links.reshape(stations * nodes, -1))
    piece = connected_components(flat)[1].reshape(stations, nodes)
    # the double cover: i and its twin are in one piece where an odd walk leads from i back to i
    twice = connected_components(bmat([[None, flat], [flat, None]]))[1].reshape(2, stations, nodes)
    good = (twice[0] == twice[1]) | (not odd)
    out = active & good.all(axis=1)
    for receptor in range(nodes):
        names, size = np.unique(piece[out, receptor], return_counts=True)
        if len(names):
            out &= piece[:, receptor] == names[np.argmax(size)]
    return out if 2 * out.sum() > active.sum() else np.zeros_like(out)


def freedom(model: Complex, weight: Float, a1: Int, a2: Int, stations: int) -> tuple[int, int]:
    """Real parameters that model (N, 2, 2) with weights (N,), N samples of all baselines, leaves open: all, common.

    For matrices without a pattern, at the identity (any other regular matrices leave the same open). Each baseline has
    unit power here: what is open does not depend on it.
    """
    m = model.reshape(-1, len(a1), 4).swapaxes(0, 1)
    moment = np.einsum("bn,bni,bnj->bij", weight.reshape(-1, len(a1)).T, m, m.conj())
    power = np.einsum("bii->b", moment).real
    use = power > ROUNDING * power.max(initial=0.0)
    moment, a, b = moment[use] / power[use, None, None], a1[use], a2[use]
    generators, eye = GENERATORS["full"], np.eye(2)
    left = np.stack([np.kron(g, eye) for g in generators])  # of G M, M read row-wise
    right = np.stack([np.kron(eye, g.conj()) for g in generators])  # of M G^H
    normal: Any = np.zeros((stations, 8, stations, 8))
    ends: tuple[Any, ...] = ((a, left), (b, right))
    for one, first in ends:
        for other, second in ends:
            block = np.einsum("iba,jbc,nca->nij", first.conj(), second, moment, optimize=True).real
            for i, j, part in zip(one, other, block, strict=True):
                normal[i, :, j] += part
    seen = np.flatnonzero(np.einsum("aiai->a", normal) > 0)
    size = 8 * len(seen)
    values = np.linalg.eigvalsh(normal[seen][:, :, seen].reshape(size, size))
    common = np.linalg.eigvalsh(common_form(moment.sum(axis=0) / max(len(moment), 1), "full"))
    return int((values <= BLIND).sum()), int((common <= BLIND).sum())
