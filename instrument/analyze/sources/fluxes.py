"""SourceFluxes, and the sums that find them: of each Stokes parameter by itself where correlations differ in weight."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from instrument.errors import Outcome
from instrument.units import Float
from instrument.visibilities import Visibilities


@dataclass(frozen=True)
class SourceFluxes:
    """Measured Stokes fluxes in Jy (F, G, 4) of G groups of sources (a patch, or a source by itself).

    The sources of a patch keep the shares of its Stokes I that they have in the sky, channel by channel.
    `error_jy` is the rms of what the solution leaves in the real or imaginary part of the visibilities times the root
    of the diagonal of (A^H W A)^-1: right for noise, for sources that are close together or resolved too. What sources
    outside the sky leave, and the change of apparent fluxes with time and baseline, is not independent: what it adds
    up to at 32 blank places beside the sources (1 to 10 / median baseline from them) scales the error, for each Stokes
    parameter by itself, where sums over 16 chunks of time scatter by more than noise. It is known to 1 / 8 there, and
    is that of the mean of the sources: true errors in the scene mock-grid are 0.6 (centre) to 1.2 times (4 to 5 deg) as
    large for linear leakage, 1.4 times for circular. It is never below what rounding hides, 3e-8 of the rms visibility.
    """

    names: tuple[str, ...]
    ra_rad: Float
    dec_rad: Float
    model_jy: Float  # (F, G, 4), what the sky has there
    stokes_jy: Float  # (F, G, 4)
    error_jy: Float  # (F, G, 4)
    freq_hz: Float
    outcome: tuple[Outcome, ...]  # per channel
    iterations: int


class FluxSums(Protocol):
    """Sums over blocks of visibilities with one weight each."""

    def add(self, block: Visibilities) -> None:
        """Add a block."""

    def finish(self) -> SourceFluxes:
        """Solve for the fluxes (F, G, 4)."""


class StokesSums:
    """Sums over blocks; one for all Stokes parameters until a block has weights of their own, and four from then on."""

    def __init__(self, sums: FluxSums) -> None:
        self.sums = [sums]

    def add(self, block: Visibilities) -> None:
        """Add a block."""
        weights = block.stokes_weight
        if weights.shape[-1] == 1 and len(self.sums) == 1:
            self.sums[0].add(block)
            return
        if len(self.sums) == 1:
            self.sums = [deepcopy(self.sums[0]) for _ in range(4)]
        # of what a Stokes parameter is not made of, the data may be NaN
        data = np.where(np.isfinite(block.data), block.data, 0.0)
        weights = np.broadcast_to(weights, (*weights.shape[:3], 4))
        for k, sums in enumerate(self.sums):
            sums.add(replace(block, data=data, weight=weights[..., k], flag=np.zeros((1, 1, 1), bool)))

    def finish(self) -> SourceFluxes:
        """The fluxes (F, G, 4); a channel ended as the first Stokes parameter of it that is not known."""
        found = [sums.finish() for sums in self.sums]
        if len(found) == 1:
            return found[0]
        ends = zip(*(f.outcome for f in found), strict=True)
        failed = [[o for o in each if o is not Outcome.CONVERGED] for each in ends]
        return replace(
            found[0],
            stokes_jy=np.stack([f.stokes_jy[..., k] for k, f in enumerate(found)], axis=-1),
            error_jy=np.stack([f.error_jy[..., k] for k, f in enumerate(found)], axis=-1),
            outcome=tuple(ended[0] if ended else Outcome.CONVERGED for ended in failed),
            iterations=max(f.iterations for f in found),
        )
