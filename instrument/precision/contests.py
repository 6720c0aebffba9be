"""Which contests there are: of an engine, a calibrator, a remover, by the kind of the plugin, or of a scene."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from instrument.errors import InputError, did_you_mean
from instrument.precision import (
    beamed,
    calibrators,
    elements,
    engines,
    faraday,
    foregrounds,
    imagers,
    photometry,
    plain,
    runs,
    spectra,
    telescopes,
)
from instrument.precision.contest import Contest, Form
from instrument.registry import available

FULL = Form()


def _engines(plugins: dict[str, Any], form: Form) -> list[Contest]:
    """Those of engines alone, and where other programs are drawn in also those that these can do."""
    beside = (*plain.contests(plugins, form), *beamed.contests(plugins, form)) if form.peers else ()
    return [*engines.contests(plugins, form), *beside]


# kind of plugin -> its contests, of plugins by name
OF_KIND: dict[str, Callable[[dict[str, Any], Form], list[Contest]]] = {
    "engines": _engines,
    "elements": elements.contests,
    "telescopes": telescopes.contests,
    "calibrators": calibrators.contests,
    "imagers": imagers.contests,
    "foregrounds": foregrounds.contests,
}
# what is no plugin -> its contests
OF_STAGE: dict[str, Callable[[Form], list[Contest]]] = {
    "photometry": photometry.contests,
    "rm-synthesis": faraday.synthesis,
    "rm-clean": faraday.clean,
    "spectra": spectra.contests,
}
# a table of a scene file -> what of the above it holds
HOLDS = {
    "predict": ("engines",),
    "calibrate": ("calibrators",),
    "image": ("imagers",),
    "analyze": (*OF_STAGE, "foregrounds"),
    "all": (*OF_KIND, *OF_STAGE),
}


def contests_of(what: str, plugins: tuple[str, ...] = (), form: Form = FULL) -> list[Contest]:
    """The contests of WHAT: a scene, a stage, a kind of plugin, or a plugin, beside all others of its kind.

    Of a plugin those that it takes part in; with `plugins` of these alone. Raises `InputError` where WHAT is nothing,
    two things, or has no contest yet.
    """
    from instrument.pipeline.scene_text import shipped

    stages = (*OF_STAGE, *HOLDS)
    found = [f"a {word}" for word, names in (("stage", stages), ("kind of plugin", OF_KIND)) if what in names]
    kinds = [what] if what in OF_KIND else [kind for kind in OF_KIND if what in available(kind)]
    if what not in OF_KIND:
        found += [f"one of {kind}" for kind in kinds]
    if what.endswith(".toml") or what in shipped():
        found.insert(0, "a scene")
    if len(found) > 1:
        way = f"write it as {what}.toml, or" if "a scene" in found else f"with --plugins {what},"
        raise InputError(f"'{what}' is {' and '.join(found)}: {way} name a kind")
    if not found:
        known = [*shipped(), *stages, *OF_KIND, *(name for kind in OF_KIND for name in available(kind))]
        raise InputError(
            f"no scene, stage, kind of plugin or plugin with a contest is called '{what}': {did_you_mean(what, known)}"
        )
    if what in HOLDS:
        if plugins and len(HOLDS[what]) > 1:
            raise InputError(f"--plugins {','.join(plugins)}: {what} is {', '.join(HOLDS[what])}; name one of them")
        return [contest for part in HOLDS[what] for contest in contests_of(part, plugins, form)]
    if what in OF_STAGE:
        if plugins:
            raise InputError(f"--plugins {','.join(plugins)}: the contest of {what} is of settings, leave it out")
        return OF_STAGE[what](form)
    if kinds:
        every = OF_KIND[kinds[0]](_chosen(kinds[0], plugins), form)
        return every if what in OF_KIND else _with(what, every)
    chosen = _chosen("engines", plugins)
    return [*engines.contests_of_scene(what, chosen, form), *runs.contests_of_scene(what, chosen, form)]


def _with(what: str, contests: list[Contest]) -> list[Contest]:
    """Those in which a plugin takes part: entries are "plugin", "plugin, way" or "plugin (knob)"; else all of them."""
    return [c for c in contests if any(re.split(r",| \(", e.plugin)[0] == what for e in c.entries)] or contests


def _chosen(kind: str, names: tuple[str, ...]) -> dict[str, Any]:
    """Classes of plugins by name: those asked for, or all that can be had."""
    from instrument.registry import plugin_class

    if names:
        return {name: plugin_class(kind, name, needed=True) for name in names}
    found = available(kind)
    return {name: plugin_class(kind, name) for name, one in found.items() if not (one.broken or one.lacks)}
