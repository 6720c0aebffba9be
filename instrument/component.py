"""`Component`: the frozen, unit-aware, JSON-able base of everything a user can compose."""

from __future__ import annotations

import hashlib
import inspect
import json
import re
import sys
from abc import ABC
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from types import UnionType
from typing import Any, ClassVar, Self, Union, get_args, get_origin

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    ModelWrapValidatorHandler,
    SerializationInfo,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
    model_validator,
)
from pydantic.fields import FieldInfo

from instrument.checked import checked
from instrument.errors import InputError, did_you_mean
from instrument.numbers import Index, brief
from instrument.registry import load, plugin_class, plugin_name
from instrument.shown import represented, unit_of

KIND = "kind"  # the key under which text names a class: a plugin by its name, another component by its class name
OLD_TAG = "component"  # "module:Class", written until 2026-11; understood for classes that are known, never imported


@checked
class Component(BaseModel, ABC):
    """A frozen set of named, validated settings; equal when its fields are equal.

    A subclass is abstract or final. Fields are given by keyword with their units; wrong input raises `InputError` in
    one line. `to_json` writes the class beside the fields as `{"kind": name}`, `from_json` gives the same subclass
    back: a plugin by its name, another class by its class name, once it is defined; text never imports a module. A
    field that is typed with an abstract component also takes the name of a plugin, or `{"kind": name, ...}` with its
    settings, when the class names its `plugin_kind`.
    """

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        arbitrary_types_allowed=True,
        populate_by_name=True,
        ser_json_inf_nan="constants",
        allow_inf_nan=False,
    )
    plugin_kind: ClassVar[str | None] = None
    settings_of: ClassVar[tuple[type[Component], ...]] = ()  # whose fields are the keys of its text, if not its own
    needs: ClassVar[dict[str, str]] = {}  # modules beyond those of this package, and the packages they come with

    def __init__(self, /, *values: Any, **fields: Any) -> None:
        if values:
            known = ", ".join(f"{name}=..." for name in type(self).model_fields)
            raise InputError(f"{type(self).__name__} takes its settings by keyword: {known}")
        try:
            super().__init__(**fields)
        except ValidationError as error:
            raise InputError(one_line(type(self), error)) from None

    @model_validator(mode="wrap")
    @classmethod
    def _right_subclass(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        if isinstance(data, str) and cls.plugin_kind:
            return _checked(_by_name(cls.plugin_kind, data), cls)
        if isinstance(data, Mapping) and (KIND in data or ":" in str(data.get(OLD_TAG))):
            found = class_of(data, cls)
            fields = {k: v for k, v in data.items() if k not in (KIND, OLD_TAG)}
            return handler(fields) if found is cls else found(**fields)
        if isinstance(data, Mapping) and inspect.isabstract(cls):
            raise InputError(f"{cls.__name__} is abstract: the text must name a class under '{KIND}'")
        if isinstance(data, Mapping):
            _text_is_no_number(cls, data)
        return handler(data)

    @model_serializer(mode="wrap")
    def _with_tag(self, handler: SerializerFunctionWrapHandler, info: SerializationInfo) -> Any:
        fields = handler(self)
        if not type(self).model_fields.keys() <= fields.keys():  # the field that holds it is typed with a base class
            return type(self).__pydantic_serializer__.to_python(self, mode=info.mode)
        return {KIND: public_name(type(self)), **fields}

    def to_json(self, indent: Index | None = None) -> str:
        """The component as JSON text; every value with a unit is a string with that unit."""
        return json.dumps(self.to_dict(), indent=indent)

    def to_dict(self) -> dict[str, Any]:
        """The component as plain dictionaries, lists, strings and numbers."""
        return self.model_dump(mode="json")

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Inverse of `to_json`; raises `InputError` when the text is not a component of this class."""
        try:
            data = json.loads(text)
        except json.JSONDecodeError as error:
            raise InputError(f"not JSON: {error}") from None
        try:
            return cls.model_validate(data)
        except ValidationError as error:
            raise InputError(one_line(cls, error)) from None

    def with_fields(self, **fields: Any) -> Self:
        """A copy with some fields given anew, validated like the first time."""
        names = {info.alias: k for k, info in type(self).model_fields.items() if info.alias}
        fields = {names.get(k, k): v for k, v in fields.items()}
        kept = {k: getattr(self, k) for k in type(self).model_fields if k not in fields}
        for name, value in kept.items():
            kept[name] = _at_the_door(type(self), name, value)
        return type(self)(**kept, **fields)

    def __setattr__(self, name: str, value: Any) -> None:
        try:
            super().__setattr__(name, value)
        except ValidationError:
            raise InputError(f"{type(self).__name__} is frozen: use .with_fields({name}=...), a copy") from None

    def __delattr__(self, name: str) -> None:
        raise InputError(f"{type(self).__name__} is frozen: '{name}' stays")

    def fingerprint(self) -> str:
        """Hex digest of the fields: equal components have equal fingerprints."""
        # -0.0 equals 0.0
        text = re.sub(r"(?<!\w)-0\.0(?!\d)", "0.0", self.to_json())
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def __repr__(self) -> str:
        return represented(type(self).__name__, self._shown())

    def __str__(self) -> str:
        return repr(self)

    def _shown(self) -> Iterator[tuple[str, Any, str]]:
        """Name, value and unit of every field that is not its default."""
        for name, info in type(self).model_fields.items():
            value = getattr(self, name)
            if info.is_required() or not _same(value, info.get_default(call_default_factory=True)):
                yield info.alias or name, value, _unit(info) or unit_of(name)

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return all(_same(getattr(self, k), getattr(other, k)) for k in type(self).model_fields)

    def __hash__(self) -> int:
        return hash(self.fingerprint())

    def __setstate__(self, state: dict[Any, Any]) -> None:
        super().__setstate__(state)
        for value in self.__dict__.values():  # pickling forgets that arrays are read-only
            if isinstance(value, np.ndarray):
                value.setflags(write=False)


def _at_the_door(cls: type[Component], name: str, value: Any) -> Any:
    """A stored SI value as it would be given: with its unit."""
    unit = _unit(cls.model_fields[name])
    if value is None or unit is None:
        return value
    from astropy import units as u

    return u.Quantity(value, unit)


def _unit(info: FieldInfo) -> str | None:
    """The unit that a field is stored in, if it has one ("" has no dimension)."""
    from instrument.units import In

    inner = [mark for option in get_args(info.annotation) for mark in getattr(option, "__metadata__", ())]  # X | None
    return next((mark.unit for mark in (*info.metadata, *inner) if isinstance(mark, In)), None)


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return (
            isinstance(a, np.ndarray)
            and isinstance(b, np.ndarray)
            and np.array_equal(a, b, equal_nan=a.dtype.kind in "fc")
        )
    if isinstance(a, tuple | list) and isinstance(b, tuple | list):
        return len(a) == len(b) and all(_same(x, y) for x, y in zip(a, b, strict=True))
    return bool(a == b)


def _text_is_no_number(cls: type[Component], data: Mapping[Any, Any]) -> None:
    """Refuse text and truth values where a field takes plain numbers: pydantic would make 2 of "2" and 1 of True."""
    for name, info in cls.model_fields.items():
        if any(hasattr(mark, "__get_pydantic_core_schema__") for mark in info.metadata):
            continue  # a field with a door of its own
        wrong = _no_number(info.annotation, data.get(name, data.get(info.alias) if info.alias else None))
        if wrong is not None:
            raise InputError(f"{info.alias or name} = {brief(wrong)} must be a number")


def _no_number(annotation: Any, value: Any) -> Any:
    """The text or truth value that stands where an annotation such as `int | None` takes a number, if any."""
    options = {annotation, *(get_args(annotation) if get_origin(annotation) in (UnionType, Union) else ())}
    if isinstance(value, str | bytes | bool | np.bool_):
        return value if options & {int, float} and not options & {str, bool} else None
    for option in options:
        if get_origin(option) is tuple and isinstance(value, tuple | list):
            inner = get_args(option)[0]
            return next((w for v in value if (w := _no_number(inner, v)) is not None), None)
    return None


def _by_name(kind: str, name: str) -> Any:
    """A plugin as it is without settings; where it needs some, the error shows how they are given."""
    try:
        return load(kind, name)
    except InputError as error:
        needs = re.search(r"needs '(\w+)'", str(error))
        if needs is None:
            raise
        raise InputError(f'{error}; write {{ kind = "{name}", {needs[1]} = ... }}') from None


def _checked(found: Any, wanted: type[Any]) -> Any:
    if not isinstance(found, wanted):
        raise InputError(f"{type(found).__name__} is not a {wanted.__name__}")
    return found


def public_name(cls: type[Component]) -> str:
    """What text calls a class: the name of the plugin that it is, or else its class name."""
    found = plugin_name(cls.plugin_kind, cls) if cls.plugin_kind else None
    return found or cls.__name__


def class_of(data: Mapping[str, Any], wanted: type[Component]) -> type[Any]:
    """The class that a mapping names under "kind": a plugin, or a class that is defined; no module is imported."""
    tag = data.get(KIND, data.get(OLD_TAG))
    if not isinstance(tag, str):
        raise InputError(f"{KIND} = {brief(tag)} must be the name of a class or of a plugin")
    known = _subclasses(wanted)
    kinds = {c.plugin_kind for c in (wanted, *known.values()) if c.plugin_kind}
    plugins = [c for kind in sorted(kinds) if isinstance(c := plugin_class(kind, tag), type)]
    name = tag.rpartition(":")[2].rpartition(".")[2]
    top = sys.modules[__name__.partition(".")[0]]
    public = getattr(top, name) if name in getattr(top, "__all__", ()) else None
    for found in (*(c for c in plugins if issubclass(c, wanted)), known.get(name), public, *plugins):
        if isinstance(found, type) and issubclass(found, Component):
            if not issubclass(found, wanted):
                raise InputError(f"'{tag}' is {found.__name__}, which is not a {wanted.__name__}")
            return found
    if wanted.plugin_kind and not get_close_matches(tag, known, cutoff=0.8):
        plugin_class(wanted.plugin_kind, tag, needed=True)
    raise InputError(f"no {wanted.__name__} is called {brief(tag)}: {did_you_mean(tag, known)}")


def _subclasses(wanted: type[Component]) -> dict[str, type[Component]]:
    """Every class defined so far that is a `wanted`, by its name; of two with one name, the later."""
    found = {wanted.__name__: wanted}
    for cls in wanted.__subclasses__():
        found |= _subclasses(cls)
    return found


def one_line(cls: type[BaseModel], error: ValidationError) -> str:
    """A pydantic error as one line: the field, the value and the remedy."""
    parts = []
    for item in error.errors():
        where = ".".join(str(p) for p in item["loc"])
        kind, message = item["type"], item["msg"].removeprefix("Value error, ")
        if kind == "extra_forbidden":
            known = _fields_at(cls, item["loc"][:-1])
            parts.append(f"{cls.__name__} has no '{where}': {did_you_mean(str(item['loc'][-1]), known)}")
        elif kind == "missing":
            parts.append(f"{cls.__name__} needs '{where}'")
        elif kind == "value_error":
            inside = where and not message.startswith(where) and str(item["loc"][-1]) not in message
            parts.append(f"{where}: {message}" if inside else message)
        elif kind in ("model_type", "dict_type"):
            keys = " = ..., ".join(_fields_at(cls, item["loc"]))
            parts.append(
                f"{where or cls.__name__} = {brief(item['input'])} must be a table{keys and f': {{ {keys} = ... }}'}"
            )
        elif kind == "literal_error":
            known = re.findall(r"'([^']+)'", item["ctx"]["expected"])
            near = get_close_matches(str(item["input"]), known, 1)
            hint = f": did you mean '{near[0]}'?" if near else ""
            parts.append(f"{where} = {brief(item['input'])} is not one of {', '.join(map(repr, known))}{hint}")
        elif kind in ("tuple_type", "list_type"):
            parts.append(f"{where} = {brief(item['input'])} must be a list, in brackets")
        else:
            parts.append(f"{where} = {item['input']!r}: {message[:1].lower()}{message[1:]}")
    return "; ".join(parts)


def _fields_at(cls: type[BaseModel], path: tuple[int | str, ...]) -> list[str]:
    fields: Any = cls
    for step in path:
        info = getattr(fields, "model_fields", {}).get(step)
        options = [info.annotation, *getattr(info.annotation, "__args__", ())] if info else []
        fields = next((o for o in options if hasattr(o, "model_fields")), None)
    return [info.alias or name for name, info in getattr(fields, "model_fields", {}).items()]
