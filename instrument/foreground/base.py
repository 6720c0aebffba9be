"""ForegroundRemover: takes a cube apart into foreground and residual, and says whether it was worth it."""

from __future__ import annotations

import inspect
from abc import abstractmethod
from dataclasses import replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from instrument.checked import checked
from instrument.component import Component
from instrument.errors import InputError, Outcome, PluginError, warn
from instrument.foreground.maps import Plane, StokesMaps, Usable
from instrument.foreground.score import Cut, Score, estimated_score, true_score
from instrument.foreground.separation import Separation as Separation
from instrument.image.cube import StokesCube
from instrument.units import Float, Int, Seed


@checked
class Split:
    """A cube taken apart: `foreground` and `residual`, cubes with cube = foreground + residual; other Stokes untouched.

    `components` (n, Ny, Nx) with spectra `mixing` (C, n) over the `channels` in use, how it ended (`outcome`) and one
    line about it (`remark`). `score` says whether it was worth it; `print(split)` says all in plain words.
    """

    def __init__(self, remover: ForegroundRemover, cube: StokesCube, used: Usable, separation: Separation) -> None:
        self.remover = remover
        self.cube = cube
        self.separation = separation
        self._used = used
        self._scores: dict[Any, Score] = {}
        plane = used.maps.plane
        self._maps = separation.of(plane) if len(used.channels) else plane
        if separation.mixing.shape[1] >= len(plane):
            self._maps = plane  # as many components as channels: exactly everything

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
        return np.where(self._used.good, self.separation.components, np.nan)

    @property
    def mixing(self) -> Float:
        """Spectra of the components over the channels in use (C, n)."""
        return self.separation.mixing

    @property
    def channels(self) -> Int:
        """Channels of the cube that were used (C,)."""
        return self._used.channels

    @cached_property
    def foreground(self) -> StokesCube:
        """The foreground; 0 in the other Stokes parameters."""
        data = np.zeros(self.cube.data.shape, self._maps.dtype)
        data[:, self._stokes] = self._used.back(self._maps)
        return self.cube.with_data(data)

    @cached_property
    def residual(self) -> StokesCube:
        """The cube less the foreground; the other Stokes parameters as they were."""
        data = np.array(self.cube.data, np.result_type(self.cube.data.dtype, np.float32))
        data[:, self._stokes] -= self._used.back(self._maps)
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
        used, maps = self._used, self._used.maps
        cut = Cut(maps.freq_hz, self.cube.pixel_rad, k_par, k_perp, taper)
        if foreground is not None:
            truth = foreground.data[:, self._stokes] if isinstance(foreground, StokesCube) else np.asarray(foreground)
            if truth.shape != (len(used.empty), *used.good.shape):
                raise InputError(f"the true foreground has shape {truth.shape}, the plane of the cube another")
            truth = np.where(used.good, truth[used.channels], 0.0)
            if not np.isfinite(truth).all():
                raise InputError("the true foreground is not finite where the cube has data")
            return true_score(truth, self._maps, cut)
        key = (k_par, k_perp, taper, seed)
        if key not in self._scores:
            again = self._again if self.separation.adapted else None
            self._scores[key] = estimated_score(maps.plane, self._maps, self.separation.operator, again, cut, seed)
        return self._scores[key]

    def _again(self, maps: Any) -> Any:
        return self.remover.separate(self._used.maps.with_plane(maps)).of(maps)

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

    A new remover is a class with fields and one method, `separate(given) -> Separation`; it never sees a NaN. It splits
    Stokes `stokes`, and is given the other `planes` that it names, to look at.
    """

    plugin_kind: ClassVar[str | None] = "foregrounds"
    planes: ClassVar[tuple[Plane, ...]] = ()
    stokes: Plane = "I"

    def __init_subclass__(cls, **settings: Any) -> None:
        super().__init_subclass__(**settings)
        taken = list(inspect.signature(vars(cls)["separate"]).parameters) if "separate" in vars(cls) else []
        if len(taken) > 2:
            raise PluginError(
                f"{cls.__name__}.separate({', '.join(taken[1:])}) takes maps and frequencies, as removers did until "
                "2026-11: write separate(self, given), with given.plane and given.freq_hz"
            )

    @abstractmethod
    def separate(self, given: StokesMaps) -> Separation:
        """Foreground in `given.plane` (C, Ny, Nx): finite, every channel varies, holes are 0.

        Must not change the maps, and depend on nothing but maps and fields (a seed is a field).
        """

    def split(self, cube: StokesCube) -> Split:
        """Foreground and residual of one Stokes parameter; the cube stays as it is.

        Channels without data and lines of sight with NaN or infinity, in any plane that is looked at, are left out and
        come back as NaN; channels that do not vary are left as they are. Each is warned of (`InstrumentWarning`), with
        counts. A cube without data raises `InputError`.
        """
        used = Usable.of(cube, self.stokes, self.planes)
        maps, count = used.maps.plane, len(used.channels)
        if not count:
            done = Separation.nothing(maps, Outcome.CONVERGED, "no channel varies: nothing was taken away")
            return Split(self, cube, used, done)
        found = self.separate(used.maps)
        if found.mixing.shape[1] >= count:
            text = f"{found.mixing.shape[1]} components of {count} channels are everything: residual 0"
            warn(text)
            found = replace(found, outcome=Outcome.SINGULAR, remark=f"{text}, which says nothing; ask for fewer")
        shown = found.of(maps[:, :1]) if found.foreground is None else found.foreground
        if not np.isfinite(shown).all():
            text = f"the foreground came out as NaN, nothing was taken away ({found.remark})"
            found = Separation.nothing(maps, Outcome.SINGULAR, text)
        return Split(self, cube, used, found)
