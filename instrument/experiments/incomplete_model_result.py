"""Sweep: what calibrating on incomplete models of a sky did, model by model and source by source."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from instrument.analyze.power.spectra import Spectrum2D, spectrum_2d
from instrument.analyze.sources.leakage import NULL
from instrument.errors import InputError
from instrument.image.cube import StokesCube
from instrument.observe.directions import lmn, offset
from instrument.shown import short_repr
from instrument.sky.points import PointSky
from instrument.units import Bool, Float, Int
from instrument.whole_file import write_ecsv

ARCSEC = float(np.rad2deg(1) * 3600)


class Ghost(NamedTuple):
    """The largest |Stokes I| of an image where there is no source: Jy/beam, and where."""

    jy: float
    ra_rad: float
    dec_rad: float


@dataclass(frozen=True, eq=False)
class Sweep:
    """Results for N models and G watched sources.

    `flux_jy` (G,) is the apparent flux in perfectly calibrated data, `change_jy` (N, G) how much of it the calibration
    adds (negative: it suppresses), `shift_rad` (N, G, 2) where it moves the source, in l (east) and m (north).
    `visibility_share` (N,) is the rms of corrected minus true visibilities over that of the true ones, `failed` (N,)
    the share of intervals whose solve did not converge; those are flagged and in no other figure. `reference` is the
    image of perfectly calibrated data, `residuals` are those of the differences to it.
    """

    __repr__ = short_repr
    models: tuple[int, ...]
    sources: int
    bright: int
    flux_share: Float
    failed: Float
    iterations: Float
    visibility_share: Float
    names: tuple[str, ...]
    rank: Int  # from 1
    ra_rad: Float
    dec_rad: Float
    model_jy: Float
    flux_jy: Float
    change_jy: Float
    shift_rad: Float
    reference: StokesCube | None
    residuals: tuple[StokesCube, ...]
    ghosts: tuple[Ghost, ...]

    @property
    def passed(self) -> bool:
        """Whether every solve converged."""
        return not np.any(self.failed > 0)

    @property
    def seen(self) -> Bool:
        """Which watched sources are not near a null of the beam (G,)."""
        return self.flux_jy > NULL * self.model_jy

    @property
    def modelled(self) -> Bool:
        """Which watched sources are in which model (N, G)."""
        return self.rank <= np.array(self.models)[:, None]

    @property
    def flux_error(self) -> Float:
        """|change| over the flux, (N, G)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.abs(self.change_jy) / np.abs(self.flux_jy)

    @property
    def shift_arcsec(self) -> Float:
        """Length of the shifts, arcsec (N, G)."""
        return np.hypot(self.shift_rad[..., 0], self.shift_rad[..., 1]) * ARCSEC

    @property
    def image_share(self) -> Float:
        """Rms of the residual images over that of the true image, Stokes I, first channel (N,); NaN without images."""
        if self.reference is None:
            return np.full(len(self.models), np.nan)
        # plain: an image without any data is NaN all over, and no other has NaN in it
        return np.array([cube.data[0, 0].std() for cube in self.residuals]) / self.reference.data[0, 0].std()

    @property
    def suppression(self) -> Float:
        """Flux left of the sources outside each model, over their true flux, weighted with flux squared (N,).

        One where nothing is lost; NaN where every watched source is in the model.
        """
        out = np.full(len(self.models), np.nan)
        for k, known in enumerate(self.modelled):
            use = ~known & self.seen
            if use.any():
                f = self.flux_jy[use]
                out[k] = 1 + (self.change_jy[k, use] @ f) / (f @ f)
        return out

    def spectra(self, stokes: Any = "I", **settings: Any) -> dict[int, Spectrum2D]:
        """Power spectra of the residual images by size of the model, and of the true image under 0."""
        if self.reference is None:
            raise InputError("spectra need images: IncompleteModel(image=Imager(...))")
        cubes = zip((0, *self.models), (self.reference, *self.residuals), strict=True)
        return {n: spectrum_2d(cube, stokes, **settings) for n, cube in cubes}

    def table(self) -> Any:
        """One row a model, an astropy `QTable` with units; sources near a null of the beam are left out.

        `bright` are the brightest, in the model or not; `bright_flux_rms` is the rms of how much their fluxes change.
        """
        from astropy import units as u
        from astropy.table import QTable

        out = QTable()
        out["n"] = list(self.models)
        out["flux_share"] = 100 * self.flux_share * u.percent
        out["failed"] = 100 * self.failed * u.percent
        out["visibility_rms"] = 100 * self.visibility_share * u.percent
        out["image_rms"] = 100 * self.image_share * u.percent
        inside, bright = self.modelled & self.seen, np.broadcast_to(self.rank <= self.bright, self.modelled.shape)
        outside, bright = ~self.modelled & self.seen, bright & self.seen
        for name, use in (("modelled", inside), ("unmodelled", outside), ("bright", bright)):
            for what, values, unit, scale in (
                ("flux", self.flux_error, u.percent, 100),
                ("shift", self.shift_arcsec, u.arcsec, 1),
            ):
                rows = [scale * row[pick] for row, pick in zip(values, use, strict=True)]
                out[f"{name}_{what}_median"] = [float(np.median(r)) if r.size else np.nan for r in rows] * unit
                out[f"{name}_{what}_max"] = [float(r.max()) if r.size else np.nan for r in rows] * unit
        changes = zip(self.change_jy, bright, strict=True)
        out["bright_flux_rms"] = [float(np.sqrt(np.mean(row[use] ** 2))) for row, use in changes] * u.Jy
        out["suppression"] = self.suppression
        if self.ghosts:
            out["ghost"] = [g.jy for g in self.ghosts] * u.Jy
            out["ghost_ra"] = np.rad2deg([g.ra_rad for g in self.ghosts]) * u.deg
            out["ghost_dec"] = np.rad2deg([g.dec_rad for g in self.ghosts]) * u.deg
        out.meta |= {"sources": self.sources, "watched": len(self.names), "bright": self.bright}
        return out

    def source_table(self) -> Any:
        """One row a watched source, an astropy `QTable` with units; columns `change_n` and `shift_n` for each model."""
        from astropy import units as u
        from astropy.table import QTable

        out = QTable()
        out["name"], out["rank"] = list(self.names), self.rank
        out["ra"], out["dec"] = np.rad2deg(self.ra_rad) * u.deg, np.rad2deg(self.dec_rad) * u.deg
        out["model"], out["flux"] = self.model_jy * u.Jy, self.flux_jy * u.Jy
        out["near_null"] = ~self.seen
        for k, n in enumerate(self.models):
            out[f"change_{n}"] = self.change_jy[k] * u.Jy
            out[f"east_{n}"] = self.shift_rad[k, :, 0] * ARCSEC * u.arcsec
            out[f"north_{n}"] = self.shift_rad[k, :, 1] * ARCSEC * u.arcsec
        return out

    def lines(self) -> list[str]:
        """The table in short, for the terminal."""
        out = ["sources  of the flux  visibilities   image     bright sources: flux, position   others: flux, position"]
        for row in self.table():
            image = f"{row['image_rms'].value:5.2f} %" if "image_rms" in row.colnames else ""
            out.append(
                f"{row['n']:7d}  {row['flux_share'].value:9.1f} %  {row['visibility_rms'].value:10.2f} %  {image}"
                f"  {row['bright_flux_median'].value:15.3f} %, {row['bright_shift_median'].value:.3f} arcsec"
                f"  {row['unmodelled_flux_median'].value:8.2f} %, {row['unmodelled_shift_median'].value:.3f} arcsec"
            )
        return [*out, "rms of what is left over the rms of data or image; medians of errors of fluxes and positions"]

    def write(self, folder: str | os.PathLike[str]) -> None:
        """Write sweep.ecsv, sources.ecsv and, where there are images, true.fits and residual-<n>.fits."""
        target = Path(folder)
        target.mkdir(parents=True, exist_ok=True)
        for name, table in (("sweep", self.table()), ("sources", self.source_table())):
            write_ecsv(table, target / f"{name}.ecsv")
        if self.reference is not None:
            self.reference.write(target / "true.fits")
        for n, cube in zip(self.models, self.residuals, strict=False):
            cube.write(target / f"residual-{n}.fits")


