"""Pairs of antennas among the baselines of a problem, in any order and either way round."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument import mat2
from instrument.errors import InputError
from instrument.predict.base import Problem
from instrument.units import Complex, Int


def picked(problem: Problem, data: Complex, pairs: tuple[Int, Int]) -> Complex:
    """Of the data of all baselines (T, F, B, 2, 2), those of pairs, V_ba = V_ab^H."""
    rows, turned = _rows(problem, pairs)
    out = data[:, :, rows]
    out[:, :, turned] = mat2.herm(out[:, :, turned])
    return out


def placed(problem: Problem, data: Complex, pairs: tuple[Int, Int]) -> Complex:
    """The adjoint of `picked`: data of pairs added where their baselines are among all (T, F, B, 2, 2)."""
    rows, turned = _rows(problem, pairs)
    data = np.array(data)
    data[:, :, turned] = mat2.herm(data[:, :, turned])
    out = np.zeros((*data.shape[:2], problem.shape[2], 2, 2), complex)
    for k, row in enumerate(rows):  # the same baseline may come twice
        out[:, :, row] += data[:, :, k]
    return out


def _rows(problem: Problem, pairs: tuple[Int, Int]) -> tuple[Int, Any]:
    """Where pairs are among the baselines, and which stand the other way round; raises where one is not there."""
    one, other = (np.asarray(p) for p in pairs)
    names = problem.at.layout.names
    place = np.full((len(names), len(names)), -1)
    place[problem.antenna1, problem.antenna2] = np.arange(problem.shape[2])
    turned = place[one, other] < 0
    rows = np.where(turned, place[other, one], place[one, other])
    if (rows < 0).any():
        k = int(np.argmax(rows < 0))
        raise InputError(
            f"the operator has no baseline between {names[one[k]]} and {names[other[k]]}: prepare it for all baselines "
            "of the visibilities (a plan leaves out those beyond its uv_range)"
        )
    return rows, turned
