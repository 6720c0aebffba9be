"""StokesMaps: what of a cube a remover is given, finite and without what cannot be used; and the way back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from instrument.checked import checked
from instrument.errors import InputError, warn
from instrument.foreground.noise import noise_power
from instrument.image.cube import StokesCube
from instrument.image.psf import Psf
from instrument.numbers import squarable
from instrument.shown import short_repr
from instrument.units import Bool, Float, Int

Plane = Literal["I", "Q", "U", "V"]


@checked
@dataclass(frozen=True, eq=False)
class StokesMaps:
    """Maps (C, Ny, Nx) of the planes that a remover asks for: finite, every channel of `plane` varies, holes are 0.

    `plane` is the one to be split, Stokes `stokes`; `maps["Q"]` another of those in the `planes` of the remover.
    `freq_hz` (C,), the pixel in rad, the unit, and the PSF of these channels where the cube has one.
    """

    __repr__ = short_repr
    stokes: Plane
    planes: Mapping[Plane, Any]
    freq_hz: Float
    pixel_rad: float
    unit: str
    psf: Psf | None = None

    @property
    def plane(self) -> Any:
        """The maps to be split (C, Ny, Nx)."""
        return self.planes[self.stokes]

    def __getitem__(self, stokes: Plane) -> Any:
        if stokes not in self.planes:
            raise InputError(f"Stokes {stokes} was not asked for: name it in the `planes` of the remover")
        return self.planes[stokes]

    def __len__(self) -> int:
        return len(self.freq_hz)

    def noise(self, stokes: Plane | None = None) -> Float:
        """Rms of the noise of each channel (C,), from delays beyond 0.3 /Mpc; raises `InputError` without such.

        Good to 15 % but for the outermost five channels, which these delays hardly reach, and those beside a step.
        """
        maps = self[stokes or self.stokes]
        power, shape = noise_power(maps, self.freq_hz)
        twice = np.full(power.shape[1], 2.0)  # the half plane stands for the whole
        twice[0] = 1.0
        if maps.shape[2] % 2 == 0:
            twice[-1] = 1.0
        seen = float(maps.any(axis=0).mean())
        rms = np.sqrt(shape * (power @ twice).sum() / (maps[0].size ** 2 * seen))
        order = np.argsort(self.freq_hz, kind="stable")
        near = np.pad(rms[order], 2, mode="edge")
        around = np.median(np.lib.stride_tricks.sliding_window_view(near, 5), axis=1)
        out = np.empty_like(rms)
        out[order] = np.maximum(rms[order], around / 2)  # by the edge some came out 30 times too quiet
        return out

    def with_plane(self, maps: Any) -> StokesMaps:
        """The same with other maps (C, Ny, Nx) to be split."""
        return replace(self, planes={**self.planes, self.stokes: maps})


@dataclass(frozen=True, eq=False)
class Usable:
    """The maps of a cube that a remover can use, and what was left out."""

    __repr__ = short_repr
    maps: StokesMaps
    channels: Int  # of the cube (C,)
    good: Bool  # pixels (Ny, Nx)
    empty: Bool  # channels without data (F,)
    flat: Bool  # channels that do not vary (F,)

    @classmethod
    def of(cls, cube: StokesCube, stokes: Plane, others: tuple[Plane, ...] = ()) -> Usable:
        """Finite maps of some planes; warns of what is left out, with counts; raises `InputError` where nothing is."""
        planes = {name: _real(cube, name) for name in dict.fromkeys((stokes, *others))}
        plane = planes[stokes]
        low, high = plane.min(axis=(1, 2)), plane.max(axis=(1, 2))  # NaN and infinity show in either
        good, empty = np.ones(plane.shape[1:], bool), np.zeros(len(plane), bool)
        for name, one in planes.items():
            no_pixel, no_channel = _holes(one, name)
            good, empty = good & ~no_pixel, empty | no_channel
        if not good.any() or empty.all():
            raise InputError(f"{', '.join(planes)} have no pixel with data in every channel: flag those that spoil it")
        if not good.all():
            low, high = np.array([(x[good].min(), x[good].max()) for x in plane]).T
        flat = ~empty & (low == high)
        if flat.any():
            text = f"{stokes}: {flat.sum()} of {len(plane)} channels do not vary: left as they are"
            warn(text)
        use = np.flatnonzero(~(empty | flat))
        whole = len(use) == len(plane)
        psf = cube.psf if cube.psf is None or whole else _of_channels(cube.psf, use)
        maps = {name: _cut(one if whole else one[use], good, name) for name, one in planes.items()}
        return cls(StokesMaps(stokes, maps, cube.freq_hz[use], cube.pixel_rad, cube.unit, psf), use, good, empty, flat)

    def back(self, maps: Any) -> Any:
        """Maps of the channels in use on the axes of the cube (F, Ny, Nx): NaN without data, 0 where nothing varies."""
        if len(self.channels) == len(self.empty) and self.good.all():
            return maps
        out = np.zeros((len(self.empty), *self.good.shape), maps.dtype)
        out[self.channels] = maps
        out[:, ~self.good] = np.nan
        out[self.empty] = np.nan
        return out


def _real(cube: StokesCube, stokes: Plane) -> Any:
    plane = cube.data[:, "IQUV".index(stokes)]
    if plane.dtype.kind not in "fiu" or not plane.size:
        raise InputError(f"{stokes} is {plane.dtype} of shape {plane.shape}: a remover needs real numbers")
    return plane.astype(np.result_type(plane.dtype, np.float32), copy=False)


def _holes(plane: Any, stokes: str) -> tuple[Bool, Bool]:
    """Pixels (Ny, Nx) and channels (F,) of a plane that have no data; warns of them."""
    low, high = plane.min(axis=(1, 2)), plane.max(axis=(1, 2))
    spoilt = np.flatnonzero(~(np.isfinite(low) & np.isfinite(high)))
    good, empty = np.ones(plane.shape[1:], bool), np.zeros(len(plane), bool)
    if not len(spoilt):
        return ~good, empty
    finite = {c: np.isfinite(plane[c]) for c in spoilt.tolist()}
    most = plane[0].size if len(spoilt) < len(plane) else max(f.sum() for f in finite.values())
    for c, has in finite.items():
        empty[c] = has.sum() < max(most / 2, 1)  # one such channel must not cost the pixels of all others
        good &= has | empty[c]
    if not good.any() or empty.all():
        raise InputError(f"{stokes} has no pixel with data in every channel: flag the channels that spoil it")
    infinite = sum(int(np.isinf(plane[c]).sum()) for c in finite)
    warn(
        f"{stokes}: {empty.sum()} of {len(plane)} channels and {(~good).sum()} of {good.size} lines of sight "
        f"have NaN{f' ({infinite} voxels are infinite)' if infinite else ''}: left out, NaN in what comes back"
    )
    return ~good, empty


def _cut(maps: Any, good: Bool, stokes: str) -> Any:
    """Maps that cannot be written to, holes 0."""
    if not good.all():
        maps = np.where(good, maps, maps.dtype.type(0))
    low, high = float(maps.min(initial=0)), float(maps.max(initial=0))
    squarable(max(-low, high, 0.0) or 1.0, stokes)
    maps = maps.view()
    maps.setflags(write=False)  # a remover must not reach into the cube
    return maps


def _of_channels(psf: Psf, use: Int) -> Psf:
    data = None if psf.data is None else psf.data[use]
    return Psf(data, psf.major_rad[use], psf.minor_rad[use], psf.angle_rad[use], psf.residual[use])
