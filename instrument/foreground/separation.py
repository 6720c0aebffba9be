"""Separation: what a remover found in maps, as a foreground or as an operator over channels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instrument.checked import checked
from instrument.errors import Outcome
from instrument.shown import short_repr
from instrument.units import Float


@checked
@dataclass(frozen=True, eq=False)
class Separation:
    """What a remover found in maps (F, Ny, Nx): how it ended, one line about it, the foreground in one of two forms.

    Either `foreground` (F, Ny, Nx) itself, or an `operator` (F, F) with foreground = operator @ maps + `offset` (F,);
    `basis` (F, n) are orthonormal spectra with operator = basis basis^T, where there are.
    `mixing` (F, n) are the spectra of `components` (n, Ny, Nx); n may be 0. `adapted` is whether the operator was
    chosen by looking at the maps: the score then has to measure how much of the noise was fitted. `covariance` (F, F)
    is the posterior covariance of the foreground of a pixel, where there is one.
    """

    __repr__ = short_repr
    outcome: Outcome
    remark: str
    mixing: Float
    components: Any
    foreground: Any = None
    operator: Float | None = None
    basis: Float | None = None
    offset: Float | None = None
    adapted: bool = True
    covariance: Float | None = None

    @classmethod
    def nothing(cls, maps: NDArray[Any], outcome: Outcome, remark: str) -> Separation:
        """No foreground at all: the residual is the data."""
        f = len(maps)
        none = np.zeros((0, *maps.shape[1:]), maps.dtype)
        return cls(outcome, remark, np.zeros((f, 0)), none, operator=np.zeros((f, f)), adapted=False)

    def of(self, maps: Any) -> Any:
        """The foreground in these maps (F, Ny, Nx), in their precision."""
        if self.foreground is not None:
            return self.foreground
        assert self.operator is not None, "a Separation needs its foreground or an operator"
        if self.basis is not None and 0 < self.basis.shape[1] < len(maps) // 2:
            out = apply(self.basis, apply(self.basis.T, maps))  # 2 n instead of F products a voxel
        else:
            out = apply(self.operator, maps)
        if self.offset is not None:
            out += self.offset.astype(out.dtype)[:, None, None] * maps.any(axis=0)
        return out


def apply(matrix: Any, maps: Any) -> Any:
    """matrix @ maps over the channels (n, Ny, Nx), in the precision of the maps."""
    flat = maps.reshape(len(maps), -1)
    return (matrix.astype(flat.dtype) @ flat).reshape(len(matrix), *maps.shape[1:])
