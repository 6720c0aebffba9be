"""Plugins by name, found through entry points: `available`, `load`.

Groups: "instrument." and one of `KINDS`. Entry points are read on first use, never at import. Our own plugins come in
by the same door as a stranger's.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from typing import Any

from instrument.checked import checked
from instrument.errors import PluginError, did_you_mean

KINDS = ("elements", "telescopes", "terms", "engines", "calibrators", "imagers", "foregrounds", "skies", "stages")


@dataclass(frozen=True)
class Plugin:
    """One registered name: what it is called, where it comes from, and why it is broken if it is."""

    kind: str
    name: str
    package: str
    target: str
    broken: str | None = None
    lacks: str | None = None  # packages that it needs and that are not installed


@cache
def _found(kind: str) -> dict[str, list[EntryPoint]]:
    if kind not in KINDS:
        raise PluginError(f"no plugins of kind '{kind}': {did_you_mean(kind, KINDS)}")
    names: dict[str, list[EntryPoint]] = {}
    for point in entry_points(group=f"instrument.{kind}"):
        same = names.setdefault(point.name, [])
        if not any(p.value == point.value for p in same):
            same.append(point)
    return names


def refresh() -> None:
    """Forget what was found, after a package has been installed into a running Python."""
    _found.cache_clear()


def _package(point: EntryPoint) -> str:
    return point.dist.name if point.dist else point.module.split(".")[0]


def names(kind: str) -> list[str]:
    """Registered names of a kind, sorted; nothing is imported."""
    return sorted(_found(kind))


@checked
def available(kind: str) -> dict[str, Plugin]:
    """Every registered plugin of a kind, by name; a broken one says why and does not stop the rest."""
    listing = {}
    for name, points in sorted(_found(kind).items()):
        broken, lacks = None, ""
        try:
            lacks = _lacks(_resolve(kind, name))
        except PluginError as error:
            broken = str(error)
        listing[name] = Plugin(
            kind, name, ", ".join(_package(p) for p in points), points[0].value, broken, lacks or None
        )
    return listing


def _lacks(cls: Any) -> str:
    """Packages that a plugin names in `needs` (module: package) and that cannot be found."""
    needs: dict[str, str] = getattr(cls, "needs", {})
    missing = [package for module, package in needs.items() if find_spec(module) is None]
    return f"{', '.join(missing)}: pip install {' '.join(missing)}" if missing else ""


def _resolve(kind: str, name: str) -> Any:
    names = _found(kind)
    if name not in names:
        raise PluginError(
            f"no {kind[:-1] if kind != 'skies' else 'sky'} is called '{name}': {did_you_mean(name, names)}"
        )
    points = names[name]
    if len(points) > 1:
        both = " and ".join(f"{_package(p)} ({p.value})" for p in points)
        raise PluginError(f"'{name}' in {kind} is claimed by {both}: uninstall one, or use the class itself")
    try:
        return points[0].load()
    except Exception as error:  # a stranger's plugin may fail in any way; it must not break the rest
        raise PluginError(
            f"plugin '{name}' of {_package(points[0])} does not import: {type(error).__name__}: {error}"
        ) from error


def plugin_class(kind: str, name: str, needed: bool = False) -> Any:
    """What stands behind a name, or behind "module:Class" where a plugin is registered as that.

    `None` where there is none, or, if `needed`, a `PluginError` that lists the known ones.
    """
    names = _found(kind)
    found = next((n for n, points in names.items() if name in (n, points[0].value)), name)
    return _resolve(kind, found) if needed or found in names else None


def plugin_name(kind: str, cls: type) -> str | None:
    """The name under which a class is registered, if it is, and nobody else claims that name."""
    value = f"{cls.__module__}:{cls.__qualname__}"
    return next((n for n, points in _found(kind).items() if [p.value for p in points] == [value]), None)


@checked
def load(kind: str, name: str, /, **settings: Any) -> Any:
    """The plugin `name` of `kind`, constructed with `settings`; raises `PluginError` or `InputError`."""
    return _resolve(kind, name)(**settings)
