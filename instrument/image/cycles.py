"""Cycles: the major cycles of a CLEAN, what is hunted in which Stokes parameters and channels, and how each ended."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from instrument.errors import warn
from instrument.image.base import Imaged
from instrument.image.clean_settings import Cleaning
from instrument.image.cube import StokesCube, listing
from instrument.image.dirty import Images
from instrument.image.forward import Alike, Degridded, Forward, Less, Operated
from instrument.image.minor import Folding, Lobes, Search, minor_cycle, restored, sigma_of, spectral_fit
from instrument.image.response import Response
from instrument.predict.operator import ImageOperator
from instrument.units import Bool, Float, Int
from instrument.visibilities import Visibilities, VisibilitySet
from instrument.visibility_sets import as_set

PEAKS = {"each": ((0,), (1, 2), (3,)), "joint": ((0, 1, 2, 3),), "I": ((0, 1, 2, 3),)}
ROUNDING = 1e-13  # of the first peak, below which nothing is looked for
RISEN = 1.5  # of its lowest: a peak after a major cycle that tells a divergence


@dataclass
class Hunt:
    """Components of some Stokes parameters (K,) in some channels (F,), and how that ended.

    `allowed` (N, N) is where they may be at all; with a mask that grows, that of `search` is a part of it.
    """

    stokes: Int
    channels: Int
    lobes: Lobes
    search: Search
    allowed: Bool
    done: int = 0
    ended: str = ""
    peak: float = np.inf
    noise: float = 0.0
    first: float = 0.0
    lowest: float = np.inf
    best: Float | None = None
    cycles: int = 0

    def of(self, planes: Float) -> Float:
        """Its images (K, F, N, N) of all (F, 4, N, N), a copy."""
        return np.ascontiguousarray(np.moveaxis(planes[np.ix_(self.channels, self.stokes)], 0, 1))

    def put(self, planes: Float, mine: Float) -> None:
        """Put its images where they are among all."""
        planes[np.ix_(self.channels, self.stokes)] = np.moveaxis(mine, 1, 0)

    def look(self, residual: Float, imager: Cleaning) -> float:
        """The level at which it ends, after a look at the residual; says whether it has."""
        mine = self.of(residual)
        self.noise = sigma_of(mine, self.search.share, self.allowed)
        if imager.auto_mask is not None:
            high = replace(self.search, mask=self.allowed).height(mine) > imager.auto_mask * self.noise
            self.search = replace(self.search, mask=self.search.mask | high if self.first else high)
        self.peak = float(self.search.height(mine).max())
        self.first = self.first or self.peak
        stop = max(imager.threshold, imager.sigma * self.noise)
        if self.peak <= ROUNDING * self.first:
            self.ended = "rounding"
        if self.peak <= stop or self.peak == 0:
            self.ended = "threshold" if stop == imager.threshold else "noise"
            if not self.search.negative and self.peak == 0:
                self.ended = "nothing above 0"
        elif self.done >= imager.iterations:
            self.ended = "iterations"
        return stop

    def said(self, freq_hz: Float) -> dict[str, Any]:
        """What is recorded of it."""
        mhz = [round(float(f) / 1e6, 6) for f in freq_hz[self.channels]]
        return {
            "stokes": "".join("IQUV"[k] for k in self.stokes),
            "mhz": mhz[0] if len(mhz) == 1 else [mhz[0], mhz[-1]],
            "ended": self.ended,
            "components": self.done,
            "major_cycles": self.cycles,
            "peak_jy": self.peak,
            "noise_jy": self.noise,
            "mask": float(self.search.mask.mean()),
        }


@dataclass
class Cycles:
    """One CLEAN of one set of visibilities."""

    imager: Cleaning
    visibilities: VisibilitySet | Iterable[Visibilities]
    operator: ImageOperator | None
    density: Any = field(default=None, init=False)

    def run(self) -> Imaged:
        """Restored images, the model and the residual."""
        imager = self.imager
        given = Alike.of(as_set(self.visibilities, twice="cycles of CLEAN"))
        self.density = imager.dirty.density(given)
        first, weights = self._dirty(given, lobes=True)
        there = weights > 0
        residual = np.nan_to_num(first.data, copy=True)
        model = np.zeros_like(residual)
        response = Response.of(self.operator, first.grid, len(model))
        forward: Forward = Degridded(first.grid, imager.accuracy, imager.uv_range)
        if self.operator is not None:
            self.operator.demand(first.grid, imager.uv_range)
            forward = Operated(self.operator.within(imager.uv_range))
        hunts = self._hunts(first, weights, response)
        for _ in range(imager.cycles):
            if not self._minor(hunts, residual, model, response):
                break
            residual = self._left(given, forward, model, first.freq_hz)
            self._judge(hunts, residual, model)
        else:
            for hunt in hunts:
                hunt.look(residual, imager)
                hunt.ended = hunt.ended or "cycles"
        if any(hunt.ended in ("diverging", "accuracy") for hunt in hunts):
            residual = self._left(given, forward, model, first.freq_hz)
        self._say(hunts, first)
        return self._finished(first, there, residual, model, response, hunts)

    def _dirty(self, given: VisibilitySet, lobes: bool) -> tuple[StokesCube, Float]:
        """Dirty images, and the weights of I, Q, U, V in them (F, 4)."""
        sums = Images(self.imager.dirty, self.density, lobes)
        for block in given.blocks():
            sums.add(block)
        return sums.finish(), sums.weights

    def _left(self, given: VisibilitySet, forward: Forward, model: Float, freq_hz: Float) -> Float:
        """Dirty images of the visibilities less those of a model (F, 4, N, N), 0 where there is no data."""
        if not model.any():
            return np.nan_to_num(self._dirty(given, lobes=False)[0].data, copy=False)
        return np.nan_to_num(self._dirty(Less(given, forward, model, freq_hz), lobes=False)[0].data, copy=False)

    def _hunts(self, first: StokesCube, weights: Float, response: Response) -> list[Hunt]:
        """What is hunted: each group of Stokes parameters in each channel with a beam, or in all of them together."""
        imager, psf = self.imager, first.psf
        assert psf is not None and psf.data is not None
        usable = np.isfinite(psf.major_rad) & (psf.major_rad > 0)
        sets = [np.flatnonzero(usable)] if imager.terms is not None else [np.array([f]) for f in np.flatnonzero(usable)]
        found = []
        for channels in sets:
            if not len(channels):
                continue
            lobes = Lobes(psf.data[channels], self._scales(float(np.median(psf.major_rad[channels]))))
            mask: Bool = np.asarray(response.usable[channels].all(axis=0))
            if imager.mask is not None:
                mask = mask & imager.mask
            for group in PEAKS[imager.peaks]:
                stokes = np.array([k for k in group if weights[channels, k].any()])
                if not len(stokes):
                    continue
                share = weights[np.ix_(channels, stokes)].T
                fit = np.stack([spectral_fit(first.freq_hz[channels], w, imager.terms) for w in share])
                share = share / share.sum(axis=1, keepdims=True)
                if imager.peaks == "I":
                    share = share * (stokes == 0)[:, None]
                negative = imager.negative or group != (0,)
                found.append(Hunt(stokes, channels, lobes, Search(share, fit, imager.gain, mask, negative), mask))
        return found

    def _scales(self, beam_rad: float) -> tuple[float, ...]:
        """Sizes of scales in pixels."""
        imager = self.imager
        if imager.algorithm == "hogbom":
            return (0.0,)
        if imager.scales:
            return tuple(s / imager.pixel for s in imager.scales)
        beam, out = 2 * beam_rad / imager.pixel, [0.0]
        while beam <= imager.pixels / 4:
            out.append(beam)
            beam *= 2
        return tuple(out)

    def _minor(self, hunts: list[Hunt], residual: Float, model: Float, response: Response) -> bool:
        """One minor cycle of each hunt that goes on, added to the model; whether anything was found."""
        found = False
        for hunt in hunts:
            if hunt.ended:
                continue
            stop = hunt.look(residual, self.imager)
            if hunt.ended:
                continue
            if hunt.best is None:
                hunt.lowest, hunt.best = hunt.peak, hunt.of(model)
            floor = max(stop, (1 - self.imager.major_gain) * hunt.peak)
            part, count = self._taken(hunt, hunt.of(residual), floor)
            hunt.done, hunt.cycles = hunt.done + count, hunt.cycles + 1
            if count == 0:
                hunt.ended = "nothing found"
                continue
            found = True
            new = np.zeros((len(hunt.channels), 4, *part.shape[2:]))
            new[:, hunt.stokes] = np.moveaxis(part, 1, 0)
            model[hunt.channels] += response.undone(new, hunt.channels)
        return found

    def _taken(self, hunt: Hunt, residual: Float, floor: float) -> tuple[Float, int]:
        """The model of one minor cycle (K, F, N, N), and how many components it has."""
        most = self.imager.iterations - hunt.done
        if self.imager.backend == "radler":
            from instrument.image.radler import radler_cycle

            return radler_cycle(residual, hunt.lobes, hunt.search, floor, most, self.imager.pixel)
        part, count, _ = minor_cycle(residual, hunt.lobes, hunt.search, floor, most)
        return part, count

    def _judge(self, hunts: list[Hunt], residual: Float, model: Float) -> None:
        """Remember the best model of each hunt, and go back to it where the residual rises."""
        for hunt in hunts:
            if hunt.ended or hunt.best is None:
                continue
            peak = float(hunt.search.height(hunt.of(residual)).max())
            if not peak <= RISEN * hunt.lowest:
                # below what the gridder was asked for nothing converges, and nothing is wrong
                hunt.ended = "accuracy" if peak <= self.imager.accuracy * hunt.first else "diverging"
                hunt.put(model, hunt.best)
            elif peak < hunt.lowest:
                hunt.lowest, hunt.best = peak, hunt.of(model)

    def _say(self, hunts: list[Hunt], first: StokesCube) -> None:
        """Warn of what diverged, and of channels that could not be cleaned."""
        wrong = []
        for hunt in hunts:
            if hunt.ended == "diverging":
                wrong.append(f"{'IQUV'[hunt.stokes[0]]} at {first.freq_hz[hunt.channels[0]] / 1e6:.6g} MHz")
        if wrong:
            warn(f"CLEAN diverges in {', '.join(wrong[:4])}: its best cycle is kept; lower gain, or mask bright edges")
        assert first.psf is not None
        lost = ~np.isfinite(first.psf.major_rad) & np.isfinite(first.data).any(axis=(1, 2, 3))
        if lost.any():
            warn(f"{listing(lost)}: no beam fits the PSF, so nothing is cleaned there: the images are dirty ones")

    def _finished(
        self, first: StokesCube, there: Bool, residual: Float, model: Float, response: Response, hunts: list[Hunt]
    ) -> Imaged:
        """The cubes, NaN where a channel or Stokes parameter has no weight."""
        from astropy import units as u

        psf = first.psf
        assert psf is not None
        residual = response.undone(residual, np.arange(len(residual)))
        cube, folding = residual.copy(), Folding((residual.shape[2], residual.shape[3]))
        for f, lobe in enumerate(zip(psf.major_rad, psf.minor_rad, psf.angle_rad, strict=True)):
            if np.isfinite(lobe).all():
                cube[f] += restored(model[f], lobe, first.pixel_rad, folding)
        none = ~there[:, :, None, None] | ~response.usable[:, None]
        for planes in (cube, residual):
            planes[np.broadcast_to(none, planes.shape)] = np.nan
        points = StokesCube(
            model, first.freq_hz * u.Hz, first.pixel_rad * u.rad, "Jy/pixel", first.centre, constants="data"
        )
        beside = {"model": points, "residual": first.with_data(residual)}
        return Imaged(first.with_data(cube), beside, {"clean": [hunt.said(first.freq_hz) for hunt in hunts]})
