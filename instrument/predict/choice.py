"""The cheapest engine for a problem; a sum of skies is a sum of engines, each the cheapest for its member."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple

import numpy as np

from instrument.errors import InputError, RefusedError, did_you_mean
from instrument.predict.base import EVERY, Predictor, Prepared, Problem, Work
from instrument.predict.rounding import total_flux
from instrument.registry import available, load
from instrument.units import Bool, Complex, Int, si_prefix


class Choice(NamedTuple):
    """The engine that is cheapest once prepared, its name, and those that refuse with the reason."""

    ready: Prepared
    label: str
    refused: tuple[tuple[str, str], ...]


def cheapest(problem: Problem, name: str | None, tolerance: float) -> Choice:
    """The cheapest of all engines, or that of a `name`, ready within a tolerance; raises where none serves."""
    plugins = available("engines")
    if name is not None and name not in plugins:
        raise InputError(f"no engine is called '{name}': {did_you_mean(name, plugins)}")
    if name is None and problem.sky.kind == "sum":
        return Choice(Sum().prepare(problem, tolerance), "sum", ())
    fit: list[tuple[float, str, Prepared]] = []
    refused: list[tuple[str, str]] = []
    for label, plugin in plugins.items():
        if plugin.broken:
            refused.append((label, plugin.broken))
            continue
        engine = load("engines", label)
        if why := engine.refuses(problem) or (engine.skips(problem) if name is None else None):
            refused.append((label, why))
        elif name in (None, label):
            try:
                ready = engine.prepare(problem, tolerance)
                fit.append((ready.work().seconds, label, ready))
            except RefusedError as error:
                refused.append((label, str(error)))
    if fit:
        _, label, ready = min(fit, key=lambda entry: entry[0])
        return Choice(ready, label, tuple(refused))
    reasons = "; ".join(f"{label}: {why}" for label, why in refused if name in (None, label))
    raise RefusedError(f"no engine serves this scene ({reasons})")


class Sum(Predictor):
    """Sums of skies (T, F, B, 2, 2): every member by the engine that is cheapest for it, within a part of a tolerance.

    Each is within the tolerance of its own flux, so that all are within it of the flux of all: a signal of millijansky
    beside stars of a kilojansky must not be lost in what these may be wrong by.
    """

    def refuses(self, problem: Problem) -> str | None:
        """Refuses skies that are no sums."""
        return None if problem.sky.kind == "sum" else "the sky is no sum of skies"

    def prepare(self, problem: Problem, tolerance: float) -> Prepared:
        """The engines of all members, ready; raises `RefusedError` that names the member that none serves."""
        total, members = total_flux(problem), problem.members()
        shares = {name: total_flux(one) / total for name, one in members.items()}
        # the brightest channel of one need not be that of all
        own = tolerance / max(1.0, sum(shares.values()))
        ready = {}
        for name, one in members.items():
            try:
                found = cheapest(one, None, own)
            except RefusedError as error:
                raise RefusedError(f"'{name}' of the sum: {error}") from None
            ready[name] = Member(found.ready, found.label, shares[name])
        bound = sum(m.share * m.ready.bound for m in ready.values())
        atoms = [m.ready.atom for m in ready.values()]
        atom = tuple(reduce(np.lcm, sizes).item() for sizes in (np.array(a) for a in zip(*atoms, strict=True)))
        return SumReady(self, problem, min(bound, tolerance), atom, ready=tuple(ready.items()))

    def work(self, problem: Problem) -> Work:
        """That of the engines that are cheapest without a tolerance."""
        return self.prepare(problem, 0.0).work()


class Member(NamedTuple):
    """A member ready by its engine, and its share of the total flux."""

    ready: Prepared
    label: str
    share: float


@dataclass(frozen=True)
class SumReady(Prepared):
    """The engines of all members, ready; the atom is the least that all take whole."""

    ready: tuple[tuple[str, Member], ...] = ()

    @property
    def lines(self) -> tuple[tuple[str, str, float], ...]:
        """Each member, its engine and what that costs; the bound of those that approximate stands with them."""
        out = []
        for name, (ready, label, share) in self.ready:
            how = f", {ready.omission[1]}" if ready.omission[0] else ""
            text = f"engine {label}{how}: {ready.problem.sky.size}, {si_prefix(ready.work().flops, 'Flop')}"
            out += [(name, text, share * ready.bound), *((f"{name}: {a}", b, c * share) for a, b, c in ready.lines)]
        return tuple(out)

    def sums(self, times: slice, channels: slice, pairs: tuple[Int, Int] | None = None) -> Complex:
        """Visibilities in Jy, complex (T, F, B, 2, 2), of all members."""
        first, *others = (member.ready for _, member in self.ready)
        out = first.sums(times, channels, pairs)
        for ready in others:
            out += ready.sums(times, channels, pairs)
        return out

    def left_out(self, times: slice, channels: slice) -> Bool | None:
        """What any member leaves out, (T, F, B): the others alone are not what is seen."""
        found = [out for _, member in self.ready if (out := member.ready.left_out(times, channels)) is not None]
        return reduce(np.logical_or, found) if found else None

    def work(self, times: slice = EVERY, channels: slice = EVERY) -> Work:
        """Cost of some times and channels: of one member after the other, whose results are added."""
        works = [member.ready.work(times, channels) for _, member in self.ready]
        shape = self.problem.block(times, channels).shape
        result = 64.0 * float(np.prod(shape)) if len(works) > 1 else 0.0
        return Work(
            sum(w.flops for w in works),
            sum(w.shared_bytes for w in works),
            max(w.slot_bytes for w in works) + result,
            sum(w.seconds for w in works),
        )
