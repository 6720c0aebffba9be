"""Cases of cubes of images: kelvin, beams, one resolution, generated screens and noise, leakage of a beam, blanks."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from instrument.errors import InputError, InstrumentWarning
from instrument.image.beam_leakage import leaked_through
from instrument.image.cube import StokesCube
from instrument.image.mocks import leaked, noise_cube, polarized_screens
from instrument.image.psf import Psf, fit_psf
from instrument.model import Composed
from instrument.observe.directions import offset
from instrument.sky.screens import Screens
from instrument.stress.bench import small_array
from instrument.stress.case import Answer, both, case, claim, held
from instrument.stress.cases_exact import Slanted
from instrument.units import Direction, Float

ARCMIN = np.pi / 180 / 60
CENTRE = Direction(2.15, 0.84)
FREQ = np.array([130e6, 150e6, 170e6])


def _cube(data: Float, unit: Any = "K", freq: Float = FREQ, pixel_arcmin: float = 0.5, **more: Any) -> StokesCube:
    from astropy import units as u

    return StokesCube(data, freq * u.Hz, pixel_arcmin * u.arcmin, unit, constants="data", **more)


def _gauss(shape: tuple[int, int], major: float, minor: float, angle: float, pixel_rad: float) -> Float:
    """A Gaussian of these full widths about the centre pixel, peak 1; x to the west, angle north through east."""
    ny, nx = shape
    north, east = pixel_rad * (np.arange(ny)[:, None] - ny // 2), -pixel_rad * (np.arange(nx) - nx // 2)
    along, across = north * np.cos(angle) + east * np.sin(angle), east * np.cos(angle) - north * np.sin(angle)
    return np.asarray(np.exp(-4 * np.log(2) * ((along / major) ** 2 + (across / minor) ** 2)))


@case(
    "K1",
    "cubes",
    "Jy/beam and Jy/pixel in kelvin",
    "1676 K for 3 arcmin, 68384 K for 0.5 arcmin at 150 MHz; 0 and NaN refused",
)
def kelvin(_: None) -> Answer:
    """c^2 / (2 k nu^2 Omega), and 1.222e6 / (nu_GHz^2 theta^2) for a beam in arcsec; there and back by a sky."""
    from astropy import units as u

    one = np.ones((3, 4, 6, 6))
    omega = np.pi / (4 * np.log(2)) * (3 * ARCMIN) * (2 * ARCMIN)
    per_jy = 1e-26 * 299792458.0**2 / (2 * 1.380649e-23 * FREQ**2)
    beam = _cube(one, "Jy/beam", psf=Psf.gaussian(3 * u.arcmin, 2 * u.arcmin)).to_kelvin().data[:, 0, 0, 0]
    round_ = _cube(one, "Jy/beam", psf=Psf.gaussian(3 * u.arcmin)).to_kelvin().data[1, 0, 0, 0]
    pixel = _cube(one, "Jy/pixel").to_kelvin()
    back = pixel.sky().stokes
    answers = [
        held(beam, per_jy / omega, 1e-13),
        held(pixel.data[:, 0, 0, 0], per_jy / (0.5 * ARCMIN) ** 2, 1e-13),
        held(round_, 1.222e6 / (0.15**2 * 180**2), 1e-3),
        held(pixel.data[1, 0, 0, 0], 68384, 1e-4),
        held(back, one, 1e-13),
        held(pixel.wcs.wcs.cdelt[3], 20e6, 1e-12),
    ]
    for width in (0.0, np.nan):
        try:
            _cube(one, "Jy/beam", psf=Psf.gaussian(width * u.arcmin)).to_kelvin()
            answers.append(claim(False, f"a beam of {width} has K"))
        except InputError:
            pass
    return both(*answers)


@case("K2", "cubes", "a PSF that is a Gaussian", "its widths and position angle, to 1e-6; cut at the edge: none")
def lobe(_: None) -> Answer:
    """7 x 4 pixels at 0.3, 1.2 and 2.9 rad, on 41 and 40 pixels; and 60 pixels wide."""
    answers = []
    for shape in ((41, 41), (40, 40)):
        angle = np.array([0.3, 1.2, 2.9])
        made = np.stack([_gauss(shape, 7 * ARCMIN, 4 * ARCMIN, a, ARCMIN) for a in angle])
        found = fit_psf(made, ARCMIN)
        answers += [
            held(found.major_rad, 7 * ARCMIN, 1e-6),
            held(found.minor_rad, 4 * ARCMIN, 1e-6),
            held(found.angle_rad, angle, 1e-6),
            held(found.residual, np.zeros(3), 1e-6, scale=1.0),
            held(found.solid_angle_sr, np.pi / (4 * np.log(2)) * 28 * ARCMIN**2, 1e-6),
        ]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        wide = fit_psf(_gauss((41, 41), 60 * ARCMIN, 50 * ARCMIN, 0.3, ARCMIN)[None], ARCMIN)
        fit_psf(_gauss((41, 41), 3 * ARCMIN, 2 * ARCMIN, 0.3, ARCMIN)[None], ARCMIN)
    words = " ".join(str(w.message) for w in said if issubclass(w.category, InstrumentWarning))
    return both(*answers, claim(np.isnan(wide.major_rad).all() and "main lobe" in words and "2 pixels" in words, words))


@case("K3", "cubes", "three beams made one", "Gaussians of the common beam, points of 1 Jy kept, to 1e-6")
def one_beam(_: None) -> Answer:
    """Beams at 10, 100 and 170 deg; a circle where none holds the others; a size asked for; NaN weighs nothing."""
    from astropy import units as u

    major, minor = np.array([5.0, 6, 4]) * u.arcmin, np.array([3.0, 3, 3.5]) * u.arcmin
    psf = Psf.gaussian(major, minor, np.deg2rad([10, 100, 170]) * u.rad)
    data = np.zeros((3, 4, 81, 81))
    for k in range(3):
        data[k, :] = _gauss((81, 81), psf.major_rad[k], psf.minor_rad[k], psf.angle_rad[k], 0.5 * ARCMIN)
    cube = _cube(data, "Jy/beam", psf=psf)
    circle, asked = cube.at_common_beam(), cube.at_common_beam("8 arcmin, 7 arcmin, 30 deg")
    nested = _cube(data[:1], "Jy/beam", FREQ[:1], psf=Psf.gaussian(5 * u.arcmin, 3 * u.arcmin, 10 * u.deg))
    inside = nested.at_common_beam()
    spoilt = data.copy()
    spoilt[:, :, 5, 6] = np.nan
    holed = _cube(spoilt, "Jy/beam", psf=psf).at_common_beam()
    flat = _cube(np.ones((3, 4, 30, 30)), "K", psf=psf).at_common_beam()
    round_ = _gauss((81, 81), 6 * ARCMIN, 6 * ARCMIN, 0, 0.5 * ARCMIN)
    wide = _gauss((81, 81), 8 * ARCMIN, 7 * ARCMIN, np.deg2rad(30), 0.5 * ARCMIN)
    seen = Psf(data[:, 0], psf.major_rad, psf.minor_rad, psf.angle_rad, np.zeros(3))
    lobes = cube.with_psf(seen).at_common_beam().psf
    assert lobes is not None and lobes.data is not None
    known = circle.psf, asked.psf
    assert known[0] is not None and known[1] is not None
    return both(
        held(lobes.data, np.broadcast_to(round_, lobes.data.shape), 2e-4),
        held(circle.data, np.broadcast_to(round_, data.shape), 2e-4),
        held(asked.data, np.broadcast_to(wide, data.shape), 2e-4),
        held(known[0].major_rad, 6 * ARCMIN, 1e-9),
        held(known[1].angle_rad, np.deg2rad(30), 1e-9),
        held(known[1].minor_rad, 7 * ARCMIN, 1e-9),
        held(inside.data, nested.data, 1e-12),
        held(flat.data, np.ones(1), 1e-9),
        claim(np.isnan(holed.data[:, :, 5, 6]).all() and np.isfinite(holed.data[:, :, 5, 7]).all(), "the hole moved"),
    )


@case(
    "K4",
    "cubes",
    "Faraday screens of an asked brightness",
    "largest |F| 5 K at 1.2 rad/m2; beam, spectrum, uv range kept",
)
def screens(_: None) -> Answer:
    """48 pixels of 4', 33 channels; without a ripple one screen is one field turned: it goes as nu^s e^(2i phi l2)."""
    from astropy import units as u

    freq = np.linspace(134, 166, 33) * u.MHz
    cube = polarized_screens(48, 4 * u.arcmin, freq, seed=1)
    x = (299792458.0 / cube.freq_hz) ** 2
    p = (cube.data[:, 1] + 1j * cube.data[:, 2]).reshape(33, -1).astype(complex)
    depths = np.arange(-3, 6, 0.01)
    f = np.abs(np.exp(-2j * np.outer(depths, x - x.mean())) @ p) / 33
    i, _k = np.unravel_index(int(f.argmax()), f.shape)
    one = polarized_screens(64, 4 * u.arcmin, freq, seed=2, screens=_alone())
    q = (one.data[:, 1] + 1j * one.data[:, 2]).astype(complex)
    law = (one.freq_hz / one.freq_hz[16]) ** -2.0 * np.exp(5j * (x - x[16]))
    due = np.exp(-0.5 * ((np.array(Screens().depths) - 1.2) / 1.0) ** 2) + 0.15
    fine = Screens(chromatic=True, fwhm=3 * u.arcmin).beam_rad(FREQ)
    return both(
        held(f.max(), 5.0, 2e-3),
        held(depths[i], 1.2, 0.02),
        held(q, q[16] * law[:, None, None], 2e-5),
        held(Screens().weights, due, 1e-14),
        held(fine, 3 * ARCMIN * 150e6 / FREQ, 1e-13),
        claim(not cube.data[:, [0, 3]].any(), "I or V"),
        held(np.sqrt((p[16].real ** 2).mean()) / 1.3, 1.0, 0.6),
    )


