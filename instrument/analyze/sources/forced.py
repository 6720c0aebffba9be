"""Fluxes at known places in images, in every channel and Stokes parameter, with errors from places without a source."""

from __future__ import annotations

import numpy as np

from instrument.analyze.sources.gaussians import gaussian, shares, windows
from instrument.analyze.sources.islands import clipped
from instrument.image.common_beam import shapes
from instrument.image.cube import StokesCube
from instrument.units import Bool, Float, Int

PLACES = 20_000  # at which the error of a flux is told, to 0.5 %


def beams_of(cube: StokesCube) -> Float:
    """Beams of the channels as a, b, c of a Gaussian in pixels (F, 3), NaN where there is none."""
    psf = cube.psf
    assert psf is not None
    spread = shapes(psf.major_rad, psf.minor_rad, psf.angle_rad) / cube.pixel_rad**2
    spread[:, 0, 1] *= -1  # x runs to the west
    determinant = spread[:, 0, 0] * spread[:, 1, 1] - spread[:, 0, 1] ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([spread[:, 1, 1], -spread[:, 0, 1], spread[:, 0, 0]], axis=1) / determinant[:, None]


def areas(p: Float, beam: Float) -> Float:
    """Areas of Gaussians (n, 6) over that of the beam (3,): what takes a peak in Jy/beam to Jy."""
    return np.asarray(np.sqrt((beam[0] * beam[2] - beam[1] ** 2) / (p[:, 3] * p[:, 5] - p[:, 4] ** 2)))


def forced(cube: StokesCube, p: Float, wide: Bool, label: Int, labels: Int, half: int) -> tuple[Float, Float]:
    """Flux densities and their errors, Jy (F, n, 4), of Gaussians in pixels (n, 6).

    Points have the beam of the channel. Those of one `label` (n,) are measured together, in windows of `half` pixels
    about them, where `labels` (Ny, Nx) is theirs or 0. Places and shapes are held. NaN where a channel or Stokes
    parameter has no data or beam.
    """
    flux, error = np.full((2, len(cube.data), len(p), 4), np.nan)
    groups = [np.flatnonzero(label == one) for one in np.unique(label)]
    for f, beam in enumerate(beams_of(cube)):
        if not np.isfinite(beam).all():
            continue
        planes, shaped = np.asarray(cube.data[f], float), p.copy()
        shaped[~wide, 3:] = beam
        area = areas(shaped, beam)
        levels = np.array([clipped(plane)[0] for plane in planes])
        planes = planes - np.where(np.isfinite(levels), levels, 0.0)[:, None, None]
        for which in groups:
            y, x = _places(shaped[which], half, labels, int(label[which[0]]))
            values = planes[:, y, x]
            good = np.isfinite(values[0])
            known = np.flatnonzero(np.isfinite(values[:, good]).all(axis=1))
            if good.sum() < len(which) or not len(known):
                continue
            found = shares(shaped[which], values[known][:, good], y[good].astype(float), x[good].astype(float))
            flux[f, which[:, None], known] = found * area[which, None]
        scatter = np.array([_scatter(plane, beam, half) for plane in planes])
        error[f] = scatter * np.where(wide, np.sqrt(3) * area, 1.0)[:, None]
    return flux, np.where(np.isnan(flux), np.nan, error)


def _places(p: Float, half: int, labels: Int, own: int) -> tuple[Int, Int]:
    """Rows and columns of the windows about sources, each once, that lie in the image and on no other island."""
    y, x = windows(np.rint(p[:, 1:3]).astype(int), half)
    inside = (y >= 0) & (y < labels.shape[0]) & (x >= 0) & (x < labels.shape[1])
    rows, columns = np.unique(np.stack([y[inside], x[inside]]), axis=1)
    mine = (labels[rows, columns] == 0) | (labels[rows, columns] == own)
    return rows[mine], columns[mine]


def _scatter(plane: Float, beam: Float, half: int) -> float:
    """Rms of the fluxes of points that are measured, in the same way, at places spread over an image (Ny, Nx)."""
    inner = [max(n - 2 * half, 1) for n in plane.shape]
    step = max(1, int(np.sqrt(inner[0] * inner[1] / PLACES)))
    grid = (np.arange(half, half + n, step) for n in inner)
    y, x = windows(np.stack([a.ravel() for a in np.meshgrid(*grid, indexing="ij")], axis=1), half)
    inside = (y < plane.shape[0]) & (x < plane.shape[1])
    step_y, step_x = (a[:1].astype(float) for a in windows(np.zeros((1, 2), int), half))
    one = gaussian(np.array([[1.0, 0.0, 0.0, *beam]]), step_y, step_x)[0]
    values = np.where(inside, plane[np.minimum(y, plane.shape[0] - 1), np.minimum(x, plane.shape[1] - 1)], np.nan)
    return clipped(values @ one / (one**2).sum())[1]
