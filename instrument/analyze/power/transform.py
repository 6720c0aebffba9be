"""Fourier cells of a cube: power over cells (u, v) and delays, in double precision and bounded blocks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from instrument.analyze.power.bins import Frame
from instrument.analyze.power.cells import Cells
from instrument.analyze.power.channel_grid import even_channels, infill_operator, same_grid
from instrument.analyze.power.fourier import (
    Stokes,
    Taper,
    check_redshift,
    check_stokes,
    comoving,
    line_of_sight,
    taper_of,
    uv_limits,
)
from instrument.analyze.power.modes import Modes
from instrument.errors import InputError, warn
from instrument.image.cube import StokesCube
from instrument.numbers import LARGEST, squarable
from instrument.units import Bool, Complex, Float, Int, one_si

BLOCK = 8  # channels transformed at once: 8 images of 480 x 480 are 15 MB
COLUMNS = 512  # cells transformed along frequency at once: 1.3 MB of 161 channels stay in the cache
WEAK = 0.05  # of the largest response of a PSF: cells below it are not divided by it, but left out


@dataclass(frozen=True)
class Transform:
    """How a cube is brought to its Fourier cells; see `Analyzer.cells`."""

    stokes: Stokes = "I"
    taper: Taper | None = "blackman-harris"
    taper_space: Taper | None = None
    uv_range: tuple[float, float] | None = None
    psf_corrected: bool = False
    infill: Any = None
    redshift: float | None = None
    cosmology: Any = None


def cells_of(cube: StokesCube, settings: Transform, cross: StokesCube | None = None) -> Cells:
    """Cells of a cube, or of one cube across another (the real part); see `Analyzer.cells`.

    P = V / N² |DFT(w x)|² / mean w² (V the comoving volume, N the voxels): its sum over all cells over V is the
    variance (Parseval). Raises `InputError` for cubes that have no such spectrum.
    """
    stokes, cosmology = settings.stokes, settings.cosmology
    check_stokes(stokes)
    infill = None if settings.infill is None else one_si(settings.infill, "s", "infill", above=0)
    order, grid_hz, here = even_channels(cube, infill is not None)
    freq = float((grid_hz[0] + grid_hz[-1]) / 2)
    redshift = check_redshift(settings.redshift, float(grid_hz[0]), float(grid_hz[-1]))
    z, distance = comoving(freq, redshift, cosmology)
    depth = line_of_sight(z, cosmology)
    ny, nx = cube.data.shape[2:]
    cubes = [cube] if cross is None else [cube, same_grid(cube, cross)]
    masks = [_mask(c, stokes, order, infill is not None) for c in cubes]
    has, seen = (np.logical_and.reduce([m[k] for m in masks]) for k in (0, 1))
    here = here.copy()
    here[here] = seen
    window = _window(has, settings)
    half = stokes != "P"  # of a real image half the plane is made
    columns, uv, times, use = _within(cube, half, settings.uv_range)
    left_out: dict[str, int] = {}
    along = taper_of(len(grid_hz), settings.taper)
    spectra, response = [], None
    if settings.psf_corrected:
        response = _response(cube, order[seen], columns, use)
        strong = response.min(axis=0) >= WEAK * response.max()
        left_out["cells where the PSF is weak"] = int((~strong).sum())
        use, response = use[strong], response[:, strong]
    for c, mask in zip(cubes, masks, strict=True):
        found = _transform(c, stokes, order[seen], window, has, mask[2][seen], columns, use)
        if response is not None:
            found /= response
        spectra.append(found if here.all() else _filled(found, grid_hz, here, infill))
    n = len(grid_hz)
    square = float((window**2).mean() * (along**2).mean())
    # V / N^2 = cell / N: the volume of a voxel over their number
    scale = (distance * cube.pixel_rad) ** 2 * depth * (grid_hz[1] - grid_hz[0]) / (n * ny * nx * square)
    folds = _both_signs(n)
    power, auto = delays(spectra, along, folds, scale)
    if not 1 / LARGEST**2 < float(auto.max()) < LARGEST**2:  # only then is it worth to look at all voxels
        squarable(max(_size(c, stokes) for c in cubes), stokes)
    frame = Frame(
        cube.unit, stokes, freq, z, distance, depth, settings.taper, settings.taper_space,
        settings.uv_range and uv_limits(settings.uv_range), 1 - float(has.mean()), int((~here).sum()),
        settings.psf_corrected,
    )  # fmt: skip
    k_par = 2 * np.pi * np.arange(len(folds)) / (n * (grid_hz[1] - grid_hz[0]) * depth)
    rising = np.argsort(uv.ravel()[use], kind="stable")
    for values in (power,) if auto is power else (power, auto):
        for row in values:  # in place: a second array costs 25 ms to page in
            row[:] = row[rising]
    use = use[rising]
    k_perp = uv.ravel()[use] * 2 * np.pi / distance
    row, column = np.divmod(use, len(columns))
    step = *(2 * np.pi / (distance * n * cube.pixel_rad) for n in (ny, nx)), float(k_par[1])
    places = times.ravel()[use], folds, row, columns[column]
    return Cells(frame, k_perp, k_par, power, auto, *places, Modes(window, along, step, half), left_out)


def _window(has: Bool, settings: Transform) -> Float:
    """What an image is multiplied with (Ny, Nx): the taper where there are data."""
    window = has * np.multiply.outer(*(taper_of(n, settings.taper_space) for n in has.shape))
    if not window.any():
        text = "every pixel is NaN in some channel, or where the taper is not 0"
        raise InputError(f"{settings.stokes} has no data: {text}")
    if not has.all():
        text = f"{1 - has.mean():.2g} of the lines of sight hold NaN and count as zero: rims of holes scatter power"
        warn(text)
    return np.asarray(window)


def _within(cube: StokesCube, half: bool, uv_range: tuple[float, float] | None) -> tuple[Int, Float, Float, Int]:
    """Columns (C,) of the plane, |u| and how many cells each stands for (Ny, C), and which (N,) of these are wanted."""
    ny, nx = cube.data.shape[2:]
    v, u = np.fft.fftfreq(ny, cube.pixel_rad), np.fft.fftfreq(nx, cube.pixel_rad)
    low, high = uv_limits(uv_range)
    columns = np.flatnonzero(np.abs(u[: nx // 2 + 1] if half else u) <= high)
    uv = np.hypot(v[:, None], u[columns])
    times = np.broadcast_to((_both_signs(nx) if half else np.ones(nx))[columns], uv.shape)
    (use,) = np.nonzero(((uv >= low) & (uv <= high)).ravel())
    if not use.size:
        raise InputError(f"uv_range = {uv_range} holds no cell of an image of {nx} x {ny}")
    return columns, uv, times, use


def _filled(some: Complex, grid_hz: Float, here: Bool, infill: Any) -> Complex:
    """All channels (F, N) from those that are here."""
    out = np.empty((len(grid_hz), some.shape[1]), complex)
    out[here], out[~here] = some, infill_operator(grid_hz, here, infill) @ some
    return out


def _both_signs(n: int) -> Float:
    """How many of n cells each of the n // 2 + 1 from 0 to Nyquist stands for (both signs)."""
    times = np.full(n // 2 + 1, 2.0)
    times[[0] if n % 2 else [0, -1]] = 1
    return times


def _work(cube: StokesCube, stokes: str, number: int) -> Float | Complex:
    """Room for so many images in double precision (C, Ny, Nx); complex for "P"."""
    return np.empty((number, *cube.data.shape[2:]), complex if stokes == "P" else float)


def _plane(cube: StokesCube, stokes: str, channel: int, out: Float | Complex) -> None:
    """Put the image of a channel (Ny, Nx) into `out`."""
    if stokes == "P":
        out.real, out.imag = cube.data[channel, 1], cube.data[channel, 2]
    else:
        out[:] = cube.data[channel, "IQUV".index(stokes)]


def _size(cube: StokesCube, stokes: str) -> float:
    """Largest |value| of a Stokes parameter, or of Q and U."""
    values = cube.data[:, 1:3] if stokes == "P" else cube.data[:, "IQUV".index(stokes)]
    return max(float(np.fmax.reduce(np.abs(plane), axis=None)) for plane in values)  # one channel held at a time


def _mask(cube: StokesCube, stokes: str, order: Int, infill: bool) -> tuple[Bool, Bool, Float | Complex]:
    """Pixels with data in every channel that has any (Ny, Nx), and in order (F,) those channels and all sums."""
    has = np.ones(cube.data.shape[2:], bool)
    seen = np.ones(len(order), bool)
    image = _work(cube, stokes, 1)[0]
    sums = np.empty(len(order), image.dtype)
    for k, channel in enumerate(order):
        # the sum of an image is finite unless a voxel is not: most channels are read once only
        _plane(cube, stokes, channel, image)
        sums[k] = image.sum()
        if np.isfinite(sums[k]):
            continue
        if np.isinf(image).any():
            raise InputError(
                f"{stokes} of channel {channel} has {np.isinf(image).sum()} infinite pixels: make them NaN"
            )
        good = ~np.isnan(image)
        seen[k] = good.any()
        has &= good | ~seen[k]
    if not seen.any():
        raise InputError(f"{stokes} has no data: all NaN")
    if not seen.all() and not infill:
        where = ", ".join(str(c) for c in order[~seen][:5]) + (", ..." if (~seen).sum() > 5 else "")
        raise InputError(
            f"{(~seen).sum()} channels are all NaN ({where}): fill them in with infill=300 * u.ns, or leave them out"
        )
    return has, seen, sums


def _transform(
    cube: StokesCube,
    stokes: str,
    channels: Int,
    window: Float,
    has: Bool,
    sums: Float | Complex,
    columns: Int,
    use: Int,
) -> Complex:
    """Cells `use` among columns of the DFT of each image behind the window, the mean of the cube taken off (C, N).

    `sums` of the images are those of all pixels, used where no line of sight is left out.
    """
    work = _work(cube, stokes, min(BLOCK, len(channels)))
    whole, flat = has.all(), (window == 1).all()
    if not whole:
        sums = np.empty_like(sums)
        for k, channel in enumerate(channels):
            _plane(cube, stokes, channel, work[0])
            sums[k] = work[0][has].sum()
    mean = sums.sum() / (len(channels) * has.sum())
    out = np.empty((len(channels), use.size), complex)
    for a in range(0, len(channels), BLOCK):
        part = work[: len(channels) - a]
        for channel, image in zip(channels[a : a + BLOCK], part, strict=True):
            _plane(cube, stokes, channel, image)
            image -= mean
            if not flat:
                image *= window
            if not whole:
                image[~has] = 0.0  # 0 times NaN is NaN
        into = out[a : a + BLOCK]
        if use.size == len(window) * len(columns):
            _columns_of(part, columns, into.reshape(len(part), len(window), -1))
        else:
            np.take(_columns_of(part, columns).reshape(len(part), -1), use, axis=1, out=into, mode="clip")
    return out


def _columns_of(images: Float | Complex, columns: Int, out: Complex | None = None) -> Complex:
    """Some columns of the DFT over the last two axes (..., Ny, C): rows first, then only what is asked for."""
    from ducc0 import fft

    rows = fft.c2c if np.iscomplexobj(images) else fft.r2c
    first: Any = rows(images, axes=(images.ndim - 1,), nthreads=0)
    if len(columns) < first.shape[-1]:
        first = first[..., columns]
    return np.asarray(fft.c2c(first, axes=(images.ndim - 2,), out=first if out is None else out, nthreads=0))


def delays(spectra: list[Complex], along: Float, folds: Float, scale: float) -> tuple[Float, Float]:
    """Power of delays 0 to Nyquist (M, N), mean over both signs, across and by itself."""
    from ducc0 import fft

    n, m, size = len(along), len(folds), spectra[0].shape[1]
    power = np.empty((m, size))
    auto = power if len(spectra) == 1 else np.empty((m, size))
    for a in range(0, size, COLUMNS):
        block = slice(a, a + COLUMNS)
        parts = [s[:, block] * along[:, None] for s in spectra]  # (n, cells)
        for part in parts:
            fft.c2c(part, axes=(0,), nthreads=0, out=part)
        squares = [p.real**2 + p.imag**2 for p in parts]
        power[:, block] = _folded(_across(parts) if len(parts) == 2 else squares[0], n, m) * scale
        if len(parts) == 2:
            auto[:, block] = np.sqrt(_folded(squares[0], n, m) * _folded(squares[1], n, m)) * scale
    return power, auto


def _across(parts: list[Complex]) -> Float:
    one, two = parts
    return one.real * two.real + one.imag * two.imag


def _folded(square: Float, n: int, m: int) -> Float:
    """Mean of delays +k and -k, k = 0 to Nyquist."""
    out = square[:m].copy()
    inner = slice(1, (n - 1) // 2 + 1)
    out[inner] = (out[inner] + square[: n // 2 : -1]) / 2
    return out


def _response(cube: StokesCube, channels: Int, columns: Int, use: Int) -> Float:
    """What the PSF makes of each cell, |DFT(PSF)| pixel² / solid angle (C, N); 1 at 0 for a Gaussian PSF."""
    if cube.psf is None or cube.psf.data is None:
        raise InputError("psf_corrected needs the images of the PSF: give a cube that an Imager has made")
    out = np.empty((len(channels), use.size))
    for k, channel in enumerate(channels):
        psf = np.asarray(cube.psf.data[channel], complex)
        if psf.shape != cube.data.shape[2:] or not np.isfinite(psf).all():
            raise InputError(f"the PSF of channel {channel} is {psf.shape} or not finite: it must be like the image")
        out[k] = np.abs(_columns_of(psf, columns)).ravel()[use] * cube.pixel_rad**2 / cube.psf.solid_angle_sr[channel]
    return out