def _alone(**more: Any) -> Screens:
    """One screen at 2.5 rad/m2 behind a beam of 10 arcmin, without a ripple."""
    from astropy import units as u

    return Screens(
        depths=(2.5,),
        brightest=2.5,
        ripple=0.0,
        spectral_index=-2.0,
        fwhm=10 * u.arcmin,
        uv_range=(20.0, 300.0),
        **more,
    )


def _cells(cube: StokesCube, channel: int = 0) -> Float:
    return np.asarray(np.abs(np.fft.fft2(cube.data[channel, 1] + 1j * cube.data[channel, 2])) ** 2)


@case("K4b", "cubes", "the angular spectrum of a screen", "uv^-2.2 behind the beam, nothing beyond the uv range")
def angular(_: None) -> Answer:
    """Seven fields, three bins of baselines; a chromatic beam takes more at 134 than at 166 MHz."""
    from astropy import units as u

    freq = np.linspace(134, 166, 33) * u.MHz
    uv = np.hypot(*np.meshgrid(*[np.fft.fftfreq(64, 4 * ARCMIN)] * 2))
    bins = [(uv >= a) & (uv < b) for a, b in ((20, 60), (60, 120), (120, 200))]
    steep = np.where(uv > 0, uv, 1) ** -2.2
    model = steep * np.exp(-((np.pi * 10 * ARCMIN * uv) ** 2) / (2 * np.log(2)))
    rows = []
    for seed in range(3, 10):
        made = polarized_screens(64, 4 * u.arcmin, freq[:1], seed=seed, screens=_alone())
        ratio = _cells(made) / model / (made.data[0, 1:3] ** 2).mean()
        rows.append([ratio[b].mean() for b in bins])
    mean = np.mean(rows, axis=0)
    outside = _cells(made)[(uv < 19.9) | (uv > 300.1)].sum() / _cells(made).sum()
    wide = polarized_screens(64, 4 * u.arcmin, freq, seed=2, screens=_alone(chromatic=True))
    far, near = (uv > 120) & (uv < 200), (uv > 20) & (uv < 40)

    def lost(low: Float, high: Float) -> float:
        return float(low[far].sum() / high[far].sum() / (low[near].sum() / high[near].sum()))

    powers = [(np.pi * 10 * ARCMIN * 150e6 / nu) ** 2 / (2 * np.log(2)) for nu in (134e6, 166e6)]
    awaited = lost(*(np.exp(-s * uv**2) * steep for s in powers))
    return both(
        Answer(float(outside), 1e-9),
        claim(mean.max() / mean.min() < 1.3, f"spectrum off: {mean / mean[0]}"),
        held(lost(_cells(wide), _cells(wide, 32)) / awaited, 1.0, 0.3),
    )


