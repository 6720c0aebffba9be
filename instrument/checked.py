"""`checked`: functions and classes whose arguments are held to their annotations, in one line, before anything runs.

`@checked` on a function, or on a class for its constructor and public methods. The signature is the contract: `int` and
`float` take numbers and no text, `Count`, `Seed`, `Share` theirs, a class its instances, `Literal` its words, an array
an array of numbers; `Any` is left to the function. A call costs a few microseconds more, so loops stay inside.
"""

from __future__ import annotations

import builtins
import functools
import inspect
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import is_dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import numpy as np

from instrument.errors import InputError, did_you_mean
from instrument.numbers import Real, Whole, brief, unmasked

T = TypeVar("T")
Door = Callable[[Any, str], Any]  # (value, name) -> the value to use; raises InputError

_KINDS = {"c": "fiuc", "f": "fiu", "i": "iu", "b": "b"}
_WORDS = {"c": "numbers", "f": "real numbers", "i": "whole numbers", "b": "truth values"}


def checked(thing: T) -> T:
    """The same function or class, whose arguments are checked; see the module."""
    if not inspect.isclass(thing):
        return _held(thing)  # type: ignore[arg-type,return-value]
    for name, found in list(vars(thing).items()):
        constructor = name == "__init__" and (is_dataclass(thing) or "__init__" in vars(thing))
        if (name.startswith("_") and not constructor) or getattr(found, "__isabstractmethod__", False):
            continue
        if isinstance(found, classmethod | staticmethod):
            setattr(thing, name, type(found)(_held(found.__func__)))
        elif inspect.isfunction(found) and not hasattr(thing, "model_fields") * constructor:
            setattr(thing, name, _held(found))
    return thing


def _held(function: Callable[..., Any]) -> Callable[..., Any]:
    signature = inspect.signature(function)
    doors: dict[str, Door] = {}
    ready = False

    @functools.wraps(function)
    def held(*values: Any, **named: Any) -> Any:
        nonlocal ready
        if not ready:
            doors.update(_doors(function, signature))
            ready = True
        try:
            bound = signature.bind(*values, **named)
        except TypeError:
            return function(*values, **named)  # Python's own words say what is missing
        for name, door in doors.items():
            if name in bound.arguments:
                bound.arguments[name] = door(bound.arguments[name], name)
        return function(*bound.args, **bound.kwargs)

    return held


def _doors(function: Callable[..., Any], signature: inspect.Signature) -> dict[str, Door]:
    """A door for each parameter whose annotation says something."""
    names = _Names(function.__globals__)
    found = {}
    for name, parameter in signature.parameters.items():
        hint = parameter.annotation
        if hint is parameter.empty or parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            continue
        if isinstance(hint, str):
            hint = eval(hint, {}, names)  # the function's own annotation
        door = _door(hint)
        if door is not None:
            found[name] = door
    return found


class _Names(dict[str, Any]):
    """What a name in an annotation means: where the function stands, a builtin, a public name, or anything."""

    def __missing__(self, name: str) -> Any:
        top = sys.modules[__name__.partition(".")[0]]
        public = getattr(top, name) if name in getattr(top, "__all__", ()) else Any  # imported for type checkers only
        return getattr(builtins, name, public)


def _door(hint: Any) -> Door | None:
    """What an annotation lets in; `None` where it says nothing."""
    origin, inside = get_origin(hint), get_args(hint)
    if origin in (UnionType, Union):
        options = [_door(option) for option in inside]
        return None if None in options else _any_of([o for o in options if o is not None])
    if origin is Annotated:
        return next((mark.check for mark in inside[1:] if isinstance(mark, Real)), None)
    if origin is Literal:
        return _literal(inside)
    if hint in (int, float):
        return (Whole() if hint is int else Real()).check
    if hint in (bool, str):
        return _of(f"{'True or False' if hint is bool else 'text'}", lambda v: isinstance(v, (hint, _NUMPY[hint])))
    if hint is NoneType or hint is None:
        return _of("None", lambda v: v is None)
    if origin is np.ndarray:
        return _array(inside[-1])
    return _of_class(hint, origin, inside)


_NUMPY: dict[Any, Any] = {bool: np.bool_, str: np.str_}


