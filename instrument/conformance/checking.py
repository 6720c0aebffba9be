"""check(obj): the contract of each kind of component as claims, checked on anyone's plugin in one call.

`check(obj)` returns a `Report`, one line per claim. A claim is a function whose name is the sentence it checks: it
returns a remark (what was measured) and raises when it does not hold. The claims of each kind are in the module of its
name, what they are tried on in `bench`.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

from instrument.calibrate.base import Calibrator
from instrument.component import Component
from instrument.conformance import calibrators, engines, foregrounds, imagers, instruments, skies, stages, terms
from instrument.conformance.bench import Broken, bench, demand, fresh, problems
from instrument.errors import InputError, InstrumentError, InstrumentWarning
from instrument.foreground.base import ForegroundRemover
from instrument.image.base import AnyImager
from instrument.jones.base import JonesTerm
from instrument.model import Instrument
from instrument.observe.sampling import Sampling
from instrument.pipeline.stage import Stage
from instrument.predict.base import Predictor
from instrument.predict.direct import Direct
from instrument.sky.base import Sky


class Line(NamedTuple):
    """One claim: the sentence, whether it holds, and what was measured or went wrong."""

    claim: str
    passed: bool
    detail: str


@dataclass(frozen=True)
class Report:
    """What `check` found of an object, one line per claim."""

    subject: str
    lines: tuple[Line, ...]

    @property
    def passed(self) -> bool:
        """Whether every claim holds."""
        return not self.failed

    @property
    def failed(self) -> tuple[Line, ...]:
        """The claims that do not hold."""
        return tuple(line for line in self.lines if not line.passed)

    def __str__(self) -> str:
        width = max(len(line.claim) for line in self.lines)
        rows = [f"{'ok' if n.passed else 'FAILED':<7} {n.claim:<{width}}  {n.detail}".rstrip() for n in self.lines]
        return "\n".join([f"{self.subject}: {len(self.lines)} claims, {len(self.failed)} failed", *rows])

    def raise_if_failed(self) -> None:
        """Raise `InstrumentError` that names the claims that do not hold."""
        if not self.passed:
            broken = "; ".join(f"{line.claim}: {line.detail}" for line in self.failed)
            raise InstrumentError(f"{self.subject} breaks its contract: {broken}")


def check(obj: object, at: Sampling | None = None) -> Report:
    """Check a Jones term, instrument, sky, engine, calibrator, remover or stage against the contract of its kind.

    `at` is where a term is evaluated and where a sky is placed, for those that fit one array only (tables per station);
    a small array of LOFAR-like stations otherwise. Raises `InputError` where there is no contract for such an object.
    """
    for kind, contract in CONTRACTS.items():
        if isinstance(obj, kind):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", InstrumentWarning)
                return Report(type(obj).__name__, tuple(contract(obj, at)))
    known = ", ".join(kind.__name__ for kind in CONTRACTS)
    shown = f"the class {obj.__name__}" if isinstance(obj, type) else f"a {type(obj).__name__}"
    raise InputError(f"there is no contract for {shown}: give an object of one of {known}")


def _line(claim: Callable[..., str], *given: Any, before: str = "", after: str = "") -> Line:
    sentence = before + claim.__name__.replace("_", " ") + after
    try:
        return Line(sentence, True, claim(*map(fresh, given)))
    except Broken as error:
        return Line(sentence, False, str(error))
    except Exception as error:  # a stranger's plugin may fail in any way
        return Line(sentence, False, f"{type(error).__name__}: {error}")


def a_round_trip_through_json_gives_an_equal_object(obj: Component, kind: type[Component]) -> str:
    """JSON, read by the abstract class, gives the same class and equal fields."""
    back = kind.from_json(obj.to_json())
    demand(type(back) is type(obj), f"it comes back as {type(back).__name__}")
    demand(back == obj, "it comes back unequal")
    return ""


def _instrument(instrument: Instrument, at: Sampling | None) -> Iterator[Line]:
    first = _line(instruments.its_layout_and_chain_are_the_same_every_time, instrument)
    yield first
    yield _line(a_round_trip_through_json_gives_an_equal_object, instrument, Instrument)
    if not first.passed:
        return
    chain = instrument.chain()
    where = bench(chain.parts, instrument.layout())
    for claim in instruments.CLAIMS:
        yield _line(claim, instrument, where)
    for term in chain.terms:
        for line in _term(term, where):
            yield line._replace(claim=f"{type(term).__name__}: {line.claim}")


def _term(term: JonesTerm, at: Sampling | None) -> Iterator[Line]:
    where = at or bench(term.parts())
    for claim in terms.CLAIMS:
        yield _line(claim, term, where)
    yield _line(a_round_trip_through_json_gives_an_equal_object, term, JonesTerm)


def _sky(sky: Sky, at: Sampling | None) -> Iterator[Line]:
    where = at or bench()
    first = _line(skies.about_a_phase_centre_its_directions_are_fixed, sky, where)
    yield first
    yield _line(a_round_trip_through_json_gives_an_equal_object, sky, Sky)
    if not first.passed:
        return
    placed = sky.about(where.centre)
    for claim in skies.CLAIMS:
        yield _line(claim, placed, where.towards(*placed.directions()))


def _engine(engine: Predictor, at: Sampling | None) -> Iterator[Line]:
    some = problems()
    first = _line(engines.it_serves_some_problem_and_refuses_others_in_a_sentence, engine, some)
    yield first
    yield _line(a_round_trip_through_json_gives_an_equal_object, engine, Predictor)
    if not first.passed:
        return
    served = {name: problem for name, problem in some.items() if engine.refuses(problem) is None}
    for name, problem in served.items():
        due = engines.due_of(name, isinstance(engine, Direct))
        yield _line(engines.it_agrees_with_direct, engine, problem, due, after=f": {name}")
        if problem.sky.kind == "image":
            yield _line(engines.its_adjoint_is_that_of_its_sums, engine, problem, after=f": {name}")
    last = {problem.sky.kind == "image": problem for problem in served.values()}
    for image, problem in last.items():
        for claim in engines.CLAIMS:
            yield _line(claim, engine, problem, after=": an image" if image and len(last) > 1 else "")


def _calibrator(calibrator: Calibrator, at: Sampling | None) -> Iterator[Line]:
    yield _line(a_round_trip_through_json_gives_an_equal_object, calibrator, Calibrator)
    for claim in calibrators.CLAIMS:
        yield _line(claim, calibrator)


def _imager(imager: AnyImager, at: Sampling | None) -> Iterator[Line]:
    yield _line(a_round_trip_through_json_gives_an_equal_object, imager, AnyImager)
    for claim in imagers.CLAIMS:
        yield _line(claim, imager)


def _remover(remover: ForegroundRemover, at: Sampling | None) -> Iterator[Line]:
    yield _line(a_round_trip_through_json_gives_an_equal_object, remover, ForegroundRemover)
    for claim in foregrounds.CLAIMS:
        yield _line(claim, remover)


def _stage(stage: Stage, at: Sampling | None) -> Iterator[Line]:
    yield _line(a_round_trip_through_json_gives_an_equal_object, stage, Stage)
    for claim in stages.CLAIMS:
        yield _line(claim, stage)


CONTRACTS: dict[type[Component], Callable[[Any, Sampling | None], Iterator[Line]]] = {
    JonesTerm: _term,
    Instrument: _instrument,
    Sky: _sky,
    Predictor: _engine,
    Calibrator: _calibrator,
    AnyImager: _imager,
    ForegroundRemover: _remover,
    Stage: _stage,
}
