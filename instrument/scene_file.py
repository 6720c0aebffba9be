"""Scene files: TOML tables, one per stage, read and checked before anything runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any, Literal, Protocol, Self

import numpy as np
from pydantic import Field, model_validator

from instrument.analyze.laboratory import IncompleteModel
from instrument.analyze.many_directions import ManyDirections
from instrument.analyze.photometry import ForcedPhotometry
from instrument.calibrate.directional import DirectionalCal
from instrument.calibrate.selfcal import SelfCal
from instrument.component import Component
from instrument.cube_analysis import CubeAnalysis
from instrument.errors import InputError, did_you_mean, unused
from instrument.image.dirty import Imager
from instrument.jones.feed import FeedTerm
from instrument.jones.gain import GainTerm
from instrument.memory import afford
from instrument.model import Instrument
from instrument.numbers import Count, Seed, Tolerance, UvRange, Whole, brief
from instrument.observe.observation import Observation
from instrument.plan import Item, Plan
from instrument.registry import available, load
from instrument.scene import Scene
from instrument.sky.base import Sky
from instrument.units import Float, Hertz, HertzArray, Instant, Jansky, PositiveHertz, Seconds, SkyDirection

CALIBRATIONS = ("selfcal", "incomplete-model", "many-directions")
STAGES = ("noise", "calibrate", "correct", "image", "analyze")
SEED_STEP = 1000  # seeds of the stages of a scene are derived from its one seed


class Laboratory(Protocol):
    """What runs a plan by itself; its result has `table()`, `lines()` and `write(folder)`."""

    def run(self, plan: Plan, progress: Callable[[float], None] | None = None) -> Any:
        """The result."""


MOST_CHANNELS = 1_000_000


class Frequency(Component):
    """Channels: `centre` of the band, `width` of one channel (also their spacing), how many."""

    centre: PositiveHertz
    width: PositiveHertz
    channels: Annotated[int, Whole(at_least=1, at_most=MOST_CHANNELS)] = 1

    def values_hz(self) -> Float:
        """Channel centres, Hz (F,)."""
        return np.asarray(self.centre + self.width * (np.arange(self.channels) - (self.channels - 1) / 2))


class ObservationTable(Component):
    """The table [observation]: an `Observation`, its channels as `frequency` or as a list `frequencies`."""

    phase_centre: SkyDirection
    start: Instant | None = None
    transit: str | None = None
    duration: Seconds
    interval: Seconds
    frequency: Frequency | None = None
    frequencies: HertzArray | None = None
    channel_width: Hertz | None = None

    def observation(self) -> Observation:
        """The observation it describes."""
        from astropy import units as u

        if (self.frequency is None) == (self.frequencies is None):
            raise InputError("[observation] needs 'frequency' or 'frequencies', and not both")
        values = self.frequency.values_hz() if self.frequency else self.frequencies
        width = self.frequency.width if self.frequency else self.channel_width
        return Observation(
            phase_centre=self.phase_centre,
            start=self.start,
            transit=self.transit,
            duration=self.duration * u.s,
            interval=self.interval * u.s,
            frequencies=np.asarray(values) * u.Hz,
            channel_width=None if width is None else width * u.Hz,
        )


class NoiseTable(Component):
    """The table [noise]: thermal noise of stations of one `sefd`."""

    sefd: Annotated[Jansky, Field(gt=0)]


class CorrectTable(Component):
    """The table [correct]: `beam = "centre"` takes the beam towards the phase centre out of the visibilities."""

    beam: Literal["centre"] = "centre"


class AnalyzeTable(Component):
    """The table [analyze]: products, settings of forced photometry, and [analyze.cube]: what is made of the images."""

    products: tuple[Literal["leakage", "spectrum-2d"], ...] = ("leakage",)
    uv_range: UvRange | None = None
    every: Count = 1
    cube: CubeAnalysis | None = None

    def photometry(self) -> ForcedPhotometry:
        """The photometry it asks for."""
        return ForcedPhotometry(uv_range=self.uv_range, every=self.every)


class SceneFile(Component):
    """A scene file: `instrument`, `observation` and `sky`, and the stages that follow; an absent table is left out."""

    name: str
    title: str = ""
    seed: Seed = 0
    tolerance: Tolerance = 0.0
    engine: str | None = None
    instrument: dict[str, Any]
    observation: ObservationTable
    sky: dict[str, Any]
    noise: NoiseTable | None = None
    calibrate: dict[str, Any] | None = None
    correct: CorrectTable | None = None
    image: Imager | None = None
    analyze: AnalyzeTable | None = None

    @model_validator(mode="after")
    def _stages_fit(self) -> Self:
        self.calibrator()  # wrong settings of a stage are refused before anything is planned
        self.laboratory()
        odd = not self.name.isprintable() or self.name != self.name.strip() or len(self.name.encode()) > 200
        if not self.name or odd or any(c in self.name for c in "/\\") or self.name.startswith("."):
            raise InputError(f"name = {brief(self.name)} cannot name a folder")
        if self.analyze and "spectrum-2d" in self.analyze.products and self.image is None:
            raise InputError("[analyze] products = ['spectrum-2d'] needs images: give a table [image]")
        if self.analyze and self.analyze.cube and self.image is None:
            raise InputError("[analyze.cube] needs images: give a table [image]")
        if self.noise is not None and self.observation.frequency is None and self.observation.channel_width is None:
            raise InputError("[noise] needs the width of a channel: give channel_width in [observation]")
        return self

    def telescope(self) -> Instrument:
        """The instrument of the table [instrument]."""
        settings = dict(self.instrument)
        name = settings.pop("telescope", None)
        if name is None:
            raise InputError(f"[instrument] needs 'telescope': one of {', '.join(available('telescopes'))}")
        for step, (key, cls) in enumerate((("gain", GainTerm), ("feed", FeedTerm)), start=1):
            if isinstance(settings.get(key), dict):
                with _in_table(f"instrument.{key}"):
                    settings[key] = cls(**{"seed": SEED_STEP * self.seed + step, **settings[key]})
        with _in_table("instrument"):
            found: Instrument = load("telescopes", name, **settings)
        return found

    def sky_model(self) -> Sky:
        """The sky of the table [sky]."""
        settings = dict(self.sky)
        kind = settings.pop("kind", None)
        if kind is None:
            raise InputError(f"[sky] needs 'kind': one of {', '.join(available('skies'))}")
        with _in_table("sky"):
            found: Sky = load("skies", kind, **settings)
        return found

    def calibrator(self) -> SelfCal | None:
        """The solver of the table [calibrate], where there is one."""
        kind, settings = self._calibration()
        with _in_table("calibrate"):
            return SelfCal(**settings) if kind == "selfcal" else None

    def laboratory(self) -> Laboratory | None:
        """The laboratory of the table [calibrate], where its kind is "incomplete-model" or "many-directions".

        Settings of `DirectionalCal` stand in the table beside those of `ManyDirections`.
        """
        kind, settings = self._calibration()
        if kind not in ("incomplete-model", "many-directions"):
            return None
        noise = {} if self.noise is None else {"sefd": f"{self.noise.sefd!r} Jy"}
        common = {"seed": SEED_STEP * self.seed + 3, **noise}
        with _in_table("calibrate"):
            if kind == "incomplete-model":
                return IncompleteModel(**{"image": self.image, **common, **settings})
            solver = {key: settings.pop(key) for key in DirectionalCal.model_fields if key in settings}
            if solver:
                settings["calibrator"] = DirectionalCal(**solver)
            return ManyDirections(**{**common, **settings})

    def _calibration(self) -> tuple[str | None, dict[str, Any]]:
        """Kind and settings of the table [calibrate]."""
        if self.calibrate is None:
            return None, {}
        settings = dict(self.calibrate)
        kind = settings.pop("kind", None)
        if kind not in CALIBRATIONS:
            raise InputError(f"[calibrate] kind = {kind!r}: {did_you_mean(str(kind), CALIBRATIONS)}")
        return kind, settings

    def scene(self) -> Scene:
        """The scene: instrument, sky and observation."""
        with _in_table("observation"):
            observation = self.observation.observation()
        return Scene(name=self.name, instrument=self.telescope(), sky=self.sky_model(), observation=observation)

    def products_uv_range(self) -> tuple[float, float] | None:
        """The uv range, in wavelengths, that holds all the products asked for; `None` when one needs all baselines."""
        if self.calibrate is not None:
            return None  # a solve takes what there is
        ranges = [self.image.uv_range] if self.image else []
        leakage = self.analyze is not None and "leakage" in self.analyze.products
        ranges += [self.analyze.uv_range] if self.analyze and leakage else []
        given = [r for r in ranges if r is not None]
        if not given or len(given) < len(ranges):
            return None
        return min(r[0] for r in given), max(r[1] for r in given)

    def plan(self, scene: Scene, memory: Any = None, workers: int | None = None) -> Plan:
        """The plan of its scene: baselines that no product needs and stages that are absent are left out.

        What a table asks for and no stage takes is named in a warning.
        """
        for table, names, why in self._not_used(scene):
            unused(table, names, why)
        if self.image is not None:
            channels, pixels = scene.observation.freq_hz.size, self.image.pixels
            what = f"image.pixels = {pixels}: images of {channels} channels"
            # 5 planes of sums, 4 of the cube, and 3 of one that is being gridded or transformed
            afford(8.0 * 12 * channels * pixels**2, what, "lower image.pixels, or the number of channels")
        found = scene.plan(
            tolerance=self.tolerance,
            engine=self.engine,
            memory=memory,
            workers=workers,
            uv_range=self.products_uv_range(),
        )
        absent = [stage for stage in STAGES if getattr(self, stage) is None]
        items = (Item(", ".join(absent), "absent from the scene"),) if absent else ()
        return replace(found, left_out=found.left_out + items)

    def _not_used(self, scene: Scene) -> list[tuple[str, list[str], str]]:
        """Tables and keys that nothing will take: where, which, and why."""
        kind, _ = self._calibration()
        found: list[tuple[str, list[str], str]] = []
        if kind in ("incomplete-model", "many-directions"):
            tables = ["correct", "analyze", *(["image"] if kind == "many-directions" else [])]
            given = [f"[{table}]" for table in tables if getattr(self, table) is not None]
            found.append(("scene", given, f"a laboratory, [calibrate] kind = '{kind}', makes its own figures"))
        elif self.correct is not None and not scene.instrument.chain().beams().parts:
            found.append(("scene", ["[correct]"], "the instrument has no beam to take out"))
        if self.analyze is not None and "leakage" not in self.analyze.products:
            given = [key for key in ("uv_range", "every") if key in self.analyze.model_fields_set]
            found.append(("[analyze]", given, "they are of the product 'leakage'"))
        if self.image is not None and self.image.weighting != "briggs" and "robust" in self.image.model_fields_set:
            found.append(
                ("[image]", ["robust"], f"it is of weighting = 'briggs', and this is '{self.image.weighting}'")
            )
        if self.observation.frequency is not None and self.observation.channel_width is not None:
            found.append(("[observation]", ["channel_width"], "'frequency' has its width"))
        return found


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
    for name in ("instrument", "observation", "sky"):
        if name in tables and not isinstance(tables[name], dict):
            raise InputError(f"'{name}' must be a table, [{name}]")
    return SceneFile(**tables)
