"""SourceFinder: Gaussians fitted in the islands of an image, and their fluxes in all channels and Stokes parameters."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from instrument.analyze.sources.catalogue import SourceCatalogue, catalogue_of
from instrument.analyze.sources.forced import areas, beams_of, forced
from instrument.analyze.sources.gaussians import fit_many, fit_together, gaussian, windows
from instrument.analyze.sources.islands import BEAMS, Islands, clipped, find_islands, noise_map
from instrument.component import Component
from instrument.errors import InputError, warn
from instrument.image.common_beam import ALIKE, beam_ratio
from instrument.image.cube import StokesCube
from instrument.units import Bool, Count, Float, Index, Int, PositiveSeconds

# widths of the beam from a peak up to which it is fitted, and drawn. In noise that has the resolution of the beam
# what lies further off tells less than it spoils: up to 1 width places are 1.2 times as uncertain
FITTED, DRAWN = 0.5, 1.75
NEAR = 0.6  # of the narrow width of the beam, within which two peaks are one
MORE = 0.05  # of the peak of its island: what is left of a fit and may be another source, if above the threshold


class SourceFinder(Component):
    """Finds sources in Stokes I: islands above `island` times the noise with a peak above `threshold` times it.

    The noise is that of medians in boxes of `box` pixels, 40 beams wide unless given. Peaks are fitted with Gaussians,
    those of an island together, in at most `seconds` an island (`table()["fitted"]` says where that was too short). A
    source is a point of the size of the beam unless its fitted area is larger by `extended` times its error.
    """

    threshold: Annotated[float, Field(gt=0)] = 5.0
    island: Annotated[float, Field(gt=0)] = 3.0
    box: Count | None = None
    extended: Annotated[float, Field(gt=0)] = 3.0
    seconds: PositiveSeconds = 10.0

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.island > self.threshold:
            raise InputError(f"island = {self.island} is above threshold = {self.threshold}: it must not be")
        return self

    def find(self, cube: StokesCube, channel: Index | None = None) -> SourceCatalogue:
        """Sources of a channel, or of the mean of all, weighted with 1 / rms²; fluxes in each channel (F, S, 4).

        Needs a cube in Jy/beam with a centre and beams that are alike (`cube.at_common_beam()` makes them so).
        """
        if cube.unit != "Jy/beam" or cube.psf is None or cube.centre is None:
            raise InputError("sources are found in a cube in Jy/beam with a centre and a PSF: StokesCube(..., psf=...)")
        some = cube if channel is None else cube.channels([channel])
        found = _Found(self, *_mean(some))
        found.fit()
        flux, error = forced(some, found.p, found.wide, found.label, found.islands.labels, found.half)
        if len(some.data) == 1:
            flux[0, :, 0] = found.p[:, 0] * areas(found.p, found.beam)
        # of noise that changes over the image
        middle = float(np.median(found.rms)) if len(found.p) else 1.0
        error = error * (found.rms_at / (middle if middle > 0 else 1.0))[:, None]
        return catalogue_of(found.p, found.wide, found.fitted, found.label, found.rms_at, some, flux, error)


def _mean(cube: StokesCube) -> tuple[Float, Float]:
    """The image in which is looked (Ny, Nx), and its beam as the three numbers of a Gaussian."""
    psf = cube.psf
    assert psf is not None
    there = np.array([np.isfinite(plane[0]).any() for plane in cube.data])
    there &= np.isfinite(psf.major_rad) & (psf.major_rad > 0)
    if not there.any():
        raise InputError("no channel of this cube has data and a beam: nothing can be found in it")
    if beam_ratio(psf) > ALIKE:
        raise InputError(
            f"the beams of the channels differ by a factor of {beam_ratio(psf):.3g}: give channel=, or a cube of one "
            "beam, cube.at_common_beam()"
        )
    rms = np.array([clipped(cube.data[f, 0])[1] for f in np.flatnonzero(there)])
    weight = np.where(rms > 0, 1 / np.where(rms > 0, rms, 1.0) ** 2, 0.0)
    weight = weight / weight.sum() if weight.any() else np.full(len(rms), 1 / len(rms))
    image = np.einsum("f,fyx->yx", weight, np.asarray(cube.data[there, 0], float))
    return image, beams_of(cube)[int(np.flatnonzero(there)[len(rms) // 2])]


@dataclass
class _Found:
    """Sources in the making: parameters of Gaussians (n, 6), and what is known of each."""

    finder: SourceFinder
    image: Float
    beam: Float
    p: Float = field(default_factory=lambda: np.zeros((0, 6)))
    wide: Bool = field(default_factory=lambda: np.zeros(0, bool))
    fitted: Bool = field(default_factory=lambda: np.zeros(0, bool))
    label: Int = field(default_factory=lambda: np.zeros(0, int))

    def __post_init__(self) -> None:
        axes = np.linalg.eigvalsh(np.array([[self.beam[0], self.beam[1]], [self.beam[1], self.beam[2]]]))
        self.narrow, self.width = np.sqrt(8 * np.log(2) / axes[::-1])
        level, self.rms = noise_map(self.image, self.finder.box or int(BEAMS * self.width))
        self.data = self.image - level
        self.islands: Islands = find_islands(
            self.data / np.where(self.rms > 0, self.rms, np.inf),
            self.finder.island,
            self.finder.threshold,
            NEAR * self.narrow,
        )
        self.half = max(2, int(np.ceil(FITTED * self.width)))

    @property
    def rms_at(self) -> Float:
        """Noise where the sources are (n,)."""
        y, x = (
            np.clip(np.rint(self.p[:, k]).astype(int), 0, n - 1)
            for k, n in ((1, self.rms.shape[0]), (2, self.rms.shape[1]))
        )
        return np.asarray(self.rms[y, x])

    def fit(self) -> None:
        """Fit all sources: alone, with what the others leave, and those of an island together."""
        peaks = self.islands.peaks
        self.label = self.islands.label
        self.p = np.column_stack(
            [self.data[peaks[:, 0], peaks[:, 1]], peaks, np.broadcast_to(self.beam, (len(peaks), 3))]
        )
        self.fitted, self.wide = np.ones(len(peaks), bool), np.zeros(len(peaks), bool)
        self._fit_all()
        if len(more := self._left_over()):
            labels = self.islands.labels[more[:, 0], more[:, 1]]
            rest = (self.data - self.drawn())[more[:, 0], more[:, 1]]
            self.p = np.concatenate([self.p, np.column_stack([rest, more, np.broadcast_to(self.beam, (len(more), 3))])])
            self.label = np.concatenate([self.label, labels])
            self.fitted, self.wide = (
                np.concatenate([a, np.full(len(more), v)]) for a, v in ((self.fitted, True), (self.wide, False))
            )
            self._fit_all()
        if not self.fitted.all():
            late = int((~self.fitted).sum())
            warn(f"{late} of {len(self.p)} sources were not fitted within {self.finder.seconds:g} s an island")

    def _fit_all(self) -> None:
        count = np.bincount(self.label, minlength=int(self.islands.labels.max()) + 1)
        alone = np.flatnonzero((count[self.label] == 1) & ~self._large()[self.label])
        others = np.setdiff1d(np.arange(len(self.p)), alone)
        self._singles(alone)
        rest = self.data - self.drawn()
        for label in np.unique(self.label[others]):
            self._island(int(label), np.flatnonzero(self.label == label), rest)
        if len(self.p) > 1:
            self._singles(alone)

    @cached_property
    def boxes(self) -> list[tuple[slice, slice]]:
        """Rows and columns of each island; the first is that of label 1."""
        from scipy.ndimage import find_objects

        return list(find_objects(self.islands.labels))

    def _large(self) -> Bool:
        """Which islands, by label, are larger than a point of 1000 times the noise would make them."""
        sizes = [0, *(max(y.stop - y.start, x.stop - x.start) for y, x in self.boxes)]
        return np.array(sizes) > 3 * self.width

    def _singles(self, which: Int) -> None:
        """Fit sources that are alone on their islands, without what all others leave at them."""
        if not len(which):
            return
        rest = self.data - self.drawn()
        p, window = self.p[which], self._window(which, self.half)
        y, x, inside = window
        values = np.where(inside, rest[y, x], 0.0) + gaussian(p, y.astype(float), x.astype(float))
        use = inside & np.isfinite(values)
        values = np.where(use, values, 0.0)
        point = p.copy()
        point[:, 3:] = self.beam
        point, good = fit_many(point, values, y.astype(float), x.astype(float), use, 3)
        shaped, formed = fit_many(point, values, y.astype(float), x.astype(float), use, 6)
        wide = formed & self._wider(shaped, which)
        self.p[which] = np.where(wide[:, None], shaped, point)
        self.wide[which], self.fitted[which] = wide, good | wide

    def _island(self, label: int, which: Int, rest: Float) -> None:
        """Fit all sources of an island together, in its pixels and a margin; `rest` (Ny, Nx) is without any source."""
        rows, columns = self._around(label, which)
        own = gaussian(
            self.p[which], *(np.broadcast_to(a.astype(float), (len(which), len(rows))) for a in (rows, columns))
        )
        values = rest[rows, columns] + own.sum(axis=0)
        use = np.isfinite(values)
        y, x, values = rows[use].astype(float), columns[use].astype(float), values[use]
        start = self.p[which].copy()
        start[:, 3:] = self.beam
        point, sound = fit_together(start, values, y, x, 3, self.finder.seconds)
        shaped, formed = point, False
        if sound and len(values) > 8 * len(which):
            shaped, formed = fit_together(point, values, y, x, 6, self.finder.seconds)
        wide = formed & self._wider(shaped, which) & (shaped[:, 0] > 0)
        if wide.any() and not wide.all():  # the others are points: once more, with the shapes of these
            point[wide] = shaped[wide]
            point, _ = fit_together(point, values, y, x, 3, self.finder.seconds)
        self.p[which] = np.where(wide[:, None] & wide.all(), shaped, point)
        self.wide[which], self.fitted[which] = wide, sound

    def _around(self, label: int, which: Int) -> tuple[Int, Int]:
        """Rows and columns of an island, and of the windows of its sources."""
        y, x, inside = self._window(which, self.half)
        box = self.boxes[label - 1]
        own = np.argwhere(self.islands.labels[box] == label) + np.array([box[0].start, box[1].start])
        rows, columns = np.unique(np.concatenate([own, np.stack([y[inside], x[inside]], axis=1)]), axis=0).T
        return rows, columns

    def _wider(self, shaped: Float, which: Int) -> Bool:
        """Which fits are of sources larger than the beam: the area against its error, sqrt 2 over signal to noise."""
        rms = self.rms_at[which]
        with np.errstate(divide="ignore", invalid="ignore"):
            area = np.sqrt(
                (self.beam[0] * self.beam[2] - self.beam[1] ** 2) / (shaped[:, 3] * shaped[:, 5] - shaped[:, 4] ** 2)
            )
            return np.asarray(area - 1 > self.finder.extended * np.sqrt(2) * rms / np.abs(shaped[:, 0]))

    def _window(self, which: Int, half: int) -> tuple[Int, Int, Bool]:
        """Rows, columns (n, m) of windows about sources, those outside moved into the image, and which are inside."""
        y, x = windows(np.rint(self.p[which, 1:3]).astype(int), half)
        inside = (y >= 0) & (y < self.image.shape[0]) & (x >= 0) & (x < self.image.shape[1])
        return np.clip(y, 0, self.image.shape[0] - 1), np.clip(x, 0, self.image.shape[1] - 1), inside

    def drawn(self) -> Float:
        """All sources as an image (Ny, Nx)."""
        out = np.zeros(self.image.shape)
        extent = np.sqrt(8 * np.log(2) / np.maximum(np.minimum(self.p[:, 3], self.p[:, 5]), 1e-12))
        largest = max(float(extent.max(initial=0.0)), 2 * self.width)
        for low, high in ((0.0, 1.2 * self.width), (1.2 * self.width, 2 * self.width), (2 * self.width, largest)):
            which = np.flatnonzero((extent > low) & (extent <= high))
            if not len(which):
                continue
            half = int(np.ceil(min(DRAWN * high, max(out.shape))))
            for some in np.array_split(which, max(1, len(which) * (2 * half + 1) ** 2 // 4_000_000)):
                y, x, inside = self._window(some, half)
                values = gaussian(self.p[some], y.astype(float), x.astype(float))
                np.add.at(out, (y[inside], x[inside]), values[inside])
        return out

    def _left_over(self) -> Int:
        """Peaks (n, 2) in islands, above the threshold and 5 % of the island's, that are left when sources are gone."""
        if not len(self.p):
            return np.zeros((0, 2), int)
        rest, labels = self.data - self.drawn(), self.islands.labels
        tops, inside = np.zeros(labels.max() + 1), np.nonzero(labels)
        np.maximum.at(tops, labels[inside], self.data[inside])
        height = np.zeros(rest.shape)
        height[inside] = np.where(rest[inside] > MORE * tops[labels[inside]], rest[inside] / self.rms[inside], 0.0)
        return find_islands(height, self.finder.threshold, self.finder.threshold, self.narrow).peaks
