"""The check of what a run produced: sampled times and channels of its data, every baseline, against the definition."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from instrument import mat2
from instrument.correlations import alike
from instrument.errors import InputError
from instrument.numbers import COUNT, SEED
from instrument.observe.closure import CLOSURE_M
from instrument.observe.directions import LIGHT
from instrument.predict.base import Problem
from instrument.sky.points import points_of
from instrument.units import Complex, Float, Int
from instrument.visibilities import Visibilities

SHARE = 0.04  # of the planned time goes into the check of a run
ROOM = 250_000  # Jones matrices, or shapes of Gaussians on baselines, held at once
DEFINITION = "direct"
BY_STATIONS = "the same terms summed by stations, for the engine is direct, the definition itself"


class Seen(NamedTuple):
    """How many of all were looked at."""

    seen: int = 0
    of: int = 0

    def words(self, what: str) -> str:
        """In words: "all 59 stations", "times 12 of 288"."""
        if self.seen == self.of:
            return f"all {self.of} {what}" if self.of > 1 else f"the one {what[:-1]}"
        return f"{what} {self.seen} of {self.of}"


NONE = Seen()


@dataclass(frozen=True)
class Check:
    """What was measured: the largest error of `samples` visibilities against the definition, and the bound promised.

    Both relative to `scale_jy`, the total flux of the sky. What was not looked at is not vouched for: `times` to
    `baselines` say how much was. `reason` says why a check was not made; it has then not passed.
    """

    error: float
    bound: float
    samples: int
    scale_jy: float
    times: Seen = NONE
    channels: Seen = NONE
    stations: Seen = NONE
    baselines: Seen = NONE
    where: str = ""
    against: str = DEFINITION
    reason: str = ""

    @property
    def made(self) -> bool:
        """Whether anything was compared."""
        return self.samples > 0

    @property
    def passed(self) -> bool:
        """Whether something was compared and the measured error lies within the bound."""
        return bool(self.made and self.error <= self.bound)

    @property
    def coverage(self) -> str:
        """The share that was seen, in words."""
        names = ("times", "channels", "stations", "baselines")
        return ", ".join(getattr(self, name).words(name) for name in names)

    def __str__(self) -> str:
        if not self.made:
            return f"not checked: {self.reason}"
        verdict = "within" if self.passed else "ABOVE"
        where = "" if self.passed else f", largest at {self.where}"
        return (
            f"error {self.error:.1e}, {verdict} the bound {self.bound:.1e}{where} "
            f"({self.samples} visibilities against {self.against}: {self.coverage})"
        )


@dataclass
class Checker:
    """Chooses times and channels of a scene, and compares the data of the blocks that hold them with the definition.

    Every chosen cell is checked on all baselines; times and channels come once each before any comes twice.
    """

    full: Problem
    scale_jy: float
    bound: float
    seconds: float = 0.0  # that may be spent
    samples: int = 64
    seed: int = 0
    against: str = DEFINITION
    cells: dict[int, list[int]] = field(init=False)
    worst: float = field(init=False, default=0.0)
    where: str = field(init=False, default="")
    compared: int = field(init=False, default=0)
    seen_cells: set[tuple[int, int]] = field(init=False, default_factory=set)
    pairs: set[int] = field(init=False, default_factory=set)
    spent: float = field(init=False, default=0.0)  # seconds

    def __post_init__(self) -> None:
        samples, seed = COUNT.check(self.samples, "samples"), SEED.check(self.seed, "seed")
        times, channels, baselines = self.full.shape
        least = -(-samples // baselines)
        count = min(times * channels, max(least, int(self.seconds / cell_seconds(self.full))))
        rng = np.random.default_rng(seed)
        t, f = rng.permutation(times), rng.permutation(channels)
        self.cells = {}
        for k in range(count):
            # all pairs come before any comes twice: both axes advance, and one slips where they meet again
            slipped = k + k // int(np.lcm(times, channels))
            self.cells.setdefault(int(t[k % times]), []).append(int(f[slipped % channels]))

    def chosen(self) -> Iterator[tuple[int, int]]:
        """The cells (time, channel), in order of time."""
        for t in sorted(self.cells):
            for f in self.cells[t]:
                yield t, f

    def see(self, block: Visibilities, full: Problem | None = None) -> None:
        """Compare what a block holds of the chosen cells; `full` is what it should hold, the whole scene by default."""
        begin, full = time.perf_counter(), full or self.full
        for t, f, i, j in self._within(block, full):
            self._compare(full, t, f, block, i, j)
        self.spent += time.perf_counter() - begin

    def _within(self, block: Visibilities, full: Problem) -> list[tuple[int, int, int, int]]:
        """Chosen cells of a block: time and channel in the scene, and in the block."""
        _same_scene(block, full)
        times = _indices(full.at.slots_s, block.at.slots_s, full.interval_s / 4, "time", "MJD s")
        apart = np.diff(np.sort(full.at.freq_hz)).min(initial=4e-3 * full.at.freq_hz.min())
        channels = _indices(full.at.freq_hz, block.freq_hz, apart / 4, "channel", "Hz")
        column = {int(f): j for j, f in enumerate(channels)}
        return [
            (t, f, i, column[f]) for i, t in enumerate(times.tolist()) for f in self.cells.get(t, ()) if f in column
        ]

    def _compare(self, full: Problem, t: int, f: int, block: Visibilities, i: int, j: int) -> None:
        cell = full.block(slice(t, t + 1), slice(f, f + 1)).between(block.antenna1, block.antenna2)
        known = np.broadcast_to(~alike(block.data, block.flag)[1], block.data.shape)[i, j]
        found = np.where(known, np.abs(block.data[i, j] - definition(cell)), 0.0).max(axis=(-2, -1))
        used = np.flatnonzero(known.any(axis=(-2, -1)))
        if not used.size:
            return
        pick = int(used[np.argmax(np.where(np.isnan(found[used]), np.inf, found[used]))])  # NaN is the worst of all
        if not (found[pick] <= self.worst or np.isnan(self.worst)):
            self.worst = float(found[pick])
            names = full.at.layout.names
            pair = f"{names[block.antenna1[pick]]}-{names[block.antenna2[pick]]}"
            self.where = f"{pair}, time {t} and channel {f} of the run"
        self.compared += used.size
        self.seen_cells.add((t, f))
        if len(self.pairs) < len(full.antenna1):
            low, high = np.minimum(block.antenna1, block.antenna2), np.maximum(block.antenna1, block.antenna2)
            self.pairs |= set((low * len(full.at.layout) + high)[used].tolist())

    def result(self) -> Check:
        """What was found so far."""
        full, stations = self.full, len(self.full.at.layout)
        if not self.compared:
            return not_checked(
                "the data hold none of the times and channels that were chosen", self.bound, self.scale_jy
            )
        pairs = np.array(sorted(self.pairs))
        counted = np.union1d(full.antenna1, full.antenna2)
        return Check(
            error=self.worst / self.scale_jy,
            bound=self.bound,
            samples=self.compared,
            scale_jy=self.scale_jy,
            times=Seen(len({t for t, _ in self.seen_cells}), full.shape[0]),
            channels=Seen(len({f for _, f in self.seen_cells}), full.shape[1]),
            stations=Seen(len(np.union1d(pairs // stations, pairs % stations)), len(counted)),
            baselines=Seen(len(pairs), full.shape[2]),
            where=self.where,
            against=self.against,
        )


def not_checked(reason: str, bound: float, scale_jy: float) -> Check:
    """A check that was not made, and why."""
    return Check(float("nan"), bound, 0, scale_jy, reason=reason)


def watch(checker: Checker, blocks: Iterable[Visibilities]) -> Check:
    """The check of blocks that come from anywhere."""
    for block in blocks:
        checker.see(block)
    return checker.result()


def cell_seconds(problem: Problem) -> float:
    """What the definition of one time and channel on all baselines costs, on one core."""
    stations, sources = problem.at.shape[2], problem.sky.count
    parts = sum(term.phasors() for term in problem.chain.parts)
    listed = points_of(problem.sky)
    if problem.sky.kind == "sum":
        return sum(cell_seconds(one) for one in problem.members().values())
    shaped = 0 if problem.sky.kind == "image" else sources if listed is None else int(listed.gaussian.sum())
    matrices = 0.1e-6 + 0.35e-6 * len(problem.chain.terms)
    return (
        2.5e-3
        + stations * sources * matrices
        + 2.5e-9 * sources * parts
        + 32.0 * stations**2 * sources / 10e9
        + 1.5e-7 * problem.shape[2] * shaped
    )


def definition(problem: Problem) -> Complex:
    """V_ab = sum_s J_a B_s J_b^H K_ab of one time and channel, complex (B, 2, 2), from the plain product of all terms.

    Points are summed as one product of stations, (J_a B K_a) (J_b K_b)^H; sources with shapes baseline by baseline.
    Slow twin: `Direct`; tests/accuracy/test_check.py compares them.
    """
    out = np.zeros((problem.shape[2], 2, 2), complex)
    for part in problem.parts(max(1, ROOM // problem.at.shape[2])):
        out += _sum(part)
    return out


def _sum(problem: Problem) -> Complex:
    at, sky = problem.at, problem.sky
    _, _, stations, sources = at.shape
    waves = at.uvw_m[0] * (at.freq_hz[0] / LIGHT)
    cycles = waves @ at.lmn.T
    fringe = np.exp(-2j * np.pi * (cycles - np.rint(cycles)))[..., None, None]
    jones = problem.chain.jones(at)
    right = np.broadcast_to(jones[0, 0], (stations, sources, 2, 2)) * fringe
    left = mat2.mul(right, np.broadcast_to(sky.brightness(at)[0, 0], (sources, 2, 2)))
    listed = points_of(sky)
    if listed is not None:
        shaped = np.flatnonzero(listed.gaussian)
    else:
        shaped = np.arange(0 if sky.envelope(at, np.zeros((1, 1, 1, 3))) is None else sources)
    points = np.delete(np.arange(sources), shaped)
    a, b = problem.antenna1, problem.antenna2
    rows, columns = (
        np.ascontiguousarray(x[:, points].transpose(0, 2, 1, 3)).reshape(2 * stations, 2 * len(points))
        for x in (left, right)
    )
    out = np.asarray((rows @ columns.conj().T).reshape(stations, 2, stations, 2)[a, :, b, :])
    if not len(shaped):
        return out
    # only the shapes, before anything is of all baselines: 4000 points on 1711 of them took 0.6 GB
    wide, other = left[:, shaped], right[:, shaped]
    some = sky if listed is None else listed.select(shaped)
    at = at if listed is None else at.towards(*some.directions())
    step = max(1, ROOM // len(shaped if listed is not None else range(sources)))
    for first in range(0, len(a), step):
        p, q = a[first : first + step], b[first : first + step]
        found = some.envelope(at, (waves[p] - waves[q])[None, None])
        taken = np.ones((1, 1)) if found is None else found[0, 0]
        each = mat2.mul(wide[p], mat2.herm(other[q]))
        out[first : first + step] += (each * taken[..., None, None]).sum(axis=1)
    return out


def _same_scene(block: Visibilities, full: Problem) -> None:
    if block.beam_state.removed != "nothing":
        raise InputError(
            f"a check needs data as they were produced, these have had a beam taken out ({block.beam_state})"
        )
    if block.layout.names != full.at.layout.names or block.phase_centre != full.at.centre:
        raise InputError("these visibilities are of other stations or another phase centre than the plan")
    ours = full.at.own_uvw_m is None  # else the plan has those of a file as well, and is held to them
    if block.given_uvw_m is not None or (block.at.own_uvw_m is not None and ours):
        at = replace(block.at, own_uvw_m=None) if ours else block.at
        apart = float(np.abs(block.uvw_m - replace(block, given_uvw_m=None, at=at).uvw_m).max(initial=0.0))
        if apart > CLOSURE_M:
            raise InputError(
                f"these visibilities have UVW of their own, up to {apart:.2g} m from those that a plan works out: "
                "there is nothing to hold them against"
            )


def _indices(known: Float, asked: Float, near: float, what: str, unit: str) -> Int:
    """Where each of `asked` stands in `known`, both in any order; raises where nothing is near."""
    order = np.argsort(known)
    ranked = known[order]
    right = np.clip(np.searchsorted(ranked, asked), 0, len(known) - 1)
    left = np.maximum(right - 1, 0)
    pick = np.where(np.abs(ranked[left] - asked) <= np.abs(ranked[right] - asked), left, right)
    off = np.abs(ranked[pick] - asked)
    if not np.all(off <= near):
        far = asked[int(np.argmax(off))]
        raise InputError(f"the {what} at {far:.12g} {unit} is not in the plan: there is nothing to hold it against")
    return np.asarray(order[pick])