@case("K5", "cubes", "a quadrupole that leaks", "I = f (r nu / r0 nu0)^2 (Q cos 2 chi + U sin 2 chi), to 1e-6")
def quadrupole(_: None) -> Answer:
    """chi from north through east; 20 x 31 pixels; at the radius and frequency given, and at their defaults."""
    from astropy import units as u

    rng = np.random.default_rng(3)
    data = rng.normal(size=(3, 4, 20, 31))
    cube = _cube(data)
    found = leaked(cube, 0.01, 4 * u.arcmin, 140 * u.MHz)
    north, east = 0.5 * (np.arange(20)[:, None] - 10), -0.5 * (np.arange(31) - 15)
    r, chi = np.hypot(north, east), np.arctan2(east, north)
    due = data[:, 0] + 0.01 * (r / 4 * FREQ[:, None, None] / 140e6) ** 2 * (
        data[:, 1] * np.cos(2 * chi) + data[:, 2] * np.sin(2 * chi)
    )
    usual = leaked(cube)
    far = 0.685 * 0.5 * 15
    plain = data[:, 0] + 0.003 * (r / far * FREQ[:, None, None] / 150e6) ** 2 * (
        data[:, 1] * np.cos(2 * chi) + data[:, 2] * np.sin(2 * chi)
    )
    return both(
        held(found.data[:, 0], due, 1e-6),
        held(usual.data[:, 0], plain, 1e-6),
        held(found.data[:, 1:], data[:, 1:], 0.0),
    )


