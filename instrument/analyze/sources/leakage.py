"""Leakage: how much of Stokes I of each source is seen as linear and circular polarization."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from instrument.analyze.sources.fluxes import SourceFluxes
from instrument.checked import checked
from instrument.jones.chain import Chain
from instrument.jones.mean_mueller import mean_mueller
from instrument.observe.directions import separation
from instrument.observe.sampling import Sampling
from instrument.shown import short_repr
from instrument.units import Bool, Direction, Float, Whole, unit_vectors
from instrument.whole_file import write_ecsv

NULL = 0.01  # apparent over true flux below which a source lies near a null of the beam
CLEAR = 0.25  # % of I: error up to which a leakage counts as measured; never by its own value, which would select


@checked
@dataclass(frozen=True)
class Leakage:
    """Leakage of every source, one channel: fluxes (G, 4) in Jy, leakages in % of its apparent I (G,).

    The polarization that the sky has there, as a fraction of I, is taken out first. `error_jy` (G, 4) are the errors of
    the fluxes (see `SourceFluxes`), `error_percent` those of the leakages to first order. `near_null` marks sources
    whose apparent flux is below 1 % of the true one: their leakage is a ratio of two small numbers and says little
    about the instrument. `measured` leaves those out, those that have no Stokes I in the sky, and those too faint
    beside their neighbours to be known to 0.25 %. Sources that the tolerance of a plan drops are not in what a run
    measures.
    `expected` holds the same leakages (G, 2) from the beam model (the mean Mueller matrix over baselines and times),
    where it was asked for.
    """

    __repr__ = short_repr
    names: tuple[str, ...]
    ra_rad: Float
    dec_rad: Float
    distance_rad: Float
    model_jy: Float
    stokes_jy: Float
    error_jy: Float
    freq_hz: float
    near_null: Bool
    expected: Float | None = None

    def _share(self, values: Float) -> Float:
        with np.errstate(divide="ignore", invalid="ignore"):
            return 100 * values / np.abs(self.stokes_jy[:, 0])

    @property
    def leaked_jy(self) -> Float:
        """Q, U, V in Jy beyond what the source has itself (G, 3)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            own = np.where(self.model_jy[:, :1] != 0, self.model_jy[:, 1:] / self.model_jy[:, :1], 0.0)
        return np.asarray(self.stokes_jy[:, 1:] - own * self.stokes_jy[:, :1])

    @property
    def linear_percent(self) -> Float:
        """sqrt(Q2 + U2) / |I|, % (G,)."""
        return self._share(np.hypot(self.leaked_jy[:, 0], self.leaked_jy[:, 1]))

    @property
    def circular_percent(self) -> Float:
        """|V| / |I|, % (G,)."""
        return self._share(np.abs(self.leaked_jy[:, 2]))

    @property
    def error_percent(self) -> Float:
        """Errors of the linear and the circular leakage, % of I (G, 2): of Q/I, U/I along their sum, and of V/I.

        To first order; a leakage below its error scatters less, and is biased upwards (Rice).
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            seen = self.stokes_jy[:, 1:] / self.stokes_jy[:, :1]
            common = (self.error_jy[:, 0] / self.stokes_jy[:, 0]) ** 2
            q, u, v = ((self.error_jy[:, 1:] / self.stokes_jy[:, :1]) ** 2).T
            along = self.leaked_jy[:, :2] / np.hypot(*self.leaked_jy[:, :2].T)[:, None]
            along = np.where(np.isfinite(along), along, np.sqrt(0.5))
        linear = along[:, 0] ** 2 * q + along[:, 1] ** 2 * u + (along * seen[:, :2]).sum(axis=1) ** 2 * common
        return 100 * np.sqrt(np.stack([linear, v + seen[:, 2] ** 2 * common], axis=1))

    @property
    def measured(self) -> Bool:
        """Which sources have a leakage that says something (G,)."""
        with np.errstate(invalid="ignore"):
            error = self.error_percent[:, 0]
            known = error <= CLEAR
        return known & ~self.near_null & (self.model_jy[:, 0] != 0)

    def table(self) -> Any:
        """Everything as an astropy table, one row a source, with units."""
        from astropy import units as u
        from astropy.table import QTable

        out = QTable()
        out["name"] = list(self.names)
        out["ra"] = np.rad2deg(self.ra_rad) * u.deg
        out["dec"] = np.rad2deg(self.dec_rad) * u.deg
        out["distance"] = np.rad2deg(self.distance_rad) * u.deg
        for k, stokes in enumerate("IQUV"):
            out[stokes] = self.stokes_jy[:, k] * u.Jy
        out["I_model"] = self.model_jy[:, 0] * u.Jy
        out["linear"] = self.linear_percent * u.percent
        out["circular"] = self.circular_percent * u.percent
        out["linear_error"] = self.error_percent[:, 0] * u.percent
        out["circular_error"] = self.error_percent[:, 1] * u.percent
        if self.expected is not None:
            out["linear_expected"] = self.expected[:, 0] * u.percent
            out["circular_expected"] = self.expected[:, 1] * u.percent
        out["near_null"] = self.near_null
        out["measured"] = self.measured
        out.meta["frequency_hz"] = self.freq_hz
        return out

    def write(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write the table as ECSV."""
        write_ecsv(self.table(), path, overwrite)

    def rings(self, edges_deg: tuple[float, ...] = (0.1, 1, 2, 3, 4, 5)) -> list[dict[str, float]]:
        """Median and maximum leakage of measured sources in rings about the centre, the first within the first edge."""
        distance = np.rad2deg(self.distance_rad)
        rows = []
        for low, high in zip((0.0, *edges_deg[:-1]), edges_deg, strict=True):
            # a source at the very centre may be at 1e-15 deg
            inside = (distance >= low) & (distance < high) & self.measured
            if not inside.any():
                continue
            linear, circular = self.linear_percent[inside], self.circular_percent[inside]
            rows.append(
                {
                    "from_deg": low,
                    "to_deg": high,
                    "sources": int(inside.sum()),
                    "linear_median": float(np.median(linear)),
                    "linear_max": float(linear.max()),
                    "circular_median": float(np.median(circular)),
                    "circular_max": float(circular.max()),
                }
            )
        return rows

    def inside(self, radius_deg: float) -> dict[str, float]:
        """Median and maximum leakages of the measured sources within a radius."""
        use = (np.rad2deg(self.distance_rad) <= radius_deg) & self.measured
        linear, circular = self.linear_percent[use], self.circular_percent[use]
        return {
            "sources": int(use.sum()),
            "linear_median": float(np.median(linear)) if use.any() else float("nan"),
            "linear_max": float(linear.max()) if use.any() else float("nan"),
            "circular_median": float(np.median(circular)) if use.any() else float("nan"),
            "circular_max": float(circular.max()) if use.any() else float("nan"),
        }


