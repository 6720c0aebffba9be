"""The door for numbers: fields with units, plain numbers within a range, arrays, directions, times.

`Metres`, `Seconds`, `Hertz`, `Radians`, `Jansky`, ... annotate a field of a `Component`. They accept an astropy
`Quantity` or a string such as "30.8 m", store a float in the SI unit of the name (Jansky stays Jy, as the field does)
and go to JSON as a string with the unit. Numbers without a unit go through `Whole`, `Real` and `Span`
(`instrument/numbers.py`), as fields and at calls alike.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, GetCoreSchemaHandler, PlainSerializer, ValidationInfo
from pydantic_core import core_schema

from instrument.errors import InputError, UnitError
from instrument.numbers import COUNT as COUNT
from instrument.numbers import FINITE as FINITE
from instrument.numbers import INDEX as INDEX
from instrument.numbers import NOT_NEGATIVE as NOT_NEGATIVE
from instrument.numbers import POSITIVE as POSITIVE
from instrument.numbers import SEED as SEED
from instrument.numbers import SHARE as SHARE
from instrument.numbers import TOLERANCE as TOLERANCE
from instrument.numbers import UV_RANGE as UV_RANGE
from instrument.numbers import Count as Count
from instrument.numbers import Finite as Finite
from instrument.numbers import Index as Index
from instrument.numbers import NotNegative as NotNegative
from instrument.numbers import Positive as Positive
from instrument.numbers import Real as Real
from instrument.numbers import Seed as Seed
from instrument.numbers import Share as Share
from instrument.numbers import Span as Span
from instrument.numbers import Tolerance as Tolerance
from instrument.numbers import UvRange as UvRange
from instrument.numbers import Whole as Whole
from instrument.numbers import brief, out_of_range, unmasked
from instrument.written import icrs_degrees

Complex = NDArray[np.complexfloating[Any, Any]]
Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]


def to_si(
    value: object,
    unit: str,
    name: str = "the value",
    at_least: float | None = None,
    above: float | None = None,
    nan: bool = False,
) -> Any:
    """Value of a `Quantity` or of a string with a unit, as finite float(s) in `unit`; with `nan`, NaN is "not known".

    Raises `UnitError` for a bare number or another kind of unit, `InputError` for what is not finite or out of range.
    """
    from astropy import units as u

    wanted = u.Unit(unit)
    unmasked(value, name)
    if isinstance(value, str):
        try:
            value = u.Quantity(value)
        except (TypeError, ValueError) as error:
            raise UnitError(f"{name} = {brief(value)} is not a number with a unit convertible to {unit}") from error
    elif isinstance(value, list | tuple) and value and all(isinstance(v, str | u.Quantity) for v in value):
        return np.array([to_si(v, unit, name, at_least, above, nan) for v in value], float)
    if not isinstance(value, u.Quantity):
        raise UnitError(
            f"{name} needs a unit convertible to {unit}, got the bare {brief(value)}; write it with its unit"
        )
    try:
        number = np.asarray(value.to_value(wanted))
    except u.UnitConversionError as error:
        given = brief(" ".join(str(value).split()))
        raise UnitError(f"{name} needs a unit convertible to {unit or 'no unit'}, got {given}") from error
    if number.dtype.kind not in "fiu":
        raise InputError(f"{name} = {brief(value)} is not a real number")
    number = number.astype(float)
    wrong = np.isinf(number) if nan else ~np.isfinite(number)
    if np.any(wrong):
        raise InputError(f"{_worst(name, number, wrong)} {unit} is not finite")
    if why := out_of_range(number, at_least, above):
        raise InputError(f"{_worst(name, number, number == np.nanmin(number))} {unit} must be {why} {unit}")
    return float(number) if number.ndim == 0 else number


def _worst(name: str, number: Any, wrong: Any) -> str:
    """Name and value of the first wrong number of an array: `frequencies[1] = nan`."""
    index = [int(i) for i in np.argwhere(wrong)[0]]
    return f"{name}{index or ''} = {float(number[tuple(index)]):g}"


def one_si(
    value: object, unit: str, name: str = "the value", at_least: float | None = None, above: float | None = None
) -> float:
    """The same for one value: a list raises `InputError`."""
    number = to_si(value, unit, name, at_least, above)
    if np.ndim(number):
        raise InputError(f"{name} takes one value, got {np.shape(number)}")
    return float(number)


@dataclass(frozen=True)
class In:
    """Marks a field: the unit it is stored in, its range in that unit, and whether it is an array (one axis)."""

    unit: str
    array: bool = False
    at_least: float | None = None
    above: float | None = None

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        def check(value: object, info: core_schema.ValidationInfo) -> Any:
            name = info.field_name or "the value"
            if not self.array:
                return one_si(value, self.unit, name, self.at_least, self.above)
            number = np.array(np.atleast_1d(to_si(value, self.unit, name, self.at_least, self.above)), float)
            if number.ndim != 1:
                raise InputError(f"{name} takes a list of values, got {np.shape(number)}")
            number.setflags(write=False)
            return number

        def write(value: Any) -> Any:
            return [f"{v!r} {self.unit}" for v in value.tolist()] if self.array else f"{value!r} {self.unit}"

        return core_schema.with_info_plain_validator_function(
            check,
            serialization=core_schema.plain_serializer_function_ser_schema(write, when_used="json"),
        )


Metres = Annotated[float, In("m")]
Seconds = Annotated[float, In("s")]
Hertz = Annotated[float, In("Hz")]
HertzArray = Annotated[Float, In("Hz", array=True)]
Radians = Annotated[float, In("rad")]
Jansky = Annotated[float, In("Jy")]
Kelvin = Annotated[float, In("K", at_least=0)]
PositiveMetres = Annotated[float, In("m", above=0)]
PositiveSeconds = Annotated[float, In("s", above=0)]
PositiveHertz = Annotated[float, In("Hz", above=0)]
PositiveHertzArray = Annotated[Float, In("Hz", array=True, above=0)]
PositiveRadians = Annotated[float, In("rad", above=0)]


def plain(value: Any, dtype: type, name: str, finite: bool = False, at_least: float | None = None) -> Any:
    """A copy of numbers as an array; raises `UnitError` for a `Quantity`, whose unit numpy would drop.

    Text is no number, and what `dtype` cannot hold (a complex value, 2.5 as an int) is refused.
    """
    if getattr(value, "unit", None) is not None:
        raise UnitError(f"{name} takes plain numbers in SI units, got values in '{value.unit}': use .to_value(...)")
    unmasked(value, name)
    try:
        given = np.asarray(value)
        kind, wanted = given.dtype.kind, np.dtype(dtype).kind
        if given.size and (kind in "USOMmV" or (kind == "c" and wanted != "c") or (kind == "b" and wanted != "b")):
            raise TypeError(f"got {brief(value)}")
        array: Any = np.array(given, dtype=dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name} is not an array of numbers: {error}") from None
    if np.dtype(dtype).kind in "iu" and given.dtype.kind == "f" and not np.array_equal(array, given):
        raise InputError(f"{name} = {brief(value)} must be whole numbers")
    if finite and not np.all(np.isfinite(array)):
        raise InputError(f"{name} must be finite")
    if at_least is not None and np.any(array < at_least):
        raise InputError(f"{name} must be at least {at_least:g}, got {float(array.min()):g}")
    return array


@dataclass(frozen=True)
class ArrayOf:
    """Marks a read-only array field: dtype and shape, `None` for a free axis."""

    dtype: type
    shape: tuple[int | None, ...]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        def check(value: object, info: core_schema.ValidationInfo) -> Any:
            if isinstance(value, dict) and {"real", "imag"} <= set(value):
                real = np.array(value["real"], float)
                value, parts = np.empty(real.shape, complex), (real, value["imag"])
                value.real, value.imag = parts  # real + 1j * imag would lose infinities
            array: Any = plain(value, self.dtype, str(info.field_name))
            fits = array.ndim == len(self.shape) and all(
                n in (None, m) for n, m in zip(self.shape, array.shape, strict=True)
            )
            if not fits:
                want = "(" + ", ".join("any" if n is None else str(n) for n in self.shape) + ")"
                raise InputError(f"{info.field_name} has shape {array.shape}, needed {want}")
            array.setflags(write=False)
            return array

        def write(value: Any) -> Any:
            if np.iscomplexobj(value):
                return {"real": value.real.tolist(), "imag": value.imag.tolist()}
            return value.tolist()

        return core_schema.with_info_plain_validator_function(
            check,
            serialization=core_schema.plain_serializer_function_ser_schema(write, when_used="json"),
        )


class Direction(NamedTuple):
    """A direction on the sky: ICRS right ascension and declination in rad."""

    ra_rad: float
    dec_rad: float

    @property
    def vector(self) -> Float:
        """Unit vector, ICRS, (3,)."""
        return unit_vectors(np.array([self.ra_rad]), np.array([self.dec_rad]))[0]

    @property
    def skycoord(self) -> Any:
        """The same as an astropy `SkyCoord`."""
        from astropy.coordinates import SkyCoord

        return SkyCoord(self.ra_rad, self.dec_rad, unit="rad", frame="icrs")

    def __str__(self) -> str:
        return str(self.skycoord.to_string("hmsdms", precision=3))


def unit_vectors(ra_rad: Float, dec_rad: Float) -> Float:
    """Unit vectors (S, 3) of right ascensions and declinations (S,)."""
    return np.stack([np.cos(dec_rad) * np.cos(ra_rad), np.cos(dec_rad) * np.sin(ra_rad), np.sin(dec_rad)], axis=-1)


DEGREE = float(np.pi / 180)
WRITTEN = re.compile(r"(\S+)rad (\S+)rad")  # as `_write_direction` has it: read without any arithmetic


def _direction(value: object, info: ValidationInfo) -> Direction:
    return direction(value, info.field_name or "the direction")


def direction(value: object, name: str = "the direction") -> Direction:
    """One direction, of a SkyCoord or of text such as "08h13m36.0s +48d13m03s"."""
    written = WRITTEN.fullmatch(value) if isinstance(value, str) else None
    if written:
        value = Direction(float(written[1]), float(written[2]))
    elif isinstance(value, str) and (degrees := icrs_degrees(value)):
        return Direction(*(DEGREE * angle for angle in degrees))
    if isinstance(value, Direction):
        if not np.all(np.isfinite(value)) or abs(value.dec_rad) > np.pi / 2:
            raise InputError(f"{name} = {tuple(value)} rad is not a direction")
        return value
    from astropy.coordinates import SkyCoord

    try:
        coord = SkyCoord(value) if isinstance(value, str) else value
    except ValueError as error:
        raise InputError(f"{name} = '{value}' is not a direction; write it like '08h13m36.0s +48d13m03s'") from error
    if not isinstance(coord, SkyCoord) or coord.size != 1:
        raise InputError(f"{name} = {brief(value)} is not one direction; give a SkyCoord or '08h13m36.0s +48d13m03s'")
    icrs = icrs_of(coord, name)
    found = Direction(float(np.squeeze(icrs.ra.rad)), float(np.squeeze(icrs.dec.rad)))
    if not np.all(np.isfinite(found)):
        raise InputError(f"{name} is not finite")
    return found


def icrs_of(coord: Any, name: str = "directions") -> Any:
    """Directions of a SkyCoord in ICRS; raises `InputError` for a frame that cannot be turned into it."""
    from astropy.coordinates import SkyCoord

    if not isinstance(coord, SkyCoord):
        raise InputError(f"{name} = {brief(coord)} must be a SkyCoord in ICRS")
    try:
        return coord.icrs
    except Exception as error:  # a frame without its time or place fails in astropy's own ways, AttributeError too
        raise InputError(
            f"{name} in the frame {coord.frame.name} cannot be turned into ICRS ({type(error).__name__}): give ICRS, "
            "or the frame with what it needs, such as AltAz(obstime=..., location=...)"
        ) from None


def _write_direction(value: Direction | None) -> str | None:
    return value and f"{value.ra_rad!r}rad {value.dec_rad!r}rad"


SkyDirection = Annotated[
    Direction, BeforeValidator(_direction), PlainSerializer(_write_direction, return_type=str, when_used="json")
]


def instants(value: object, name: str = "times") -> Any:
    """UTC `Time` (T,), of a Time or of text such as "2012-12-07T23:00:00", one or many."""
    from astropy.time import Time

    try:
        time = value if isinstance(value, Time) else Time(value, scale="utc")
    except (ValueError, TypeError, AttributeError):
        raise InputError(f"{name} = {brief(value)} is not a UTC time; write it like '2012-12-07T23:00:00'") from None
    return time.utc.reshape((-1,)) if not time.isscalar else time.utc.reshape((1,))


def _instant(value: object, info: ValidationInfo) -> Any:
    from astropy.time import Time

    found = instants(value, info.field_name or "the time")
    if len(found) != 1:
        raise InputError(f"{info.field_name} takes one time, got {len(found)}")
    return Time(_write_instant(found[0]), scale="utc")  # to 1 ns, so that it comes back from text as it was


def _write_instant(value: Any) -> str:
    exact = value.utc.copy(format="isot")
    exact.precision, exact.out_subfmt = 9, "*"  # a Time made from a day would else write the day only
    return str(exact.value)


Instant = Annotated[Any, BeforeValidator(_instant), PlainSerializer(_write_instant, return_type=str, when_used="json")]


def mjd_text(seconds: float) -> str:
    """MJD seconds, UTC, as text to 1 ms: "2012-12-07T20:00:00.000"."""
    from astropy.time import Time

    return str(Time(seconds // 86400, (seconds % 86400) / 86400, format="mjd", scale="utc").isot)


def si_prefix(value: float, unit: str) -> str:
    """Three digits with a metric prefix: `7.2e10, 'Flop'` -> `72 GFlop`."""
    if not np.isfinite(value) or value == 0:
        return f"{value:.3g} {unit}"
    for factor, prefix in ((1e15, "P"), (1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= factor:
            return f"{value / factor:.3g} {prefix}{unit}"
    return f"{value:.3g} {unit}"
