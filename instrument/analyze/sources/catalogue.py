"""SourceCatalogue: sources that were found, with errors; tables, files, a sky of them, and what a reference says."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from instrument.checked import checked
from instrument.errors import InputError
from instrument.image.common_beam import shapes
from instrument.image.cube import StokesCube
from instrument.numbers import Index, Whole
from instrument.observe.directions import tangents
from instrument.shown import short_repr
from instrument.sky.points import PointSky
from instrument.units import Bool, Float, Int, one_si, unit_vectors
from instrument.whole_file import whole_file, write_ecsv

ENDINGS = {".ecsv": "ECSV", ".fits": "FITS"} | dict.fromkeys(
    (".skymodel", ".bbs", ".txt", ".csv", ".skyh5", ".osm"), "sky"
)


class Agreement(NamedTuple):
    """A catalogue beside a reference: which of its sources each reference source is (R,), -1 for none, and how well.

    `completeness` is the share of the reference that was found, `false` the share of the catalogue that is in no
    reference; `flux_ratio` (M,) found over true, `offset_rad` (M, 2) found less true towards east and north, of those
    that match; `bias` the median of `flux_ratio` less 1.
    """

    match: Int
    completeness: float
    false: float
    flux_ratio: Float
    offset_rad: Float
    bias: float


@checked
@dataclass(frozen=True, eq=False)
class SourceCatalogue:
    """S sources: places with errors (rad, east and north), flux densities (F, S, 4) in Jy with errors, sizes.

    `major_rad`, `minor_rad`, `angle_rad` (S,) are those of the source without the beam, 0 for a point; `rms` (S,) the
    noise of Stokes I at its place, Jy/beam; `island` (S,) sources of one number were fitted together; `fitted` (S,)
    is False where that took too long. Errors of places are those of Condon (1997) in noise of the resolution of the
    beam; those of fluxes are what the same measurement scatters by where there is no source.
    """

    __repr__ = short_repr
    ra_rad: Float
    dec_rad: Float
    place_error_rad: Float
    stokes_jy: Float
    error_jy: Float
    peak_jy: Float
    major_rad: Float
    minor_rad: Float
    angle_rad: Float
    rms: Float
    island: Int
    fitted: Bool
    freq_hz: Float

    def __len__(self) -> int:
        return len(self.ra_rad)

    @property
    def names(self) -> tuple[str, ...]:
        """s0001, s0002 ..., brightest first."""
        return tuple(f"s{k + 1:04d}" for k in range(len(self)))

    def sky(self, channel: Index = 0) -> PointSky:
        """A sky of these sources, with their fluxes in one channel: to predict, to subtract, to be measured again."""
        if not len(self):
            raise InputError("no source was found: there is no sky of them")
        channel = Whole(at_least=0, at_most=len(self.freq_hz) - 1).check(channel, "channel")
        shaped = {"major_rad": self.major_rad, "minor_rad": self.minor_rad, "angle_rad": self.angle_rad}
        return PointSky(
            names=self.names,
            ra_rad=self.ra_rad,
            dec_rad=self.dec_rad,
            stokes_jy=np.nan_to_num(self.stokes_jy[channel]),
            reference_hz=np.full(len(self), self.freq_hz[channel]),
            **(shaped if self.major_rad.any() else {}),
        )

    def table(self) -> Any:
        """Everything as an astropy table, one row a source, with units; several channels in one column (F,)."""
        from astropy import units as u
        from astropy.table import QTable

        out = QTable()
        out["name"] = list(self.names) or np.zeros(0, "U5")
        out["ra"], out["dec"] = np.rad2deg(self.ra_rad) * u.deg, np.rad2deg(self.dec_rad) * u.deg
        for k, name in enumerate(("ra_error", "dec_error")):
            out[name] = np.rad2deg(self.place_error_rad[:, k]) * 3600 * u.arcsec
        one = len(self.freq_hz) == 1
        for k, stokes in enumerate("IQUV"):
            for name, values in ((stokes, self.stokes_jy), (f"{stokes}_error", self.error_jy)):
                out[name] = (values[0, :, k] if one else values[:, :, k].T) * u.Jy
        out["peak"], out["rms"] = self.peak_jy * u.Jy, self.rms * u.Jy
        for name, size in (("major", self.major_rad), ("minor", self.minor_rad)):
            out[name] = np.rad2deg(size) * 3600 * u.arcsec
        out["angle"] = np.rad2deg(self.angle_rad) * u.deg
        out["island"], out["fitted"] = self.island, self.fitted
        out.meta["frequencies_hz"] = self.freq_hz.tolist()
        return out

    def write(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write it, by the ending of the name: .ecsv, .fits, both with errors, or its sky as `PointSky.write` does."""
        ending = Path(path).suffix.lower()
        if ending not in ENDINGS:
            raise InputError(f"{path}: a catalogue ends in {', '.join(ENDINGS)}")
        if ENDINGS[ending] == "ECSV":
            write_ecsv(self.table(), path, overwrite)
        elif ENDINGS[ending] == "sky":
            self.sky().write(path, overwrite)
        else:
            table = self.table()
            table.meta = {}
            with whole_file(path, overwrite) as partial:
                table.write(str(partial), format="fits", overwrite=True)

    def against(self, reference: PointSky, within: Any, least: Any = None) -> Agreement:
        """Beside the sources of a reference: each is the nearest one `within` an angle; those of `least` I count.

        A found source matches one of the reference only, the nearest.
        """
        from scipy.spatial import KDTree

        reach = 2 * np.sin(one_si(within, "rad", "within", above=0) / 2)
        floor = -np.inf if least is None else one_si(least, "Jy", "least")
        true = reference.stokes(self.freq_hz[:1])[0, :, 0]
        match = np.full(len(true), -1)
        mine = unit_vectors(self.ra_rad, self.dec_rad)
        theirs = unit_vectors(reference.ra_rad, reference.dec_rad)
        if len(self):
            apart, nearest = KDTree(theirs).query(mine, distance_upper_bound=reach)
            # nearest last: it stays
            for k in np.argsort(-apart):
                if np.isfinite(apart[k]):
                    match[nearest[k]] = k
            inside = np.isfinite(apart)
        else:
            inside = np.zeros(0, bool)
        counted = (true >= floor) & (match >= 0)
        ratio = self.stokes_jy[0, match[counted], 0] / true[counted]
        east, north = tangents(reference.ra_rad[counted], reference.dec_rad[counted])
        shift = mine[match[counted]] - theirs[counted]
        offset = np.stack([(shift * east).sum(axis=1), (shift * north).sum(axis=1)], axis=1)
        total = int((true >= floor).sum())
        return Agreement(
            match=match,
            completeness=float(counted.sum() / total) if total else float("nan"),
            false=float(np.mean(~inside)) if len(self) else 0.0,
            flux_ratio=ratio,
            offset_rad=offset,
            bias=float(np.median(ratio) - 1) if len(ratio) else float("nan"),
        )


