"""ForegroundRemover: takes a cube apart into foreground and residual, and says whether it was worth it."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from instrument.checked import checked
from instrument.component import Component
from instrument.errors import InputError, Outcome, warn
from instrument.foreground.linear import apply
from instrument.foreground.score import Score, estimated_score, true_score
from instrument.image.cube import StokesCube
from instrument.numbers import squarable
from instrument.shown import short_repr
from instrument.units import Bool, Float, Int, Seed

Plane = Literal["I", "Q", "U", "V"]


@checked
@dataclass(frozen=True, eq=False)
class Separation:
    """What a remover found in maps (F, Ny, Nx): how it ended, one line about it, the foreground in one of two forms.

    Either `foreground` (F, Ny, Nx) itself, or an `operator` (F, F) with foreground = operator @ maps + `offset` (F,);
    `basis` (F, n) are orthonormal spectra with operator = basis basis^T, where there are.
    `mixing` (F, n) are the spectra of `components` (n, Ny, Nx); n may be 0. `adapted` is whether the operator was
    chosen by looking at the maps: the score then has to measure how much of the noise was fitted. `covariance` (F, F)
    is the posterior covariance of the foreground of a pixel, where there is one.
    """

    __repr__ = short_repr
    outcome: Outcome
    remark: str
    mixing: Float
    components: Any
    foreground: Any = None
    operator: Float | None = None
    basis: Float | None = None
    offset: Float | None = None
    adapted: bool = True
    covariance: Float | None = None

    @classmethod
    def nothing(cls, maps: NDArray[Any], outcome: Outcome, remark: str) -> Separation:
        """No foreground at all: the residual is the data."""
        f = len(maps)
        none = np.zeros((0, *maps.shape[1:]), maps.dtype)
        return cls(outcome, remark, np.zeros((f, 0)), none, operator=np.zeros((f, f)), adapted=False)

    def of(self, maps: Any) -> Any:
        """The foreground in these maps (F, Ny, Nx), in their precision."""
        if self.foreground is not None:
            return self.foreground
        assert self.operator is not None, "a Separation needs its foreground or an operator"
        if self.basis is not None and 0 < self.basis.shape[1] < len(maps) // 2:
            out = apply(self.basis, apply(self.basis.T, maps))  # 2 n instead of F products a voxel
        else:
            out = apply(self.operator, maps)
        if self.offset is not None:
            out += self.offset.astype(out.dtype)[:, None, None] * maps.any(axis=0)
        return out


@dataclass(frozen=True, eq=False)
class Clean:
    """One Stokes plane made fit: the maps of the channels in use (C, Ny, Nx), holes 0, and what was left out."""

    __repr__ = short_repr
    maps: Any
    freq_hz: Float  # (C,)
    channels: Int  # of the cube (C,)
    good: Bool  # pixels (Ny, Nx)
    empty: Bool  # channels without data (F,)
    flat: Bool  # channels that do not vary (F,)

    @classmethod
    def of(cls, cube: StokesCube, stokes: Plane) -> Clean:
        """Finite maps of a plane; warns of what is left out, with counts; raises `InputError` where nothing is."""
        plane = cube.data[:, "IQUV".index(stokes)]
        if plane.dtype.kind not in "fiu" or not plane.size:
            raise InputError(f"{stokes} is {plane.dtype} of shape {plane.shape}: a remover needs real numbers")
        plane = plane.astype(np.result_type(plane.dtype, np.float32), copy=False)
        low, high = plane.min(axis=(1, 2)), plane.max(axis=(1, 2))  # NaN and infinity show in either
        spoilt = np.flatnonzero(~(np.isfinite(low) & np.isfinite(high)))
        good, empty = np.ones(plane.shape[1:], bool), np.zeros(len(plane), bool)
        if len(spoilt):
            finite = {c: np.isfinite(plane[c]) for c in spoilt.tolist()}
            most = plane[0].size if len(spoilt) < len(plane) else max(f.sum() for f in finite.values())
            for c, has in finite.items():
                empty[c] = has.sum() < max(most / 2, 1)  # one such channel must not cost the pixels of all others
                good &= has | empty[c]
            if not good.any() or empty.all():
                raise InputError(f"{stokes} has no pixel with data in every channel: flag the channels that spoil it")
            for c in spoilt[~empty[spoilt]]:
                low[c], high[c] = plane[c][good].min(), plane[c][good].max()
            infinite = sum(int(np.isinf(plane[c]).sum()) for c in finite)
            warn(
                f"{stokes}: {empty.sum()} of {len(plane)} channels and {(~good).sum()} of {good.size} lines of sight "
                f"have NaN{f' ({infinite} voxels are infinite)' if infinite else ''}: left out, NaN in what comes back"
            )
        flat = ~empty & (low == high)
        if flat.any():
            text = f"{stokes}: {flat.sum()} of {len(plane)} channels do not vary: left as they are"
            warn(text)
        use = np.flatnonzero(~(empty | flat))
        size = max((max(abs(float(low[c])), abs(float(high[c]))) for c in use), default=1.0)
        squarable(size, stokes)
        maps = plane if len(use) == len(plane) else plane[use]
        if not good.all():
            maps = np.where(good, maps, maps.dtype.type(0))
        maps = maps.view()
        maps.setflags(write=False)  # a remover must not reach into the cube
        return cls(maps, cube.freq_hz[use], use, good, empty, flat)

    def back(self, maps: Any) -> Any:
        """Maps of the channels in use on the axes of the cube (F, Ny, Nx): NaN without data, 0 where nothing varies."""
        if len(self.channels) == len(self.empty) and self.good.all():
            return maps
        out = np.zeros((len(self.empty), *self.good.shape), maps.dtype)
        out[self.channels] = maps
        out[:, ~self.good] = np.nan
        out[self.empty] = np.nan
        return out


@checked
class Split:
    """A cube taken apart: `foreground` and `residual`, cubes with cube = foreground + residual; other Stokes untouched.

    `components` (n, Ny, Nx) with spectra `mixing` (C, n) over the `channels` in use, how it ended (`outcome`) and one
    line about it (`remark`). `score` says whether it was worth it; `print(split)` says all in plain words.
    """

    def __init__(self, remover: ForegroundRemover, cube: StokesCube, clean: Clean, separation: Separation) -> None:
        self.remover = remover
        self.cube = cube
        self.separation = separation
        self._clean = clean
        self._scores: dict[Any, Score] = {}
        self._maps = separation.of(clean.maps) if len(clean.channels) else clean.maps
        if separation.mixing.shape[1] >= len(clean.maps):
            self._maps = clean.maps  # as many components as channels: exactly everything

    @property
    def outcome(self) -> Outcome:
        """How the remover ended; the value is the advice, `.check()` raises unless converged."""
        return self.separation.outcome

    @property
    def remark(self) -> str:
        """One line on what was done."""
        return self.separation.remark

    @property
    def components(self) -> Any:
        """Maps of the components (n, Ny, Nx), NaN in holes."""
        return np.where(self._clean.good, self.separation.components, np.nan)

    @property
    def mixing(self) -> Float:
        """Spectra of the components over the channels in use (C, n)."""
        return self.separation.mixing

    @property
    def channels(self) -> Int:
        """Channels of the cube that were used (C,)."""
        return self._clean.channels

    @cached_property
    def foreground(self) -> StokesCube:
        """The foreground; 0 in the other Stokes parameters."""
        data = np.zeros(self.cube.data.shape, self._maps.dtype)
        data[:, self._stokes] = self._clean.back(self._maps)
        return self.cube.with_data(data)

    @cached_property
    def residual(self) -> StokesCube:
        """The cube less the foreground; the other Stokes parameters as they were."""
        data = np.array(self.cube.data, np.result_type(self.cube.data.dtype, np.float32))
        data[:, self._stokes] -= self._clean.back(self._maps)
        return self.cube.with_data(data)

    @property
    def _stokes(self) -> int:
        return "IQUV".index(self.remover.stokes)

    def score(
        self,
        foreground: StokesCube | Any = None,
        k_par: float = 0.06,
        k_perp: tuple[float, float] = (0.02, 0.5),
        taper: str | None = "blackman-harris",
        seed: Seed = 0,
    ) -> Score:
        """Power of what the removal got wrong over that of the foreground: 1 is nothing gained, above 1 is worse.

        Over delays |k_par| below `k_par` and `k_perp` between two values (1/Mpc, Planck15). With the true `foreground`
        (a cube, or maps (F, Ny, Nx)): what it differs by from the one found. Without, an unbiased estimate of the same
        from the cube alone (`instrument.foreground.score`); an adapted operator is then run once more on the cube with
        a draw of noise (`seed`) added. Raises `InputError` where the cube has too few channels or pixels for that.
        """
        options = (k_par, k_perp, taper)
        clean, pixel = self._clean, self.cube.pixel_rad
        if foreground is not None:
            truth = foreground.data[:, self._stokes] if isinstance(foreground, StokesCube) else np.asarray(foreground)
            if truth.shape != (len(clean.empty), *clean.good.shape):
                raise InputError(f"the true foreground has shape {truth.shape}, the plane of the cube another")
            truth = np.where(clean.good, truth[clean.channels], 0.0)
            if not np.isfinite(truth).all():
                raise InputError("the true foreground is not finite where the cube has data")
            return true_score(truth, self._maps, clean.freq_hz, pixel, *options)
        key = (*options, seed)
        if key not in self._scores:
            again = self._again if self.separation.adapted else None
            self._scores[key] = estimated_score(
                clean.maps, self._maps, self.separation.operator, again, clean.freq_hz, pixel, *options, seed
            )
        return self._scores[key]

    def _again(self, maps: Any) -> Any:
        return self.remover.separate(maps, self._clean.freq_hz).of(maps)

    def __str__(self) -> str:
        n = self.mixing.shape[1]
        try:
            score = str(self.score())
        except InputError as error:
            score = f"not known: {error}"
        return "\n".join(
            (
                f"{type(self.remover).__name__} on Stokes {self.remover.stokes}, {len(self.channels)} channels",
                f"components  {n if n else 'none'}; {self.remark}",
                f"outcome     {self.outcome.value}",
                f"score       {score}",
            )
        )


@checked
class ForegroundRemover(Component):
    """Splits a cube into foreground and residual: `split(cube) -> Split`.

    A new remover is a class with fields and one method, `separate(maps, freq_hz) -> Separation`; it never sees a NaN.
    """

    plugin_kind: ClassVar[str | None] = "foregrounds"
    stokes: Plane = "I"

    @abstractmethod
    def separate(self, maps: Any, freq_hz: Float) -> Separation:
        """Foreground in maps (C, Ny, Nx) of channels at freq_hz (C,): finite, every channel varies, holes are 0.

        Must not change the maps, and depend on nothing but maps, frequencies and fields (a seed is a field).
        """

    def split(self, cube: StokesCube) -> Split:
        """Foreground and residual of one Stokes parameter; the cube stays as it is.

        Channels without data and lines of sight with NaN or infinity are left out and come back as NaN; channels that
        do not vary are left as they are. Each is warned of (`InstrumentWarning`), with counts. A cube without data
        raises `InputError`.
        """
        clean = Clean.of(cube, self.stokes)
        if not len(clean.channels):
            done = Separation.nothing(clean.maps, Outcome.CONVERGED, "no channel varies: nothing was taken away")
            return Split(self, cube, clean, done)
        found = self.separate(clean.maps, clean.freq_hz)
        if found.mixing.shape[1] >= len(clean.channels):
            text = f"{found.mixing.shape[1]} components of {len(clean.channels)} channels are everything: residual 0"
            warn(text)
            found = replace(found, outcome=Outcome.SINGULAR, remark=f"{text}, which says nothing; ask for fewer")
        shown = found.of(clean.maps[:, :1]) if found.foreground is None else found.foreground
        if not np.isfinite(shown).all():
            text = f"the foreground came out as NaN, nothing was taken away ({found.remark})"
            found = Separation.nothing(clean.maps, Outcome.SINGULAR, text)
        return Split(self, cube, clean, found)
