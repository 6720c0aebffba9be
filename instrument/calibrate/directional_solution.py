"""DirectionalSolution: a solution for each cluster of directions, and what of the data it predicts."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from instrument import correlations
from instrument.calibrate.base import Solution
from instrument.errors import InputError, InstrumentError, did_you_mean
from instrument.jones.base import JonesTerm
from instrument.shown import short_repr
from instrument.visibilities import Visibilities

Models = Mapping[str, Visibilities]


@dataclass(frozen=True, eq=False)
class DirectionalSolution:
    """A `Solution` for each cluster, by name: `solution["3C196"].term` is the station term of that direction."""

    __repr__ = short_repr
    clusters: dict[str, Solution]

    def __getitem__(self, name: str) -> Solution:
        if name not in self.clusters:
            raise InputError(f"no cluster '{name}': {did_you_mean(name, self.clusters)}")
        return self.clusters[name]

    def predicted(
        self, models: Models, keep: str | Collection[str] = (), only: str | Collection[str] | None = None
    ) -> Visibilities:
        """The sum of J_a^c M_ab^c J_b^cH over clusters not in `keep`, or of `only` some; flagged where one is missing.

        `models` holds those of the clusters that are summed, at least.
        """
        names = self._chosen(keep, only)
        for name in names:
            if name not in models:
                raise InputError(f"no model of cluster '{name}': {did_you_mean(name, models)}")
        if not models:
            raise InputError("models is empty: give that of one cluster at least, for the coordinates")
        first = models[names[0]] if names else next(iter(models.values()))
        total = replace(first, data=np.zeros_like(first.data, complex))
        for name in names:
            total = _plus(total, models[name], self[name].term)
        return total

    def _chosen(self, keep: str | Collection[str], only: str | Collection[str] | None) -> list[str]:
        """The clusters that are summed; raises `InputError` for names of none, and for both ways at once."""
        if keep and only is not None:
            raise InputError("keep= and only= say the same in two ways: give one of them")
        named = keep if only is None else only
        names = [named] if isinstance(named, str) else list(named)
        for name in names:
            self[name]
        return [name for name in self.clusters if (name in names) == (only is not None)]

    def subtracted(
        self,
        data: Visibilities,
        models: Models,
        keep: str | Collection[str] = (),
        only: str | Collection[str] | None = None,
    ) -> Visibilities:
        """The data without the clusters (but those in `keep`, or `only` some); zero and flagged without a solution."""
        model = self.predicted(models, keep, only)
        flag, own, weight = correlations.alike(model.flag, data.flag, data.weight)
        finite: Any = np.isfinite(data.data)
        bad = (flag & ~own) | ~(finite if weight.ndim == correlations.APART else finite.all(axis=(-2, -1)))
        empty = correlations.alike(data.data, bad)[1]
        left = data.with_data(np.where(empty, 0.0, data.data)).flagged(bad) - model
        return replace(left, data=np.where(empty, 0.0, left.data))

    def check(self) -> None:
        """Raise `InstrumentError` when an interval of a cluster has not converged."""
        for name, solution in self.clusters.items():
            try:
                solution.check()
            except InstrumentError as error:
                raise InstrumentError(f"cluster '{name}': {error}") from None

    def __str__(self) -> str:
        return "\n".join(f"{name}: {solution}" for name, solution in self.clusters.items())


def _plus(total: Visibilities, model: Visibilities, term: JonesTerm) -> Visibilities:
    """The sum of visibilities and a corrupted model. Where the model is zero, no solution is needed."""
    if not np.isfinite(model.data).all():
        model = replace(model, data=np.where(np.isfinite(model.data), model.data, np.nan + 0j))
    empty = np.all(model.data == 0, axis=(-2, -1))
    found = model.corrupted(term).data
    bad = ~np.isfinite(found).all(axis=(-2, -1)) & ~empty
    found = np.where((bad | empty)[..., None, None], 0.0, found)
    return replace(total, data=total.data + found, flag=correlations.either(total.flag, bad))