def catalogue_of(
    p: Float, wide: Bool, fitted: Bool, island: Int, rms: Float, cube: StokesCube, stokes_jy: Float, error_jy: Float
) -> SourceCatalogue:
    """A catalogue, brightest first, of Gaussians in pixels (S, 6), `wide` where larger than the beam."""
    assert cube.psf is not None
    order = np.argsort(-np.nan_to_num(stokes_jy[:, :, 0]).max(axis=0), kind="stable")
    p, wide, fitted, island, rms, stokes_jy = (
        p[order], wide[order], fitted[order], island[order], rms[order], stokes_jy[:, order]
    )  # fmt: skip
    ra, dec = cube.grid.at(p[:, 1], p[:, 2]) if len(p) else (np.zeros(0), np.zeros(0))
    spread = _spread(p, cube.pixel_rad)
    known = np.flatnonzero(np.isfinite(cube.psf.major_rad) & (cube.psf.major_rad > 0))
    one = known[len(known) // 2]
    beam = shapes(cube.psf.major_rad[[one]], cube.psf.minor_rad[[one]], cube.psf.angle_rad[[one]])[0]
    powers, axes = np.linalg.eigh(spread - np.where(wide[:, None, None], beam, spread))
    minor, major = np.sqrt(8 * np.log(2) * np.maximum(powers.T, 0))
    noise = np.abs(rms / np.where(p[:, 0] == 0, 1.0, p[:, 0]))  # over the peak: Condon's 1 / (signal to noise)
    place = np.sqrt(np.stack([spread[:, 1, 1], spread[:, 0, 0]], axis=1)) * noise[:, None]
    return SourceCatalogue(
        ra_rad=np.asarray(ra), dec_rad=np.asarray(dec), place_error_rad=place, stokes_jy=stokes_jy,
        error_jy=error_jy[:, order], peak_jy=p[:, 0], major_rad=major, minor_rad=minor,
        angle_rad=np.where(major > 0, np.arctan2(axes[:, 1, 1], axes[:, 0, 1]) % np.pi, 0.0),
        rms=rms, island=island, fitted=fitted, freq_hz=cube.freq_hz,
    )  # fmt: skip


def _spread(p: Float, pixel_rad: float) -> Float:
    """Covariances (S, 2, 2), rows and columns north and east, rad², of Gaussians in pixels (S, 6)."""
    determinant = p[:, 3] * p[:, 5] - p[:, 4] ** 2
    north, east, both = p[:, 5] / determinant, p[:, 3] / determinant, p[:, 4] / determinant
    # minus of the inverse and minus of x, which runs to the west, cancel
    return np.moveaxis(np.array([[north, both], [both, east]]), 2, 0) * pixel_rad**2
