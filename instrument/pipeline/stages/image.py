"""The table [image]: images of what comes by, and their PSF."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from instrument.component import KIND, Component
from instrument.errors import InputError, did_you_mean, unused
from instrument.image.base import AnyImager, ImageSums, Kept
from instrument.image.cube import SolidAngle, StokesCube
from instrument.image.dirty import ALL_HELD, HELD, WAITING, Imager
from instrument.image.pixel_map import PixelMap
from instrument.image.sparse import SAMPLE, regular, share
from instrument.memory import afford
from instrument.numbers import brief
from instrument.observe.directions import LIGHT
from instrument.pipeline.stage import Beside, Draw, Running, Stage, StageResult, StageRun
from instrument.pipeline.work import Items, StageWork
from instrument.plan import Item, count_of
from instrument.predict.operator import ImageOperator
from instrument.registry import load, names
from instrument.report.page import Card, Figures, Section, Table, Text, number
from instrument.scene import Scene
from instrument.units import Float, si_prefix
from instrument.visibilities import Visibilities

# seconds of a visibility on two cores: gridded in one plane; picked out, with its Stokes parameters
GRIDDING, PICKING = 0.45e-6, 0.3e-6
TURNING = 4e-7  # seconds of a pixel for each call of the gridder: its transforms
KEEPING = 2e-6  # seconds of a visibility that is kept in a file, read and imaged
GRIDDED = 250.0  # bytes of a visibility while it is gridded


class Image(Stage):
    """Images by an `imager`, whose settings are those of the table."""

    after: ClassVar[tuple[str, ...]] = ("data", "noise", "calibrate", "correct")
    settings_of: ClassVar[tuple[type[Component], ...]] = (Imager,)
    imager: AnyImager

    @classmethod
    def from_table(cls, settings: Mapping[str, Any], beside: Beside) -> Self:
        """The stage; `kind` is an imager, "dirty" unless said, the other settings are its own."""
        kind = settings.get(KIND, "dirty")
        if kind not in names("imagers"):
            raise InputError(f"kind = {brief(kind)}: {did_you_mean(str(kind), names('imagers'))}")
        imager = load("imagers", kind, **{k: v for k, v in settings.items() if k != KIND})
        if kind == "clean" and imager.beams and "correct" in beside.tables:
            raise InputError("beams = true takes visibilities as they were: leave the table [correct] out")
        return cls(imager=imager)

    def ranges(self) -> tuple[tuple[float, float] | None, ...]:
        """That of the imager."""
        return (self.imager.uv_range,)

    def check(self, scene: Scene) -> None:
        """Refuse images that do not fit into memory; name a robust that no weighting takes."""
        channels, pixels = scene.observation.freq_hz.size, self.imager.pixels
        what = f"image.pixels = {pixels}: images of {channels} channels"
        # 5 planes of sums, 4 of the cube, and 3 of one that is being gridded or transformed
        afford(8.0 * 12 * channels * pixels**2, what, "lower image.pixels, or the number of channels")
        if isinstance(self.imager, Imager) and self.imager.idle:
            unused("[image]", ["robust"], f"it is of weighting = 'briggs', and this is '{self.imager.weighting}'")
        if "tolerance" in self.imager.model_fields_set and not self.imager.through_beams:
            unused("[image]", ["tolerance"], "it is that of the beams, and beams = true is not given")

    def work(self, run: Running) -> StageWork:
        """That of images of all channels."""
        return imaging(self.imager, run)._replace(figures=1 + min(3, run.plan.problem.shape[1]))

    def items(self, run: Running) -> Items:
        """Baselines outside the uv range of the images, in the share of all."""
        share = inside(self.imager.uv_range, run)
        if share == 1:
            return Items()
        return Items(left_out=(Item("visibilities", f"{1 - share:.0%} outside uv_range: asked for, no error"),))

    def start(self, run: Running) -> StageRun:
        """The stage at work."""
        return _ImageRun(self.imager, self.sums(run))

    def sums(self, run: Running) -> ImageSums:
        """Empty sums of images, with the weights of this run."""
        if self.imager.through_beams:
            problem = run.plan.problem
            return Kept(self.imager.for_sky(problem.sky, problem.at.centre), operator_of(self.imager, run))
        return self.imager.start(run.density(self.imager))


def operator_of(imager: AnyImager, run: Running) -> ImageOperator:
    """The operator through the beams of a run that an imager works with."""
    return run.plan.operator(imager.grid(run.plan.problem.at.centre), imager.operator_tolerance)


def imaging(imager: AnyImager, run: Running, count: int = 1) -> StageWork:
    """What `count` sets of images of the visibilities of a run cost."""
    channels, plane = run.plan.problem.shape[1], 8.0 * imager.pixels**2
    if not isinstance(imager, Imager):  # of which only the size is known
        through, held = 0.0, 0.0
        if imager.through_beams:
            operator = operator_of(imager, run).within(imager.uv_range)
            one = operator.work(channels=slice(0, 1))
            through, held = imager.operator_passes * channels * one.seconds, one.shared_bytes + one.slot_bytes
        return StageWork(
            f"{count_of(count * channels, 'image')} of {imager.pixels} x {imager.pixels} by {type(imager).__name__}, "
            f"from {si_prefix(64 * count * run.visibilities, 'B')} of files",
            seconds=count * (imager.passes * KEEPING * run.visibilities + through),
            block_bytes=3 * 64.0 * float(np.prod(run.block)),
            finish_bytes=count * imager.planes_held * channels * plane + held,
            result_bytes=count * imager.planes_made * channels * plane,
            wrong=imager.error(),
            remedy="lower image.pixels, or the number of channels",
        )
    chosen = run.visibilities * inside(imager.uv_range, run)
    # a density of the uv plane, and a first pass over coordinates for it
    weighed = 0.0 if imager.weighting == "natural" else 1.0
    together = min(HELD, chosen / channels)
    gridded = chosen * share(run.plan.problem, imager)
    sampled = regular(run.plan.problem)
    calls = 5 * max(channels, np.ceil(gridded / HELD))
    seconds = GRIDDING * 5 * gridded + (1 + weighed) * PICKING * run.visibilities + TURNING * calls * imager.pixels**2
    return StageWork(
        f"{count_of(count * channels, 'image')} of {imager.pixels} x {imager.pixels} in I, Q, U, V and the PSF",
        seconds=count * seconds,
        held_bytes=weighed * channels * plane
        + count * (5 * channels * plane + WAITING * min(run.visibilities, HELD * channels, ALL_HELD))
        # a channel may hold samples as large as two and a half of its images
        + sampled * count * SAMPLE * min(chosen, HELD * channels, max(ALL_HELD, channels * imager.pixels**2 / 4)),
        block_bytes=GRIDDED * together + 8 * 4 * plane + 128.0 * float(np.prod(run.block)),
        finish_bytes=GRIDDED * together + 8 * 4 * plane,
        result_bytes=count * 5 * channels * plane,
        wrong=imager.error(),
        remedy="lower image.pixels, or the number of channels",
    )


def inside(uv_range: tuple[float, float] | None, run: Running) -> float:
    """The share of visibilities within a uv range (wavelengths), from 16 integrations of the middle channel."""
    if uv_range is None:
        return 1.0
    problem = run.plan.problem
    times, channels, _ = problem.shape
    at = problem.at.block(slice(None, None, -(-times // 16)), slice(channels // 2, channels // 2 + 1))
    length = np.linalg.norm((at.uvw_m[:, problem.antenna1] - at.uvw_m[:, problem.antenna2])[..., :2], axis=-1)
    length = length * float(at.freq_hz[0]) / LIGHT
    return float(np.mean((length >= uv_range[0]) & (length <= uv_range[1])))


class _ImageRun(StageRun):
    def __init__(self, imager: AnyImager, images: ImageSums) -> None:
        self.imager, self.images = imager, images

    def take(self, block: Visibilities) -> Visibilities:
        """Add a block to the images."""
        self.images.add(block)
        return block

    def finish(self) -> StageResult:
        """The cube."""
        made = self.images.everything()
        return ImageResult(self.imager, made.cube, made.beside, made.record, made.maps)


@dataclass(frozen=True)
class ImageResult(StageResult):
    """Images of a run: a cube with its PSF, cubes and maps beside it by name, and what the imager says of them."""

    imager: AnyImager
    cube: StokesCube
    beside: Mapping[str, StokesCube] = field(default_factory=dict)
    said: Mapping[str, Any] = field(default_factory=dict)
    maps: Mapping[str, PixelMap] = field(default_factory=dict)

    def record(self) -> dict[str, Any]:
        """Unit, PSF and rms of the first channel."""
        psf, error = self.cube.psf, self.imager.error()
        angles: list[SolidAngle] = [] if psf is None else ["fit"] if psf.data is None else ["fit", "sum"]
        widths = () if psf is None else (psf.major_rad, psf.minor_rad)
        return {
            "stage_errors": {"image": f"{error} asked for"} if error else {},
            "image": {
                "unit": self.cube.unit,
                "psf_arcmin": [round(float(np.rad2deg(x[0]) * 60), 3) for x in widths],
                "solid_angle_sr": {of: float(self.cube.solid_angle_sr(of)[0]) for of in angles},
                "rms": {s: float(np.nanstd(self.cube.data[0, k])) for k, s in enumerate("IQUV")},
                **self.said,
            },
        }

    def write(self, folder: Path) -> None:
        """cube.fits, and what is beside it: model.fits, residual.fits, amplification.fits, condition.fits."""
        made: dict[str, StokesCube | PixelMap] = {"cube": self.cube, **self.beside, **self.maps}
        for name, one in made.items():
            one.write(folder / f"{name}.fits")

    def cards(self) -> list[Card]:
        """The PSF."""
        if self.cube.psf is None:
            return []
        major, minor = (number(width) for width in self.record()["image"]["psf_arcmin"])
        cards = [Card("PSF", f"{major}′ × {minor}′", "width at half maximum")]
        shares = [row["polarized"] for rows in self._ended.values() for row in rows if "polarized" in row]
        if np.isfinite(shares).any():
            text = f"{np.nanmax(shares):.1e} of I"
            cards.append(Card("Polarization of the sources", text, "the most of the components of the model"))
        return cards

    @property
    def _ended(self) -> dict[str, list[dict[str, Any]]]:
        """What the imager says of every channel, by what it calls that."""
        told = {name: rows for name, rows in self.said.items() if isinstance(rows, list) and rows}
        return {name: rows for name, rows in told.items() if all(isinstance(row, dict) for row in rows)}

    def tables(self) -> list[Section]:
        """How every channel ended, where the imager says so."""
        return [Section(f"How each channel ended ({name})", [_table_of(rows)]) for name, rows in self._ended.items()]

    def sections(self, draw: Draw) -> list[Section]:
        """Images of the first, middle and last channel, the PSF, and the rms of each Stokes parameter in them."""
        from instrument.report.images import pixel_maps, psf_image, stokes_images

        count = len(self.cube.freq_hz)
        shown = {name: k for k, name in {0: "first", count // 2: "middle", count - 1: "last"}.items()}
        rms = {name: np.array([_rms(self.cube.data[k, s]) for s in range(4)]) for name, k in shown.items()}
        if not any(np.isfinite(values).any() for values in rms.values()):
            return [Section("Images", [Text("The images have no data: every visibility is flagged or left out.")])]
        entries = []
        for name, k in shown.items():
            text = "Images of the four Stokes parameters" + (f", {name} of {count} channels." if count > 1 else ".")
            file = "images" if k == 0 else f"images_{name}"
            entries.append(draw(file, stokes_images(self.cube, k), text, wide=count == 1))
        if self.cube.psf is not None and self.cube.psf.data is not None:
            text = "Point spread function and the Gaussian fitted to its main lobe."
            entries.append(draw("psf", psf_image(self.cube), text))
        if self.maps:
            blank = np.isnan(self.cube.data[count // 2]).any(axis=0).mean()
            parts = [f"{name}, {one.what}" for name, one in self.maps.items()]
            text = f"Maps: {'; '.join(parts)}. {blank:.0%} of the pixels have none."
            entries.append(draw("maps", pixel_maps(self.maps, count // 2), text, wide=True))
        heads = [f"{self.cube.freq_hz[k] / 1e6:.6g} MHz" for k in shown.values()]
        rows = [[stokes, *(float(values[s]) for values in rms.values())] for s, stokes in enumerate("IQUV")]
        text = f"Rms of the images, {self.cube.unit}."
        return [Section("Images", [Figures(entries), Table(["Stokes", *heads], rows, text)])]


def _table_of(rows: list[dict[str, Any]]) -> Table:
    """Rows of names and values, a column for every name that any has."""
    heads = list(dict.fromkeys(name for row in rows for name in row))
    cells = [[_in_words(row.get(name, "")) for name in heads] for row in rows]
    return Table([name.replace("_", " ") for name in heads], cells)


def _in_words(value: Any) -> Any:
    return " to ".join(map(str, value)) if isinstance(value, list) else value


def _rms(plane: Float) -> float:
    good = plane[np.isfinite(plane)]
    return float(np.std(good)) if good.size else float("nan")