def _of_class(hint: Any, origin: Any, inside: tuple[Any, ...]) -> Door | None:
    """The door of a class, of a list of things, of a function."""
    if origin is tuple:
        return _tuple(inside)
    if origin is os.PathLike:
        return _of("a path", lambda v: isinstance(v, os.PathLike))
    if origin is Callable or hint is Callable:
        return _of("a function", callable)
    if inspect.isclass(origin) and issubclass(origin, Iterable):
        if issubclass(origin, Mapping):
            return _of("a dictionary", lambda v: isinstance(v, Mapping))
        if not issubclass(origin, Sequence):
            return _of("something to go through", lambda v: isinstance(v, Iterable) and not isinstance(v, str | bytes))
        each = _door(inside[0]) if inside else None
        return _sequence(each)
    if inspect.isclass(hint) and not getattr(hint, "_is_protocol", False) and hint not in (object, Any):
        article = "an" if hint.__name__[0] in "AEIO" else "a"
        return _of(f"{article} {hint.__name__}", lambda v: isinstance(v, hint))
    return None


def _of(what: str, fits: Callable[[Any], bool]) -> Door:
    def door(value: Any, name: str) -> Any:
        if not fits(value):
            raise InputError(f"{name} = {brief(value)} must be {what}")
        return value

    return door


def _any_of(options: list[Door]) -> Door:
    def door(value: Any, name: str) -> Any:
        said = []
        for option in options:
            try:
                return option(value, name)
            except InputError as error:
                said.append(str(error))
        start = f"{name} = {brief(value)} must be "
        ways = [text.removeprefix(start) for text in said if text.startswith(start)]
        raise InputError(start + " or ".join(dict.fromkeys(ways)) if len(ways) == len(said) else said[0])

    return door


def _literal(words: tuple[Any, ...]) -> Door:
    def door(value: Any, name: str) -> Any:
        if not any(type(value) is type(word) and value == word for word in words):
            listed = f"{name} = {brief(value)} is not one of {', '.join(repr(w) for w in words)}"
            near = (
                did_you_mean(value, [w for w in words if isinstance(w, str)]).partition("?")[0]
                if isinstance(value, str)
                else ""
            )
            raise InputError(f"{listed}: {near}?" if near.startswith("did") else listed)
        return value

    return door


def _tuple(inside: tuple[Any, ...]) -> Door | None:
    """Fixed length or any: a list will do."""
    if not inside:
        return _of("a tuple", lambda v: isinstance(v, tuple | list))
    if inside[-1] is Ellipsis:
        return _sequence(_door(inside[0]))
    doors = [_door(each) for each in inside]

    def door(value: Any, name: str) -> Any:
        if not isinstance(value, tuple | list | np.ndarray) or len(value) != len(doors):
            raise InputError(f"{name} = {brief(value)} must be {len(doors)} values")
        return tuple(v if d is None else d(v, name) for v, d in zip(value, doors, strict=True))

    return door


def _sequence(each: Door | None) -> Door:
    def door(value: Any, name: str) -> Any:
        if isinstance(value, str | bytes) or not isinstance(value, Sequence | np.ndarray) or np.shape(value) == ():
            raise InputError(f"{name} = {brief(value)} must be a list")
        for k, item in enumerate(value if each is not None else ()):
            each(item, f"{name}[{k}]")  # type: ignore[misc]
        return value

    return door


def _array(dtype: Any) -> Door:
    kind = {"c": "c", "f": "f", "i": "i", "b": "b"}.get(_kind(dtype), "c")

    def door(value: Any, name: str) -> Any:
        given = (
            value if isinstance(value, np.ndarray) else np.asarray(value) if isinstance(value, list | tuple) else None
        )
        if (
            given is None
            or getattr(value, "unit", None) is not None
            or (given.size and given.dtype.kind not in _KINDS[kind])
        ):
            raise InputError(f"{name} = {brief(value)} must be an array of {_WORDS[kind]}")
        unmasked(value, name)
        return np.asarray(given)

    return door


def _kind(dtype: Any) -> str:
    """The kind of the numbers of `np.dtype[np.float64]`: "f"."""
    inner = get_args(dtype)
    found = get_origin(inner[0]) or inner[0] if inner else None
    names = ((np.complexfloating, "c"), (np.floating, "f"), (np.integer, "i"), (np.bool_, "b"))
    return next((k for cls, k in names if inspect.isclass(found) and issubclass(found, cls)), "c")