@case(
    "K6",
    "cubes",
    "noise, white and of the shape of a PSF",
    "sigma in every channel to 4 sigma; covariance that of the PSF",
)
def noise(_: None) -> Answer:
    """64 x 65 pixels, 0.1, 0.2 and 0.3 K; neighbours are alike by the PSF between them; I, Q, U, V are not."""
    from astropy import units as u

    psf = Psf.gaussian(4 * u.arcmin, 2 * u.arcmin, 0.5 * u.rad)
    like = _cube(np.zeros((3, 4, 64, 65)), pixel_arcmin=1.0, psf=psf)
    sigma = np.array([0.1, 0.2, 0.3])
    white = noise_cube(like, sigma * u.K, seed=2).data
    shaped = noise_cube(like, sigma * u.K, psf_shaped=True, seed=3).data
    images = like.with_psf(
        Psf(
            np.stack([_gauss((64, 65), 4 * ARCMIN, 2 * ARCMIN, 0.5, ARCMIN)] * 3),
            *(np.repeat(x, 3) for x in (psf.major_rad, psf.minor_rad, psf.angle_rad, psf.residual)),
        )
    )
    made = noise_cube(images, sigma * u.K, psf_shaped=True, seed=3).data
    level = white.reshape(3, -1).std(axis=1) / sigma
    answers = [Answer(float(np.abs(level - 1).max()), 4 / np.sqrt(2 * 4 * 64 * 65))]
    for field in (shaped, made):
        x = field.astype(float) / sigma[:, None, None, None]
        answers.append(Answer(float(abs((x**2).mean() - 1)), 0.1))
        for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1), (2, 1)):
            alike = (x * np.roll(x, (-dy, -dx), axis=(2, 3))).mean() / (x**2).mean()
            due = _gauss((9, 9), 4 * ARCMIN, 2 * ARCMIN, 0.5, ARCMIN)[4 + dy, 4 + dx]
            answers.append(Answer(float(abs(alike - due)), 0.06))
        mixed = np.einsum("fayx,fbyx->ab", x, x) / x[:, 0].size
        answers.append(Answer(float(np.abs(mixed - np.diag(np.diagonal(mixed))).max()), 0.1))
    return both(*answers)


