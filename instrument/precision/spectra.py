"""Contests of power spectra: how deep a taper keeps a smooth foreground out, and a field of known spectrum."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from instrument.analyze.analyzer import Analyzer
from instrument.analyze.power.fourier import TAPERS, comoving, line_of_sight
from instrument.image.cube import StokesCube
from instrument.precision.contest import UNSET, Contest, Entry, Form, Trial
from instrument.precision.cube_peers import SPECTRA, floor_peers, known_peers
from instrument.units import Float

SIZES = ((96, 64), (64, 32), (192, 128))  # channels and pixels along a side: of the quick form, and of the full one
FIELDS = 4  # drawn anew, whose spectra are averaged
PIXEL_ARCMIN, STEP_HZ = 1.0, 0.2e6
FIRST = (2.0, 4.0, 6.0, 8.0, 12.0, 24.0)  # delays, in bins
FOREGROUND_K, INDEX = 5.0, -2.55
EDGES = np.geomspace(0.15, 1.0, 7)  # 1/Mpc
BOTH = ((None, None), ("hann", None), ("blackman-harris", None), ("blackman-harris", "hann"), ("hann", "hann"))


def contests(form: Form) -> list[Contest]:
    """Two a size: the floor behind a foreground of 5 K, and pieces of fields with P ~ k^-3.5."""
    sizes = SIZES[:1] if form.quick else sorted(SIZES)
    return [made for size in sizes for made in (_floor(form, *size), _known(form, *size))]


def _band(channels: int) -> Float:
    return np.asarray(150e6 + STEP_HZ * (np.arange(channels) - (channels - 1) / 2))


def cube_of(field: Float) -> StokesCube:
    """A field (F, Ny, Nx) in K as Stokes I, and as the others, that nobody looks at."""
    from astropy import units as u

    wide = np.broadcast_to(field[:, None], (len(field), 4, *field.shape[1:]))
    return StokesCube(wide, _band(len(field)) * u.Hz, PIXEL_ARCMIN * u.arcmin, "K")


def _floor(form: Form, channels: int, pixels: int) -> Contest:
    """A power law along frequency in every pixel: all its power is at small delays, what is seen above has leaked."""
    rng = np.random.default_rng(1)
    field = rng.normal(size=(pixels, pixels)) * FOREGROUND_K
    field = field * (_band(channels)[:, None, None] / 150e6) ** INDEX
    cube = cube_of(field)
    # without a taper, of delay 0: P = V / N^2 |DFT|^2, V / N the volume of a voxel
    whole = float(np.prod(_voxel_mpc()) * np.mean(field.sum(axis=0) ** 2) / channels)
    step = 2 * np.pi / (channels * _voxel_mpc()[0])

    def judge(found: tuple[Float, Float], asked: float) -> Trial:
        """Of k_par (M,) and the mean power there (M,)."""
        k, level = found
        window = k >= (asked - 0.5) * step
        delta2 = 1e6 * k[window] ** 3 * level[window] / (2 * np.pi**2)  # mK²
        worst = float(level[window].max()) / whole
        return Trial(worst, float(np.sqrt(np.mean(delta2**2))), user_max=float(delta2.max()))

    def answer(taper: Any) -> Callable[[float], tuple[Float, Float]]:
        def level(asked: float) -> tuple[Float, Float]:
            cells = Analyzer(cube).cells(taper=taper)
            return cells.k_par, (cells.power * cells.times).sum(axis=1) / cells.times.sum()

        return level

    entries = [Entry(f"taper {name or 'none'}", answer(name)) for name in TAPERS]
    if form.peers:
        entries += floor_peers(cube)
    return Contest(
        name=f"floor of the power spectrum, {channels} channels of {pixels} x {pixels}",
        kind="spectra",
        knob="first delay kept",
        values=FIRST[1::2] if form.quick else FIRST,
        entries=tuple(entries),
        judge=judge,
        error="largest power from the first delay kept on, over that of the foreground",
        error_user=f"floor of Delta2 there behind a foreground of {FOREGROUND_K:g} K, rms, mK2",
        truth=f"nothing: a power law of index {INDEX} along frequency has no power there that is its own",
        family="floor of the power spectrum",
        size=channels * pixels**2,
        size_word="voxels",
        peers=SPECTRA,
    )


def _voxel_mpc() -> tuple[float, float, float]:
    """Lengths of a voxel along frequency, y and x."""
    z, across = comoving(150e6, None, None)
    return line_of_sight(z, None) * STEP_HZ, *(float(np.deg2rad(PIXEL_ARCMIN / 60)) * across,) * 2


def law(k: Float) -> Float:
    """K² Mpc³ at k in 1/Mpc."""
    return np.asarray((np.maximum(k, 1e-9) / 0.1) ** -3.5)


def _known(form: Form, channels: int, pixels: int) -> Contest:
    """Pieces of periodic fields of twice the size along each axis."""
    fields = [_piece(channels, pixels, seed) for seed in range(FIELDS)]
    cubes = [cube_of(field) for field in fields]

    def judge(found: Float, asked: float) -> Trial:
        """Of power over that of the law, (fields, bins)."""
        off = found.mean(axis=0) - 1
        window = off[len(off) // 2 :]
        return Trial(
            float(np.sqrt(np.mean(off**2))), float(np.sqrt(np.mean(window**2))), user_max=float(np.abs(window).max())
        )

    def answer(taper: Any, space: Any) -> Callable[[float], Float]:
        def ratios(asked: float) -> Float:
            from astropy import units as u

            made = [Analyzer(c).spherical(taper=taper, taper_space=space, bins=EDGES / u.Mpc) for c in cubes]
            return np.stack([one.power / one.average(law) for one in made])

        return ratios

    entries = [Entry(f"taper {a or 'none'}, images {b or 'none'}", answer(a, b)) for a, b in BOTH]
    if form.peers:
        entries += known_peers(cubes, EDGES, law)
    span = f"{EDGES[0]:g} < k < {EDGES[-1]:g} 1/Mpc"
    return Contest(
        name=f"known spectrum, {channels} channels of {pixels} x {pixels}",
        kind="spectra",
        knob="own setting",
        values=(UNSET,),
        entries=tuple(entries),
        judge=judge,
        error=f"rms over bins of P over the true one, less 1, {span}, mean of {FIELDS}",
        error_user="the same of the upper half of the bins, where the window is",
        truth="the spectrum of which the fields were drawn, averaged over the cells of each bin",
        family="known spectrum",
        size=channels * pixels**2,
        size_word="voxels",
        peers=SPECTRA,
    )


def _piece(channels: int, pixels: int, seed: int) -> Float:
    """A piece (F, N, N), not periodic, of a periodic Gaussian field of twice the size with P = law(k)."""
    shape = 2 * channels, 2 * pixels, 2 * pixels
    step = _voxel_mpc()
    k = [2 * np.pi * np.fft.fftfreq(n, d) for n, d in zip(shape, step, strict=True)]
    white = np.fft.rfftn(np.random.default_rng(seed).standard_normal(shape))
    half = np.abs(k[2][: pixels + 1])
    size = np.sqrt(k[0][:, None, None] ** 2 + k[1][:, None] ** 2 + half**2)
    white *= np.where(size > 0, np.sqrt(law(size) / np.prod(step)), 0.0)
    return np.fft.irfftn(white, shape, axes=(0, 1, 2))[:channels, :pixels, :pixels]