def find_ghosts(cube: StokesCube, sky: PointSky) -> Ghost:
    """The largest |Stokes I| of the first channel farther from every source than the width of the PSF.

    NaN where no pixel is free of sources.
    """
    from scipy.spatial import KDTree

    image = cube.data[0, 0]
    if cube.centre is None or cube.psf is None:
        raise InputError("ghosts are looked for in images with a phase centre and a PSF")
    where = cube.grid.lmn[:, :2].reshape(*image.shape, 2)
    free = KDTree(lmn(sky.vectors, cube.centre)[:, :2]).query(where)[0] > float(cube.psf.major_rad[0])
    free &= np.isfinite(image)
    away = np.where(free, np.abs(image), -1.0)
    if not free.any():
        return Ghost(np.nan, np.nan, np.nan)
    spot = np.unravel_index(np.argmax(away), image.shape)
    ra, dec = offset(cube.centre, *np.moveaxis(where[spot][None], -1, 0))
    return Ghost(float(away[spot]), float(ra[0]), float(dec[0]))


def ranks(sky: PointSky) -> Int:
    """Rank of each source by |I| + P, from 0 for the brightest (S,); the sources of a patch share theirs."""
    patches = sky.patches or ("",) * len(sky)
    labels = [f"patch {p}" if p else f"source {i}" for i, p in enumerate(patches)]
    _, group = np.unique(labels, return_inverse=True)
    power = np.bincount(group, sky.power_jy)
    order = np.empty(len(power), int)
    order[np.argsort(-power, kind="stable")] = np.arange(len(power))
    return np.asarray(order[group])
