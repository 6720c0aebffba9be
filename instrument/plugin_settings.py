"""What a plugin can be given: its settings with their units, ranges and defaults, as text."""

from __future__ import annotations

import inspect
import math
import types
from collections.abc import Iterator
from typing import Any, Literal, Union, get_args, get_origin

from instrument.component import Component
from instrument.errors import PluginError, did_you_mean
from instrument.numbers import Real, brief
from instrument.registry import KINDS, Plugin, available, plugin_class
from instrument.units import Direction, In

UNITS = {"rad": "deg", "s": "s, min, h", "Hz": "MHz", "m": "m, km"}  # a unit that scene files are written in, beside SI


def describe(name: str) -> list[str]:
    """Lines about every plugin of a name; raises `PluginError` when there is none."""
    found = [(kind, plugins[name]) for kind in KINDS if name in (plugins := available(kind))]
    if not found:
        known = [plugin for kind in KINDS for plugin in available(kind)]
        raise PluginError(f"no plugin is called {brief(name)}: {did_you_mean(name, known)}")
    return [line for kind, plugin in found for line in _lines(kind, plugin)]


def _lines(kind: str, plugin: Plugin) -> Iterator[str]:
    yield f"{plugin.name}   ({kind}, {plugin.package}: {plugin.target})"
    for trouble in (plugin.broken and f"BROKEN: {plugin.broken}", plugin.lacks and f"lacks {plugin.lacks}"):
        if trouble:
            yield f"  {trouble}"
    if plugin.broken:
        return
    cls = plugin_class(kind, plugin.name, needed=True)
    yield from (f"  {line}".rstrip() for line in (inspect.getdoc(cls) or "").splitlines())
    own = (cls.settings_of or (cls,)) if issubclass(cls, Component) else ()
    rows = [_row(one, name) for one in own for name in one.model_fields]
    yield ""
    if not rows:
        yield "  no settings"
        return
    widths = [max(len(row[k]) for row in rows) for k in range(2)]
    for name, default, what in rows:
        yield f"  {name:<{widths[0]}}  {default:<{widths[1]}}  {what}".rstrip()


def _row(cls: type[Component], field: str) -> tuple[str, str, str]:
    """Name, default and what a setting takes."""
    info = cls.model_fields[field]
    unit = next((mark for mark in _marks(info) if isinstance(mark, In)), None)
    if info.is_required():
        default = "needed"
    elif info.default is None:
        default = "none"
    elif unit is not None:
        default = _with_unit(info.default, unit)
    elif isinstance(info.default, Component):
        default = type(info.default).__name__
    else:
        default = "random" if info.default_factory else brief(info.default)
    return info.alias or field, default, _what(info, unit)


def _with_unit(value: Any, unit: In) -> str:
    """A default as a scene file would have it; angles in degrees."""
    if unit.array:
        return brief(value)
    if isinstance(value, tuple):
        return f"[{', '.join(_with_unit(one, unit) for one in value)}]"
    return f"{math.degrees(value):g} deg" if unit.unit == "rad" else f"{value:g} {unit.unit}"


LIMITS = {"above": "above", "gt": "above", "at_least": "at least", "ge": "at least", "lt": "below", "le": "at most"}


def _what(info: Any, unit: In | None) -> str:
    marks = _marks(info)
    limits = [
        f"{word} {value:g}"
        for mark in marks
        for key, word in LIMITS.items()
        if not isinstance(mark, Real) and (value := getattr(mark, key, None)) is not None
    ]
    if unit is not None:
        many = "values" if unit.array else "a value"
        return ", ".join([f"{many} with a unit ({UNITS.get(unit.unit, unit.unit)})", *limits])
    number = next((mark for mark in marks if isinstance(mark, Real)), None)
    return ", ".join([str(number) if number is not None else _type(info.annotation), *limits])


def _marks(info: Any) -> list[Any]:
    """What annotates a field, also inside `X | None`."""
    inner = [mark for option in get_args(info.annotation) for mark in getattr(option, "__metadata__", ())]
    return [*info.metadata, *inner]


def _type(kind: Any) -> str:
    """A type in words."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Literal:
        return " or ".join(f'"{value}"' for value in inner)
    if origin in (Union, types.UnionType):
        return " or ".join(_type(option) for option in inner if option is not type(None))
    if origin in (tuple, list):
        return f"a list: {', '.join(_type(option) for option in inner if option is not ...)}"
    if hasattr(kind, "__metadata__"):
        marks = [str(mark) for mark in kind.__metadata__ if isinstance(mark, Real)]
        return marks[0] if marks else _type(get_args(kind)[0])
    if isinstance(kind, type) and issubclass(kind, Component):
        names = ", ".join(available(kind.plugin_kind)) if kind.plugin_kind else ""
        return (
            f"{kind.__name__}, as a name or {{ kind = name, ... }}: {names}" if names else f"a table: {kind.__name__}"
        )
    words = {bool: "true or false", str: "text", float: "a number", int: "a whole number"}
    words[Direction] = 'a direction such as "08h13m36.0s +48d13m03s"'
    return words.get(kind, getattr(kind, "__name__", str(kind)))
