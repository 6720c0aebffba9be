"""What stages cost, what they leave out, and the plan of a whole run: seconds, memory and bounds, stage by stage."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from instrument.plan import Item, Plan, count_of, spell
from instrument.units import si_prefix

PREDICT = "predict"
RECEIVERS = "receivers"  # their errors are put into perfect blocks, where a stage compares with a perfect instrument
VERIFY = "verify"
WRITE = "write"


class StageWork(NamedTuple):
    """What a stage does and costs: seconds on a machine of speed 1 (`instrument.machine`), bytes, and its own error.

    `seconds` go by while blocks pass, `finish_seconds` after the last. `held_bytes` stay to the end of the run,
    `block_bytes` are there besides while a block is taken, `finish_bytes` besides while it finishes, and after that
    `result_bytes` stay. `wrong` says how wrong it may be; `figures` is how many it draws.
    """

    does: str = ""
    seconds: float = 0.0
    finish_seconds: float = 0.0
    held_bytes: float = 0.0
    block_bytes: float = 0.0
    finish_bytes: float = 0.0
    result_bytes: float = 0.0
    wrong: str = ""
    figures: int = 0
    remedy: str = ""  # what to ask for less of, where memory is short

    @property
    def peak_bytes(self) -> float:
        """The most it has at once, by itself."""
        return max(self.held_bytes + max(self.block_bytes, self.finish_bytes), self.result_bytes)


class Items(NamedTuple):
    """What a stage keeps and why, what it leaves out with which bound, and what it does not model."""

    kept: tuple[Item, ...] = ()
    left_out: tuple[Item, ...] = ()
    not_modelled: tuple[Item, ...] = ()


@dataclass(frozen=True)
class RunPlan:
    """The plan of a whole run: that of the prediction, and what every step costs, in the order of the run."""

    plan: Plan
    works: Mapping[str, StageWork]
    items: Mapping[str, Items]
    base_bytes: float  # of the interpreter and what it has loaded, before the first block
    peak_bytes_before: float  # that planning itself has had
    speed: float

    @property
    def seconds(self) -> dict[str, float]:
        """Of every step, on this machine."""
        return {name: (w.seconds + w.finish_seconds) / self.speed for name, w in self.works.items()}

    def share(self, name: str | None = None) -> float:
        """Of the time of the run, that in which the blocks pass, or in which a step finishes."""
        total = sum(self.seconds.values()) * self.speed or 1.0
        spent = sum(w.seconds for w in self.works.values()) if name is None else self.works[name].finish_seconds
        return spent / total

    @property
    def growth(self) -> dict[str, float]:
        """By how many bytes each step, as it comes, raises the most that the process has had."""
        top, out, held = self.peak_bytes_before, dict.fromkeys(self.works, 0.0), self.base_bytes

        def reach(name: str, level: float) -> None:
            nonlocal top
            out[name] += max(0.0, level - top)
            top = max(top, level)

        blocks = self.works[PREDICT].block_bytes if PREDICT in self.works else 0.0
        for name, work in self.works.items():
            held += work.held_bytes
            reach(name, held + (0.0 if name == PREDICT else blocks) + work.block_bytes)
        for name, work in self.works.items():
            reach(name, held + work.finish_bytes)
            held += work.result_bytes - work.held_bytes if work.result_bytes else 0.0
        return out

    @property
    def memory(self) -> float:
        """The most bytes that the process will have at once, the interpreter's own among them."""
        return self.peak_bytes_before + sum(self.growth.values())

    def __str__(self) -> str:
        return "\n".join([self.plan.told("data" not in self.works or PREDICT in self.works), *self._lines()])

    def _lines(self) -> Iterator[str]:
        for name, items in self.items.items():
            for word, some in zip(("kept", "left out", "not modelled"), items, strict=True):
                for i in some:
                    bound = f" error {i.bound:.2g}" if i.bound else ""
                    yield f"{word:<14}{f'{name}: {i.name}':<22} {i.reason:<46}{bound}".rstrip()
        seconds = self.seconds
        for name, work in self.works.items():
            cost = f"about {spell(seconds[name])}, {si_prefix(work.peak_bytes, 'B')}"
            yield f"stage         {name:<22} {'; '.join(x for x in (work.does, cost, work.wrong) if x)}"
        yield (
            f"whole run     about {spell(sum(seconds.values()))}, peak {si_prefix(self.memory, 'B')} of memory, "
            f"{si_prefix(self.base_bytes, 'B')} of them the interpreter's"
        )


def predicting(plan: Plan) -> StageWork:
    """What the prediction costs."""
    does = f"{plan.engine_name}, {count_of(len(plan.slices), 'block')}"
    return StageWork(does, seconds=plan.seconds, block_bytes=plan.memory, wrong=f"{plan.error_bound:.1e} of the flux")


def copies(visibilities: float, block: tuple[int, int, int], times: float, seconds: float, does: str = "") -> StageWork:
    """What it costs to make other blocks of blocks: so many copies of one (T, F, B), so many seconds a visibility."""
    return StageWork(does, seconds=seconds * visibilities, block_bytes=64.0 * times * block[0] * block[1] * block[2])
