"""Plain numbers within a range: `Whole`, `Real`, `Span`, each a field of a component and a check at a call.

In Python a string is no number and `True` is no count; the command line and scene files turn text into numbers before
they come here. `bins: Count = 12` is a field; `SEED.check(seed, "seed")` is a call.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import GetCoreSchemaHandler
from pydantic_core import core_schema

from instrument.errors import InputError

LARGEST = 1e100  # squares of what is larger, or smaller than 1/LARGEST, leave float64


def brief(value: object) -> str:
    """What was given, for an error: at most 60 characters, nothing that moves a cursor."""
    try:
        text = repr(value) if isinstance(value, str | bytes) else " ".join(repr(value).split())
    except ValueError:  # an integer of more digits than Python writes
        text = "a number too long to write"
    text = "".join(c if c.isprintable() else "?" for c in text)
    return text if len(text) <= 60 else f"{text[:57]}..."


def unmasked(value: object, name: str) -> None:
    """Raises `InputError` where a masked array hides values: numpy would take what lies under the mask."""
    hidden = int(np.count_nonzero(getattr(value, "mask", False)))
    if hidden:
        raise InputError(f"{name} has {hidden} masked values: leave them out, or fill them (.filled)")


def squarable(size: float, what: str) -> None:
    """Raises `InputError` where the squares of a largest size leave float64; 0 has one."""
    if size and not 1 / LARGEST < size < LARGEST:
        raise InputError(f"{what} reaches {size:.1e}, beyond what squares can hold: scale the cube")


def out_of_range(
    number: Any,
    at_least: float | None = None,
    above: float | None = None,
    at_most: float | None = None,
    below: float | None = None,
) -> str | None:
    """What all of the numbers should be, where one of them is not: "at least 1 and below 5"; `None` where all fit."""
    limits = (
        ("at least", at_least, np.less),
        ("above", above, np.less_equal),
        ("at most", at_most, np.greater),
        ("below", below, np.greater_equal),
    )
    if not any(limit is not None and np.any(wrong(number, limit)) for _, limit, wrong in limits):
        return None
    return " and ".join(f"{word} {limit:g}" for word, limit, _ in limits if limit is not None)


@dataclass(frozen=True)
class Real:
    """A finite number within a range."""

    at_least: float | None = None
    above: float | None = None
    at_most: float | None = None
    below: float | None = None

    def check(self, value: object, name: str) -> float:
        """The number as a float; raises `InputError` that names the thing, the value and what it must be."""
        if not _is_number(value):
            raise self._refuse(value, name)
        try:
            number = float(value)  # type: ignore[arg-type]
        except OverflowError:
            raise self._refuse(value, name) from None
        if not np.isfinite(number) or out_of_range(number, self.at_least, self.above, self.at_most, self.below):
            raise self._refuse(value, name)
        return number

    def _refuse(self, value: object, name: str) -> InputError:
        return InputError(f"{name} = {brief(value)} must be {self}")

    def __str__(self) -> str:
        return f"a finite number{self._range()}"

    def _range(self) -> str:
        limits = (("of at least", self.at_least), ("above", self.above), ("of at most", self.at_most))
        words = [f"{word} {limit:g}" for word, limit in (*limits, ("below", self.below)) if limit is not None]
        return f" {' and '.join(words)}" if words else ""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        return core_schema.with_info_plain_validator_function(
            lambda value, info: self.check(value, info.field_name or "the value")
        )


@dataclass(frozen=True)
class Whole(Real):
    """A whole number within a range: 3, `np.int64(3)` and 3.0 are; True, "3" and 2.5 are not."""

    def check(self, value: object, name: str) -> int:
        """The number as an int; raises `InputError` that names the thing, the value and what it must be."""
        number = super().check(value, name)
        if number != int(number):
            raise self._refuse(value, name)
        return int(value)  # type: ignore[call-overload]

    def __str__(self) -> str:
        return f"a whole number{self._range()}"


@dataclass(frozen=True)
class Span(Real):
    """Two finite increasing numbers, a range such as (30, 800)."""

    def check(self, value: object, name: str) -> Any:
        """The two as floats; raises `InputError` that names the thing, the value and what it must be."""
        if getattr(value, "unit", None) is not None or not isinstance(value, tuple | list | np.ndarray):
            raise self._refuse(value, name)
        if len(value) != 2 or not all(_is_number(v) for v in value):
            raise self._refuse(value, name)
        try:
            low, high = (super(Span, self).check(v, name) for v in value)
        except InputError:
            raise self._refuse(value, name) from None
        if not low < high:
            raise self._refuse(value, name)
        return low, high

    def __str__(self) -> str:
        return f"two increasing finite numbers{self._range()}"


def _is_number(value: object) -> bool:
    """Whether it is one real number without a unit: no text, no bool, no complex, no array of many."""
    if getattr(value, "unit", None) is not None or isinstance(value, bool | np.bool_):
        return False
    if isinstance(value, np.ndarray):
        return value.ndim == 0 and value.dtype.kind in "fiu"
    return isinstance(value, int | float | np.integer | np.floating)


COUNT = Whole(at_least=1)
SEED = Whole(at_least=0)
INDEX = Whole(at_least=0)
FINITE = Real()
POSITIVE = Real(above=0)
NOT_NEGATIVE = Real(at_least=0)
SHARE = Real(at_least=0, at_most=1)
TOLERANCE = Real(at_least=0, below=1)
UV_RANGE = Span(at_least=0)

Count = Annotated[int, COUNT]
Seed = Annotated[int, SEED]
Index = Annotated[int, INDEX]
Finite = Annotated[float, FINITE]
Positive = Annotated[float, POSITIVE]
NotNegative = Annotated[float, NOT_NEGATIVE]
Share = Annotated[float, SHARE]
Tolerance = Annotated[float, TOLERANCE]
UvRange = Annotated[tuple[float, float], UV_RANGE]
