"""Which contests there are: of an engine, a calibrator, a remover, by the kind of the plugin, or of a scene."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from instrument.errors import InputError, did_you_mean
from instrument.precision import calibrators, engines, foregrounds
from instrument.precision.contest import Contest
from instrument.registry import available

# kind of plugin -> its contests, of plugins by name; `quick` takes fewer values
OF_KIND: dict[str, Callable[[dict[str, Any], bool], list[Contest]]] = {
    "engines": engines.contests,
    "calibrators": calibrators.contests,
    "foregrounds": foregrounds.contests,
}


def contests_of(what: str, plugins: tuple[str, ...] = (), quick: bool = False) -> list[Contest]:
    """The contests of WHAT: a scene, a kind of plugin, or a plugin, which then stands beside all others of its kind.

    With `plugins` of these alone. Raises `InputError` where WHAT is nothing, two things, or has no contest yet.
    """
    from instrument.pipeline.scene_text import shipped

    kinds = [what] if what in OF_KIND else [kind for kind in OF_KIND if what in available(kind)]
    is_scene = what.endswith(".toml") or what in shipped()
    if is_scene and kinds:
        raise InputError(f"'{what}' is a scene, and {kinds[0]}: write it as {what}.toml, or name a kind")
    if len(kinds) > 1:
        raise InputError(f"'{what}' is found in {' and '.join(kinds)}: name a kind, with --plugins {what}")
    if is_scene:
        return engines.contests_of_scene(what, _chosen("engines", plugins), quick)
    if not kinds:
        known = [*shipped(), *OF_KIND, *(name for kind in OF_KIND for name in available(kind))]
        raise InputError(
            f"no scene, kind of plugin or plugin with a contest is called '{what}': {did_you_mean(what, known)}"
        )
    return OF_KIND[kinds[0]](_chosen(kinds[0], plugins), quick)


def _chosen(kind: str, names: tuple[str, ...]) -> dict[str, Any]:
    """Classes of plugins by name: those asked for, or all that can be had."""
    from instrument.registry import plugin_class

    if names:
        return {name: plugin_class(kind, name, needed=True) for name in names}
    found = available(kind)
    return {name: plugin_class(kind, name) for name, one in found.items() if not (one.broken or one.lacks)}