def leakage_of(fluxes: SourceFluxes, centre: Direction, channel: int = 0, expected: Float | None = None) -> Leakage:
    """Leakage of measured fluxes in one channel, about a centre."""
    channel = Whole(at_least=0, at_most=len(fluxes.freq_hz) - 1).check(channel, "channel")
    measured, model = fluxes.stokes_jy[channel], fluxes.model_jy[channel]
    with np.errstate(invalid="ignore"):
        null = np.abs(measured[:, 0]) < NULL * np.abs(model[:, 0])
    return Leakage(
        names=fluxes.names,
        ra_rad=fluxes.ra_rad,
        dec_rad=fluxes.dec_rad,
        distance_rad=separation(unit_vectors(fluxes.ra_rad, fluxes.dec_rad), centre),
        model_jy=model,
        stokes_jy=measured,
        error_jy=fluxes.error_jy[channel],
        freq_hz=float(fluxes.freq_hz[channel]),
        near_null=null,
        expected=expected,
    )


def expected_percent(
    chain: Chain, at: Sampling, stokes_jy: Float, channel: int = 0, differential: bool = True
) -> Float:
    """Linear and circular polarization in % of I (S, 2) that leaks into sources of Stokes (S, 4): the beam model's."""
    seen = np.einsum("sij,sj->si", mean_mueller(chain, at, differential)[channel], stokes_jy).real
    with np.errstate(divide="ignore", invalid="ignore"):
        own = np.where(stokes_jy[:, :1] != 0, stokes_jy[:, 1:] / stokes_jy[:, :1], 0.0)
        leaked = seen[:, 1:] - own * seen[:, :1]
        return (
            100 * np.stack([np.hypot(leaked[:, 0], leaked[:, 1]), np.abs(leaked[:, 2])], axis=1) / np.abs(seen[:, :1])
        )
