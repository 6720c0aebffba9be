"""Scene files: TOML tables, one per stage, read and checked before anything runs."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any, Self

from pydantic import Field, model_validator

from instrument.component import KIND, Component, class_of, public_name
from instrument.errors import InputError, did_you_mean, unused
from instrument.jones.base import JonesTerm
from instrument.jones.feed import FeedTerm
from instrument.jones.gain import GainTerm
from instrument.model import Instrument
from instrument.numbers import Seed, Tolerance, brief
from instrument.observe.observation import Observation
from instrument.pipeline.observation_table import ObservationTable
from instrument.pipeline.stage import SEED_STEP, Beside, Stage, in_order
from instrument.pipeline.stages.data import Data
from instrument.plan import Item, Plan
from instrument.registry import available, load, names, plugin_class
from instrument.scene import Scene
from instrument.sky.base import Sky
from instrument.sky.points import PointSky

MOST_CHANNELS = 1_000_000


class SceneFile(Component):
    """A scene file: `instrument`, `observation` and `sky`, and the `tables` of the stages that follow.

    With a table [data] the observation is that of the data, and the sky may be left out where no stage needs a model.

    A table names a stage, by its plugin: `[noise]`, `[image]`. With `kind = K` in it the stage "TABLE.K" is taken where
    there is one. An absent table is a stage that is left out.
    """

    name: str
    title: str = ""
    seed: Seed = 0
    tolerance: Tolerance = 0.0
    engine: str | None = None
    instrument: dict[str, Any]
    observation: ObservationTable | None = None
    sky: dict[str, Any] = Field(default_factory=dict)
    tables: dict[str, dict[str, Any]] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _stages_fit(self) -> Self:
        # wrong settings of a stage are refused before anything is planned
        self.stages  # noqa: B018
        if not self.sky and (lacking := [n for n, stage in self.stages.items() if stage.needs_sky]):
            remedy = ", or products = [] where it is of cubes alone" if lacking[0] == "analyze" else ""
            raise InputError(f"[{lacking[0]}] needs a model of the sky: give a table [sky]{remedy}")
        odd = not self.name.isprintable() or self.name != self.name.strip() or len(self.name.encode()) > 200
        if not self.name or odd or any(c in self.name for c in "/\\") or self.name.startswith("."):
            raise InputError(f"name = {brief(self.name)} cannot name a folder")
        return self

    @cached_property
    def stages(self) -> dict[str, Stage]:
        """Every stage that is there, by its table, in the order of the run."""
        beside = Beside(self.seed, self.tables, self.observed.width_hz)
        made = {name: _stage(name, settings, beside) for name, settings in self.tables.items() if name != "data"}
        return in_order(made | ({} if self.data is None else {"data": self.data}))

    @cached_property
    def data(self) -> Data | None:
        """The visibilities that take the place of those that would be simulated, where there is [data]."""
        if "data" not in self.tables:
            return None
        found = _stage("data", self.tables["data"], Beside(self.seed, {}, None))
        assert isinstance(found, Data)
        return found

    @cached_property
    def observed(self) -> Observation:
        """The observation of the table [observation], or that of the data."""
        if (self.data is None) == (self.observation is None):
            said = "[observation] stands beside [data], whose observation is taken: leave one of them out"
            need = "a scene needs a table [observation], or data: `instrument image SCENE --data x.MS`, or [data]"
            raise InputError(need if self.data is None else said)
        if self.data is not None:
            with _in_table("data"):
                return self.data.observation
        assert self.observation is not None
        with _in_table("observation"):
            return self.observation.observation()

    def files(self) -> list[str]:
        """The files and folders that its tables name: what is there, and what [into] writes."""
        into = self.tables.get("into", {}).get("set")
        named = [text for text in _texts([self.instrument, self.sky, self.tables]) if _is_there(text)]
        return named if into is None else [*named, str(into)]

    @property
    def modelled(self) -> bool:
        """Whether anything is predicted: not where visibilities are those of [data] and no stage needs a model."""
        return self.data is None or any(stage.needs_sky for stage in self.running.values())

    @property
    def read(self) -> bool:
        """Whether visibilities are read from [data]: not where a prediction alone is written into the set."""
        return self.data is not None and any(stage.reads for stage in self.running.values())

    @property
    def alone(self) -> str | None:
        """The stage that makes its own blocks, if there is one: no other runs."""
        return next((name for name, stage in self.stages.items() if stage.alone is not None), None)

    @property
    def running(self) -> dict[str, Stage]:
        """The stages that run, in order."""
        return self.stages if self.alone is None else {self.alone: self.stages[self.alone]}

    def telescope(self) -> Instrument:
        """The instrument of the table [instrument]."""
        settings = dict(self.instrument)
        name = settings.pop("telescope", None)
        if name is None:
            raise InputError(f"[instrument] needs 'telescope': one of {', '.join(available('telescopes'))}")
        if self.data is not None:
            settings = self._of_data(name) | settings
        for step, (key, cls) in enumerate((("gain", GainTerm), ("feed", FeedTerm)), start=1):
            if isinstance(settings.get(key), dict):
                with _in_table(f"instrument.{key}"):
                    settings[key] = cls(**{"seed": SEED_STEP * self.seed + step, **settings[key]})
        if "terms" in settings:
            settings["terms"] = _terms(settings["terms"], self.seed)
        with _in_table("instrument"):
            found: Instrument = load("telescopes", name, **settings)
        for label, term in zip(self.instrument.get("terms", ()), found.terms, strict=True):
            with _in_table(f"instrument.terms.{label}"):
                found.with_fields(terms=(term,)).chain()  # a term that fits nowhere is told by its label
        if self.read and (errors := [public_name(type(term)) for term in found.errors()]):
            unused("[instrument]", errors, "[data] has the errors of its own instrument")
            found = found.perfect()
        return found

    def _of_data(self, telescope: str) -> dict[str, Any]:
        """What a telescope is told of the stations of the data, where it takes it."""
        assert self.data is not None
        layout = self.data.source.frame.layout
        names = tuple(self.instrument.get("stations", layout.names))
        told: dict[str, Any] = {"stations": names}
        with suppress(ValueError):  # a station that is not there is told by the stage
            told["positions_m"] = layout.positions_m[[layout.names.index(name) for name in names]]
        fields = plugin_class("telescopes", telescope, needed=True).model_fields
        return {name: value for name, value in told.items() if name in fields}

    def sky_model(self) -> Sky:
        """The sky of the table [sky]."""
        settings = dict(self.sky)
        if not self.modelled:
            return _stand_in(self.observed)
        kind = settings.pop("kind", None)
        if kind is None:
            raise InputError(f"[sky] needs 'kind': one of {', '.join(available('skies'))}")
        with _in_table("sky"):
            found: Sky = load("skies", kind, **settings)
        return found

    def scene(self) -> Scene:
        """The scene: instrument, sky and observation."""
        return Scene(name=self.name, instrument=self.telescope(), sky=self.sky_model(), observation=self.observed)

    def products_uv_range(self) -> tuple[float, float] | None:
        """The uv range, in wavelengths, that holds all the products asked for; `None` when one needs all baselines."""
        ranges = [r for stage in self.running.values() for r in stage.ranges()]
        given = [r for r in ranges if r is not None]
        if self.data is not None and not self.data.source.closes:
            return None  # which baselines are within it only those of the data tell
        if not given or len(given) < len(ranges):
            return None
        return min(r[0] for r in given), max(r[1] for r in given)

    def plan(self, scene: Scene, memory: Any = None, workers: int | None = None) -> Plan:
        """The plan of its scene: baselines that no product needs and stages that are absent are left out.

        A stage that is `perfect` has the prediction without errors of receivers, which it gets block by block. What a
        table asks for and no stage takes is named in a warning.
        """
        self._say_unused()
        for name, stage in self.running.items():
            with _in_table(name):
                stage.check(scene)
        errors = [public_name(type(term)) for term in scene.instrument.errors()]
        perfect = any(stage.perfect for stage in self.running.values())
        if perfect:
            scene = scene.with_fields(instrument=scene.instrument.perfect())
        found = scene.plan(
            tolerance=self.tolerance,
            engine=self.engine,
            memory=memory,
            workers=workers,
            uv_range=self.products_uv_range(),
        )
        absent = [name for name in top_level() if name not in self.stages]
        kept, left_out = [*found.kept], [*found.left_out]
        if perfect and errors:
            kept.append(Item("receivers", f"{' and '.join(errors)}: put into the perfect blocks as they pass"))
            if known := [public_name(type(term)) for term in scene.instrument.terms]:
                kept.append(Item("model", f"{' and '.join(known)}: in it too, not an error of the receivers"))
            left_out = [item for item in left_out if item.name not in ("GainTerm", "FeedTerm")]
        if self.running:
            kept.append(Item("stages", ", ".join(self.running) + (", in this order" if len(self.running) > 1 else "")))
        if not self.modelled:
            left_out = [Item("prediction", "visibilities are there, and no stage compares them with a sky")]
        if absent:
            left_out.append(Item("other stages", f"not in the scene: {', '.join(absent)}"))
        return found.changed(kept=tuple(kept), left_out=tuple(left_out))

    def _say_unused(self) -> None:
        """Name tables and keys that nothing will take."""
        alone = self.alone
        if alone is not None:
            taken = (alone, *(self.stages[alone].alone or ()))
            given = [f"[{table}]" for table in self.tables if table not in taken]
            kind = self.tables[alone].get("kind", alone)
            unused("scene", given, f"a laboratory, [{alone}] kind = '{kind}', makes its own figures")


def _stand_in(observation: Observation) -> Sky:
    """A point of 1 Jy for a plan to be made, where no sky is given and nothing is predicted."""
    from astropy import units as u
    from astropy.coordinates import SkyCoord

    centre = observation.phase_centre
    return PointSky.at(SkyCoord(centre.ra_rad * u.rad, centre.dec_rad * u.rad), [1.0])


def _terms(tables: Any, seed: int) -> tuple[JonesTerm, ...]:
    """The Jones terms of [instrument.terms.LABEL], in the order of the file; one that draws has a seed of its own."""
    if not isinstance(tables, dict) or not all(isinstance(table, dict) for table in tables.values()):
        raise InputError("[instrument] 'terms' must be tables, [instrument.terms.LABEL] with a 'kind'")
    found = []
    for label, settings in tables.items():
        with _in_table(f"instrument.terms.{label}"):
            if KIND not in settings:
                raise InputError(f"needs 'kind': one of {', '.join(available('terms'))}")
            cls = class_of(settings, JonesTerm)
            # of its label: a term more or less in the file changes none of the others
            own = (SEED_STEP * seed << 32) + zlib.crc32(label.encode())
            drawn = {"seed": own} if "seed" in cls.model_fields else {}
            found.append(cls(**{**drawn, **{k: v for k, v in settings.items() if k != KIND}}))
    return tuple(found)


def top_level() -> list[str]:
    """Names of the tables that stages take, in the order of a run."""
    return [name for name in names("stages") if "." not in name]


def _stage(name: str, settings: dict[str, Any], beside: Beside) -> Stage:
    """The stage of a table: "TABLE.KIND" where there is one, else "TABLE", which may take its kind."""
    kind, known = settings.get("kind"), names("stages")
    with _in_table(name):
        if f"{name}.{kind}" in known:
            name, settings = f"{name}.{kind}", {key: value for key, value in settings.items() if key != "kind"}
        cls: type[Stage] = plugin_class("stages", name, needed=True)
        return cls.from_table(settings, beside)


class _in_table:
    """Says in an error of which table of the scene file it is."""

    def __init__(self, table: str) -> None:
        self.table = table

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if isinstance(error, InputError) and not str(error).startswith("["):
            raise type(error)(f"[{self.table}] {error}") from None


def parse(tables: dict[str, Any]) -> SceneFile:
    """Tables as a checked `SceneFile`; raises `InputError` naming the key, the value and the nearest right one."""
    own = {name for name in SceneFile.model_fields if name != "tables"}
    known = top_level()
    for name, value in tables.items():
        if name not in own and name not in known:
            raise InputError(f"a scene has no '{name}': {did_you_mean(name, [*own, *known])}")
        if (name in known or name in ("instrument", "observation", "sky")) and not isinstance(value, dict):
            raise InputError(f"'{name}' must be a table, [{name}]")
    for name in ("instrument", *(() if "data" in tables else ("observation", "sky"))):
        if name not in tables:
            raise InputError(f"a scene needs a table [{name}]")
    return SceneFile(
        **{name: value for name, value in tables.items() if name in own},
        tables={name: value for name, value in tables.items() if name in known},
    )


def _texts(value: Any) -> Iterator[str]:
    """Every text in tables and lists, but keys."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for each in value.values():
            yield from _texts(each)
    elif isinstance(value, list | tuple):
        for each in value:
            yield from _texts(each)


def _is_there(text: str) -> bool:
    try:
        return Path(text).expanduser().exists()
    except (OSError, ValueError, RuntimeError):  # no name of a file
        return False
