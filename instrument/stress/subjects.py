"""What `instrument stress` is asked about: a scene, a kind of plugins, a plugin, a part of the framework; or all."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from instrument.calibrate.base import Calibrator
from instrument.component import Component
from instrument.errors import InputError, did_you_mean
from instrument.foreground.base import ForegroundRemover
from instrument.image.base import AnyImager
from instrument.jones.base import ElementBeam
from instrument.registry import KINDS, Plugin, available, load, plugin_class

# of plugins that have no default for them
USUAL = {"diameter": "25 m", "height": "0.5 m", "fwhm": "10 deg", "pixels": 64, "pixel": "1 arcmin"}
TRIED = ("engines", "elements", "telescopes", "calibrators", "imagers", "foregrounds")
# of the framework, which no plugin replaces
PARTS = ("jones", "geometry", "sky", "visibilities", "photometry", "cubes", "faraday-depth", "spectra", "run")
HELD: dict[str, type[Component]] = {
    "calibrators": Calibrator,
    "imagers": AnyImager,
    "foregrounds": ForegroundRemover,
}


class Subject(NamedTuple):
    """A plugin, by the kind whose cases it goes through; `None` for a part of the framework, or where it lacks what
    `trouble` says.
    """

    stage: str
    name: str
    plugin: Any = None
    trouble: str = ""


def subjects(what: str | None, settings: Mapping[str, Any] | None = None) -> list[Subject]:
    """Everything that goes through cases; `settings` are those of one plugin named.

    Raises `InputError` for a name of nothing, of two things, and of a kind that no case fits.
    """
    if what is None:
        found = [s for kind in TRIED for s in _of_kind(kind)] + [Subject(part, "") for part in PARTS]
    else:
        places = {"a scene": _is_scene(what), "a kind of plugins": what in KINDS, "a part": what in PARTS}
        holders = [kind for kind in KINDS if what in available(kind)]
        named = [place for place, here in places.items() if here] + [f"a plugin of {kind}" for kind in holders]
        if len(named) > 1:
            raise InputError(f"'{what}' is {' and '.join(named)}: rename one, or give the scene as a .toml file")
        if not named:
            raise InputError(f"nothing is called '{what}': {did_you_mean(what, _known())}; or give a .toml file")
        stage = holders[0] if holders else what
        if not places["a scene"] and stage not in (*TRIED, *PARTS):
            raise InputError(f"no case fits {named[0]} ('{what}'): they fit {', '.join((*TRIED, *PARTS))}")
        if places["a scene"]:
            found = list(_of_scene(what))
        elif holders:
            found = [_loaded(stage, what, settings or {})]
        else:
            found = [Subject(what, "")] if places["a part"] else list(_of_kind(stage))
    if settings and (what is None or len(found) != 1 or found[0].plugin is None):
        raise InputError(f"--set {next(iter(settings))}: settings are of one plugin, named before them")
    return found


def _is_scene(what: str) -> bool:
    from instrument.pipeline.scene_text import shipped

    return what.endswith(".toml") or what in shipped() or Path(what).is_file()


def _known() -> list[str]:
    from instrument.pipeline.scene_text import shipped

    names = {*shipped(), *KINDS, *PARTS}
    return sorted(names.union(*(available(kind) for kind in TRIED)))


def _of_kind(kind: str) -> Iterator[Subject]:
    for plugin in available(kind).values():
        trouble = _trouble(plugin)
        yield Subject(kind, plugin.name, trouble=trouble) if trouble else _loaded(kind, plugin.name, {})


def _trouble(plugin: Plugin) -> str:
    return plugin.broken or (f"lacks {plugin.lacks}" if plugin.lacks else "")


def _loaded(kind: str, name: str, settings: Mapping[str, Any]) -> Subject:
    if trouble := _trouble(available(kind)[name]):
        raise InputError(f"plugin '{name}': {trouble}")
    fields = getattr(plugin_class(kind, name, needed=True), "model_fields", {})
    usual = {k: USUAL[k] for k, info in fields.items() if info.is_required() and k in USUAL}
    return Subject(kind, name, load(kind, name, **{**usual, **settings}))


def _of_scene(what: str) -> Iterator[Subject]:
    """The telescope of a scene, its element, and what its stages hold."""
    from instrument.pipeline.scene_file import parse
    from instrument.pipeline.scene_text import read_tables

    scene = parse(read_tables(what))
    telescope = scene.telescope()
    yield Subject("telescopes", scene.name, telescope)
    for part in telescope.chain().parts:
        if isinstance(part, ElementBeam):
            yield Subject("elements", type(part).__name__, part)
    for stage in scene.stages.values():
        for value in (getattr(stage, name) for name in type(stage).model_fields):
            for kind, base in HELD.items():
                if isinstance(value, base):
                    yield Subject(kind, type(value).__name__, value)
