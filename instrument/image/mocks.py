"""Generated cubes: Galactic polarized emission in Faraday screens, what of it leaks into Stokes I, noise.

The recipe and its parameters are our own. They follow what is published of the field of 3C 196 (Jelic et al. 2015, A&A
583, A137; Asad et al. 2015, MNRAS 451, 3709: peak 5 K at +1.2 rad/m², brightest from -1.5 to +5 rad/m²), the angular
spectrum of Bernardi et al. (2009, A&A 500, 965) and noise of 60 mK in 600 h.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.checked import checked
from instrument.errors import InputError
from instrument.image.cube import StokesCube
from instrument.image.psf import Psf
from instrument.memory import afford
from instrument.observe.directions import LIGHT
from instrument.sky.screens import TEN, Emission, Screens, filtered, highest, turn_of
from instrument.units import Float, Seed, direction, to_si


@checked
def polarized_screens(
    pixels: int = 480,
    pixel: Any = "0.5 arcmin",
    frequencies: Any = None,
    seed: Seed = 196,
    screens: Screens = TEN,
    centre: Any = None,
) -> StokesCube:
    """Cube (F, 4, N, N) float32 in K of emission in Faraday screens; I = V = 0; 134 to 166 MHz in 0.2 MHz by default.

    P = Q + iU = sum_k A_k e_k(x) (nu / 150 MHz)^s exp(2i (phi_k + d_k(x)) lambda²), turned and scaled so that the
    largest |F(phi)| (steps of 0.1 rad/m², then 0.005) is `screens.peak_k` at `screens.brightest`. The default has, in
    four seeds, |P| of 1.9 to 2.0 K rms in a channel and an angular spectrum at 40 to 300 wavelengths (beam divided
    out) of slope -1.4, -1.7, -1.8 at 134, 150, 166 MHz (-1.65 +- 0.15 is observed): the ripple makes it flatter than
    -2.2 and digs canals. `FINE` are 27 screens without ripple behind a beam of 3' that goes with the wavelength: what
    is `leaked` of them has 7.1 mK rms and spectral eigenvalues 1, 0.69, 0.21, 0.047, 0.0044, 0.0021, 1.1e-3, 2.7e-4.
    """
    from astropy import units as u

    mhz = np.linspace(134, 166, 161) * u.MHz if frequencies is None else frequencies
    freq = np.atleast_1d(np.asarray(to_si(mhz, "Hz", "frequencies"), float))
    step = float(to_si(pixel, "rad", "pixel"))
    if pixels < 4 or not step > 0 or not (np.isfinite(freq).all() and (freq > 0).all() and len(freq)):
        raise InputError(f"pixels = {pixels} (4 or more), pixel = {pixel}, frequencies: all must be above 0")
    # the cube, and fields of every screen in complex64
    size = 16.0 * pixels**2 * len(freq) + screens.bytes_of(pixels)
    afford(size, f"a cube of {len(freq)} channels of {pixels} x {pixels} pixels", "ask for fewer")
    screens.check(pixels, step)
    fields = Emission.draw(screens, pixels, step, seed)
    data = np.zeros((len(freq), 4, pixels, pixels), np.float32)
    for plane, hertz in zip(data, freq, strict=True):
        p = fields.at(hertz).reshape(pixels, pixels)
        plane[1], plane[2] = p.real, p.imag
    _calibrate(data, (LIGHT / freq) ** 2, screens)
    psf = Psf.gaussian(screens.beam_rad(freq) * u.rad) if screens.fwhm else None
    at = None if centre is None else direction(centre, "centre")
    return StokesCube(data, freq * u.Hz, step * u.rad, "K", at, psf)


@checked
def leaked(
    cube: StokesCube,
    fraction: float = 0.003,
    radius: Any = None,
    frequency: Any = "150 MHz",
) -> StokesCube:
    """The same with what a simple station beam leaks of Q and U added to Stokes I; Q, U, V stay as they are.

    I += fraction (r nu / r_0 nu_0)² (Q cos 2 chi + U sin 2 chi), chi the azimuth about the centre, north through east:
    the quadrupole of a dipole pair, growing as the square of the distance from the centre and, as a beam does, with
    frequency. `fraction` is that at `radius` (0.685 of the half width of the image unless given) and at `frequency`.
    """
    ny, nx = cube.data.shape[2:]
    r_0 = 0.685 * cube.pixel_rad * max(ny // 2, nx // 2) if radius is None else to_si(radius, "rad", "radius")
    nu_0 = to_si(frequency, "Hz", "frequency")
    if not (np.isfinite(fraction) and r_0 > 0 and nu_0 > 0):
        given = f"fraction = {fraction}, radius = {radius}, frequency = {frequency}"
        raise InputError(f"{given}: the first must be finite, the others above 0")
    north, east = cube.grid.north, cube.grid.east
    # r² cos 2 chi = north² - east², r² sin 2 chi = 2 north east
    cosine = ((north[:, None] ** 2 - east**2) / r_0**2).astype(np.float32)
    sine = (2 * north[:, None] * east / r_0**2).astype(np.float32)
    data = np.array(cube.data, np.result_type(cube.data, np.float32))
    for plane, hertz in zip(data, cube.freq_hz, strict=True):
        scale = np.float32(fraction * (hertz / nu_0) ** 2)
        add_leakage(plane, (scale * cosine, scale * sine))
    return cube.with_data(data)


def add_leakage(planes: Any, maps: Any) -> None:
    """Add maps[k] times Q, U, V (as many as there are maps) to I of one channel (4, Ny, Nx), in place.

    A Stokes parameter without any data (all NaN, as of a file that was not given) adds nothing, and I is then 0.
    """
    has = [not np.isnan(plane).all() for plane in planes]
    if not any(has[1 : len(maps) + 1]):
        return
    if not has[0]:
        planes[0] = 0
    for k, leak in enumerate(maps, 1):
        if has[k]:
            planes[0] += leak * planes[k]


@checked
def noise_cube(like: StokesCube, sigma: Any, psf_shaped: bool = False, seed: Seed = 0) -> StokesCube:
    """Noise (F, 4, Ny, Nx) float32 of rms `sigma` in every pixel, on the axes of `like`; independent in I, Q, U, V.

    `sigma` has a unit, one or (F,). White per pixel, or (`psf_shaped`) as images of visibilities with natural weights
    have it: the covariance of two pixels is sigma² times the PSF between them, so that the spectrum is its transform.
    """
    scale = np.atleast_1d(to_si(sigma, like.unit, "sigma"))
    if scale.shape not in ((1,), (len(like.data),)) or not (np.isfinite(scale).all() and (scale >= 0).all()):
        raise InputError(f"sigma = {sigma} is not one value or {len(like.data)}, finite and not below 0")
    if psf_shaped and like.psf is None:
        raise InputError(
            "noise with the shape of the PSF needs a cube with a PSF: StokesCube(..., psf=Psf.gaussian(...))"
        )
    rng = np.random.default_rng(seed)
    data = np.empty(like.data.shape, np.float32)
    for f, (planes, rms) in enumerate(zip(data, np.broadcast_to(scale, len(data)), strict=True)):
        rng.standard_normal(dtype=np.float32, out=planes)
        if psf_shaped:
            amplitude = np.sqrt(_psf_transform(like, f))
            if not np.isfinite(amplitude).all():
                raise InputError(
                    f"the PSF of channel {f} is not known: leave the channel out, or take psf_shaped=False"
                )
            amplitude /= np.sqrt((amplitude**2).mean())
            for k in (0, 2):  # two real fields in one transform: the filter is even
                both = filtered(planes[k] + 1j * planes[k + 1], amplitude)
                planes[k], planes[k + 1] = both.real, both.imag
        planes *= np.float32(rms)
    return like.with_data(data)


def _calibrate(data: Any, lambda2: Float, screens: Screens) -> None:
    """Turn and scale Q and U in place so that the peak of |F(phi)| is where and what it should be."""
    p = data[:, 1:3].reshape(len(lambda2), 2, -1)
    found = highest(screens, lambda2, lambda part: p[:, 0, part] + 1j * p[:, 1, part], p.shape[2])
    # between steps of 0.1 a peak stands up to 0.2 % higher: all that come near are looked at in steps of 0.005
    near = np.flatnonzero(found > 0.99 * found.max())
    factor, shift = turn_of(screens, lambda2, p[:, 0, near].astype(float) + 1j * p[:, 1, near])
    for plane, l2 in zip(data, lambda2, strict=True):
        q, u = plane[1].copy(), plane[2]
        turn = factor * np.exp(2j * shift * l2)
        c, s = np.float32(turn.real), np.float32(turn.imag)
        plane[1], plane[2] = c * q - s * u, s * q + c * u


def _psf_transform(cube: StokesCube, channel: int) -> Float:
    """Transform of the PSF of a channel (Ny, Nx), not negative: the density of the visibilities."""
    psf, (ny, nx) = cube.psf, cube.data.shape[2:]
    assert psf is not None
    if psf.data is not None:
        return np.maximum(np.fft.fft2(np.fft.ifftshift(psf.data[channel])).real, 0)
    major, minor, angle = (float(x[channel % len(x)]) for x in (psf.major_rad, psf.minor_rad, psf.angle_rad))
    north, east = np.fft.fftfreq(ny, cube.pixel_rad)[:, None], -np.fft.fftfreq(nx, cube.pixel_rad)
    along, across = north * np.cos(angle) + east * np.sin(angle), east * np.cos(angle) - north * np.sin(angle)
    return np.asarray(np.exp(-(np.pi**2) / (4 * np.log(2)) * ((major * along) ** 2 + (minor * across) ** 2)))