@case(
    "K7", "cubes", "a cube behind the beam of an array", "I + M_IQ Q + M_IU U + M_IV V by the Mueller matrix, to 1e-4"
)
def behind(_: None) -> Answer:
    """9 x 7 pixels of 20', stations without symmetry, two times: every pixel by `mueller`."""
    from astropy import units as u
    from astropy.coordinates import SkyCoord
    from astropy.time import Time

    from instrument.jones.chain import Chain
    from instrument.jones.parallactic import Parallactic

    rng = np.random.default_rng(4)
    data = rng.normal(size=(3, 4, 9, 7))
    cube = _cube(data, pixel_arcmin=20.0, centre=CENTRE)
    array = Composed(stations=small_array(2), terms=Chain(Slanted(), Parallactic()))
    when = Time(["2012-12-07T01:00:00", "2012-12-07T03:00:00"], scale="utc")
    found = leaked_through(cube, array, when)
    y, x = (a.ravel() for a in np.mgrid[0:9, 0:7])
    ra, dec = offset(CENTRE, -20 * ARCMIN * (x - 3), 20 * ARCMIN * (y - 4))
    m = array.mueller(SkyCoord(ra * u.rad, dec * u.rad), when, FREQ * u.Hz, CENTRE.skycoord).real.mean(axis=0)
    row = np.broadcast_to(m, (3, 63, 4, 4))[:, :, 0, 1:].reshape(3, 9, 7, 3)
    due = data[:, 0] + np.einsum("fyxk,fkyx->fyx", row, data[:, 1:])
    return both(held(found.data[:, 0], due, 1e-5), held(found.data[:, 1:], data[:, 1:], 0.0))


@case("E1", "cubes", "channels and rims of zeros (WSClean, CASA)", "no data: NaN, and said; lines that cross 0 stay")
def zeros(_: None) -> Answer:
    """Channel 2 and a rim of 3 pixels are 0, another channel is -999; one pixel is 0 by chance."""
    from astropy import units as u

    data = np.random.default_rng(5).normal(size=(12, 4, 20, 20)) + 0.1
    keep = data.copy()
    data[2] = 0
    data[:, :, :3] = 0
    data[4, 0] = -999
    data[1, 0, 10, 10] = keep[1, 0, 10, 10] = 0
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = StokesCube(data, np.linspace(140, 150, 12) * u.MHz, 1 * u.arcmin, "K").data
    words = " ".join(str(w.message) for w in said)
    blank = np.zeros(data.shape, bool)
    blank[2] = blank[:, :, :3] = blank[4, 0] = True
    few = np.zeros((3, 4, 20, 20))
    few[1] = keep[0]  # all but one channel flagged
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        alone = StokesCube(few, FREQ * u.Hz, 1 * u.arcmin, "K").data
    if not (np.isnan(alone[[0, 2]]).all() and np.array_equal(alone[1], few[1])):
        return claim(False, "two channels of three are 0, and count as data")
    right = np.isnan(found[blank]).all() and np.array_equal(found[~blank], keep[~blank])
    return claim(right and "no data" in words, f"blank {np.isnan(found).sum()} of {blank.sum()}; {words}")
