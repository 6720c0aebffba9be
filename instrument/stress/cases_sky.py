"""Cases of skies: generated ones and their numbers, lists joined and cut, images, catalogues of other programs."""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from instrument.observe.directions import LIGHT, lmn
from instrument.observe.sampling import Sampling
from instrument.precision import truth
from instrument.sky.base import power
from instrument.sky.image import ImageSky
from instrument.sky.mocks import FaradaySky, GridSky, MockField, RandomSky
from instrument.sky.points import PointSky
from instrument.stress.bench import points, still
from instrument.stress.case import Answer, both, case, claim, held
from instrument.units import Direction, Float, unit_vectors

CENTRE = Direction(2.15, 0.84)


def _kolmogorov(values: Float, share: Float) -> Answer:
    """The largest step between drawn values and their distribution `share` (at the sorted values), times root n."""
    n = len(values)
    most = max(np.abs(share - np.arange(n) / n).max(), np.abs(share - np.arange(1, n + 1) / n).max())
    return Answer(float(most * np.sqrt(n)), 1.95, graded=False)  # one draw in 1000 is further off


def _from_centre(sky: PointSky) -> Float:
    return np.asarray(2 * np.arcsin(np.linalg.norm(sky.vectors - CENTRE.vector, axis=1) / 2))


@case("S1", "sky", "a grid of sources, even and odd", "l, m = k spacing; fluxes, polarization, spectrum, to 1e-14")
def grid(_: None) -> Answer:
    """3 x 5 with a centre, and 2 x 4 about nothing."""
    from astropy import units as u

    odd = GridSky(
        shape=(3, 5),
        spacing=0.02 * u.rad,
        flux=2 * u.Jy,
        centre_flux=9 * u.Jy,
        spectral_index=-0.7,
        polarization=(0.1, -0.2, 0.05),
        frequency=140 * u.MHz,
    ).about(CENTRE)
    even = GridSky(shape=(2, 4), spacing=0.02 * u.rad, flux=2 * u.Jy).about(CENTRE)
    answers = []
    for sky, l, m in ((odd, [-1, 0, 1], [-2, -1, 0, 1, 2]), (even, [-0.5, 0.5], [-1.5, -0.5, 0.5, 1.5])):
        due = 0.02 * np.array([(x, y) for y in m for x in l])
        answers.append(held(lmn(sky.vectors, CENTRE)[:, :2], due, 1e-14, scale=1.0))
    flux = np.full(15, 2.0)
    flux[7] = 9
    due = np.multiply.outer(flux * (70 / 140) ** -0.7, [1, 0.1, -0.2, 0.05])
    return both(
        *answers,
        held(odd.stokes(np.array([70e6]))[0], due, 1e-14),
        held(even.stokes(np.array([70e6]))[0], np.multiply.outer(np.full(8, 2.0), [1, 0, 0, 0]), 0.0),
    )


@case("S2", "sky", "4000 random sources", "fluxes, places, angles, indices: their distributions, to one draw in 1000")
def random_sources(_: None) -> Answer:
    """dN/dS ~ S^-1.9 between 0.1 and 50 Jy over a cap of 20 deg; and a slope of exactly 1."""
    from astropy import units as u

    how = {"count": 4000, "radius": 20 * u.deg, "flux_min": 0.1 * u.Jy, "flux_max": 50 * u.Jy}
    sky = RandomSky(**how, polarization=0.3, circular=0.1, scatter=0.2, seed=4).about(CENTRE)
    flat = RandomSky(**how, slope=1.0, seed=5).about(CENTRE)
    s, t = (np.sort(x.stokes_jy[:, 0]) for x in (sky, flat))
    angle = np.sort(_from_centre(sky))
    east, north = lmn(sky.vectors, CENTRE)[:, :2].T
    around = np.sort(np.arctan2(east, north) % (2 * np.pi))
    q, u_, v = (sky.stokes_jy[:, 1:] / sky.stokes_jy[:, :1]).T
    turn = np.sort(np.angle(q + 1j * u_) % (2 * np.pi))
    index = np.sort(np.asarray(sky.spectral_terms)[:, 0])
    from math import erf

    normal = np.array([0.5 + 0.5 * erf((x + 0.75) / 0.2 / np.sqrt(2)) for x in index])
    return both(
        _kolmogorov(s, (0.1**-0.9 - s**-0.9) / (0.1**-0.9 - 50**-0.9)),
        _kolmogorov(t, np.log(t / 0.1) / np.log(500)),
        _kolmogorov(angle, (1 - np.cos(angle)) / (1 - np.cos(np.deg2rad(20)))),
        _kolmogorov(around, around / (2 * np.pi)),
        _kolmogorov(turn, turn / (2 * np.pi)),
        _kolmogorov(np.sort(v), (np.sort(v) + 0.1) / 0.2),
        _kolmogorov(index, normal),
        held(np.hypot(q, u_), 0.3, 1e-13),
        claim(np.abs(v).max() <= 0.1, "more circular than asked for"),
    )


@case("S2b", "sky", "random sources of a seed, drawn again", "those of numpy's generator in the order stated, to 1e-12")
def redrawn(_: None) -> Answer:
    """50 sources: distances by their share of the cap, fluxes by that of the number above them."""
    from astropy import units as u

    sky = RandomSky(count=50, radius=10 * u.deg, flux_min=0.1 * u.Jy, flux_max=50 * u.Jy, slope=1.9, polarization=0.3,
                    circular=0.1, scatter=0.2, seed=11).about(CENTRE)  # fmt: skip
    rng = np.random.default_rng(11)
    far, around, share, turn = (rng.random(50) for _ in range(4))
    v, index = rng.uniform(-1, 1, 50), rng.standard_normal(50)
    angle = np.arccos(1 - far * (1 - np.cos(np.deg2rad(10))))
    flux = (50**-0.9 + share * (0.1**-0.9 - 50**-0.9)) ** (-1 / 0.9)
    east, north = np.sin(angle) * np.sin(2 * np.pi * around), np.sin(angle) * np.cos(2 * np.pi * around)
    p = 0.3 * np.exp(2j * np.pi * turn)
    due = flux[:, None] * np.stack([np.ones(50), p.real, p.imag, 0.1 * v], axis=1)
    return both(
        held(sky.stokes_jy, due, 1e-12),
        held(lmn(sky.vectors, CENTRE)[:, :2], np.stack([east, north], axis=1), 1e-12, scale=1.0),
        held(np.asarray(sky.spectral_terms)[:, 0], -0.75 + 0.2 * index, 1e-12),
    )


@case("S3", "sky", "polarized points at Faraday depths", "I = V = 0, P as asked, depths even between their ends")
def screens(_: None) -> Answer:
    """2000 points of 2 Jy, -1.5 to 5 rad/m2, index -1: P at half the frequency is twice as large and turned."""
    from astropy import units as u

    sky = FaradaySky(count=2000, flux=2 * u.Jy, spectral_index=-1.0, seed=3).about(CENTRE)
    depth = np.asarray(sky.rotation_measure)
    p, half = (x[:, 1] + 1j * x[:, 2] for x in sky.stokes(np.array([150e6, 75e6])))
    turn = np.exp(2j * depth * ((LIGHT / 75e6) ** 2 - (LIGHT / 150e6) ** 2))
    at = np.sort(np.angle(p) % (2 * np.pi))
    return both(
        held(np.abs(p), 2.0, 1e-13),
        held(half, 2 * p * turn, 1e-11),
        claim(not sky.stokes_jy[:, [0, 3]].any(), "I or V"),
        _kolmogorov(np.sort(depth), (np.sort(depth) + 1.5) / 6.5),
        _kolmogorov(at, at / (2 * np.pi)),
        _kolmogorov(np.sort(_from_centre(sky)), (1 - np.cos(np.sort(_from_centre(sky)))) / (1 - np.cos(np.deg2rad(2)))),
    )


@case("S4", "sky", "the mock of the 3C196 field", "4567 sources, 796.64 Jy to 1e-9, 0.027 to 83.1326 Jy, within 5 deg")
def mock(_: None) -> Answer:
    """Slope -2.5 above 1.5 Jy: the number above S goes as S^-1.5 less its end; pairs lie 5 to 40 arcsec apart."""
    sky = MockField().about(CENTRE)
    flux = sky.stokes_jy[:, 0]
    field = Direction(float(np.deg2rad(123.4)), float(np.deg2rad(48.2175)))
    far = 2 * np.arcsin(np.linalg.norm(sky.vectors - field.vector, axis=1) / 2)
    bright = np.sort(flux[(flux > 1.5) & (flux < 7.7)])
    share = (1.5**-1.5 - bright**-1.5) / (1.5**-1.5 - 7.7**-1.5)
    faint = flux[flux < 1.5]
    slope = 1 - np.polyfit(np.log(faint[20:-20]), np.log(np.arange(20, len(faint) - 20)), 2)[1]
    pairs = MockField(pairs=0.3).about(CENTRE)
    from scipy.spatial import KDTree

    apart = KDTree(pairs.vectors).query(pairs.vectors, k=2)[0][:, 1] * 180 / np.pi * 3600
    near = (apart < 40.001).mean()
    least = apart[400:].min()
    rings = np.sort(far[336:])
    return both(
        held(flux.sum(), 796.64, 1e-9),
        held(flux[[0, 1, -1]], [83.1326, 7.7, 0.027], 1e-12),
        claim(
            len(sky) == 4567 and far.max() <= np.deg2rad(5) * (1 + 1e-9), f"{len(sky)} sources to {far.max():.4f} rad"
        ),
        claim(
            0.005 < len(bright) / 4565 < 0.05 and 1.0 < slope < 3.0, f"{len(bright)} above 1.5 Jy, slope {slope:.2f}"
        ),
        _kolmogorov(bright, share),
        _kolmogorov(rings, (1 - np.cos(rings)) / (1 - np.cos(np.deg2rad(5)))),
        claim(0.3 < near < 0.7 and least < 8, f"{near:.2f} have a neighbour within 40 arcsec, the nearest {least:.1f}"),
        claim((np.diff(flux) <= 0).all(), "not in the order of their fluxes"),
    )


@case("S5", "sky", "lists joined, cut, and totalled", "no flux is lost: to 1e-15; F4: |I| + P of 1e155 Jy is finite")
def lists(_: None) -> Answer:
    """One with a spectrum, one without; their parts; the middle of equal sources; the largest total of all channels."""
    one = points(
        [0.1, 0.3],
        [0.2, 0.0],
        [[2, 1, 0, 0], [-1, 0, 0.5, 0.5]],
        reference_hz=[1e8, 2e8],
        spectral_terms=[[-0.7, 0.1], [0.3, 0.0]],
        rotation_measure=[3.0, 0.0],
    )
    two = points([0.5], [0.1], [[1, 0, 0, 0.25]], major_rad=[1e-3], minor_rad=[5e-4], angle_rad=[0.2])
    whole, freq = PointSky.join(one, two), np.array([1e8, 1.7e8])
    due = np.concatenate([one.stokes(freq), two.stokes(freq)], axis=1)
    cut = np.concatenate([p.stokes(freq) for p in whole.parts(2, freq)], axis=1)
    at = still([[0, 0, 0], [300, 100, 0]], freq, *whole.directions())
    waves = (
        at.uvw_m[:, None, :1] * (freq / LIGHT)[:, None, None] - at.uvw_m[:, None, 1:] * (freq / LIGHT)[:, None, None]
    )
    shape = np.asarray(whole.envelope(at, waves))
    sizes = whole.with_fields(major_rad=np.array([0, 0, 1e-3]))
    exact = truth.envelope(sizes, at, truth.real(waves))
    total = (np.abs(due[..., 0]) + np.sqrt((due[..., 1:] ** 2).sum(axis=-1))).sum(axis=1)
    even = points([0.2, 0.4], 0.0, [[1, 0, 0, 0], [-1, 0, 0, 0]]).middle
    return both(
        held(whole.stokes(freq), due, 1e-15),
        held(cut, due, 1e-15),
        held(whole.select([2, 0]).stokes(freq), due[:, [2, 0]], 0),
        held(shape, exact.astype(float), 1e-13),
        held(whole.total_jy(freq), total, 1e-14),
        held(power(np.array([3e154, 4e155, 3e155, 0])), 3e154 + 5e155, 1e-14),
        held([even.ra_rad, even.dec_rad], [0.3, 0.0], 1e-14, scale=1.0),
        held(whole.distance_rad(Direction(0.5, 0.1))[2], 0.0, 1e-15, scale=1.0),
        claim(two.nonzero(freq) == (True, False, False, True), f"what is zero: {two.nonzero(freq)}"),
    )


@case("S6", "sky", "an image as a sky", "its pixels, its cells and their flux, to 1e-13; no other frequency is taken")
def image(_: None) -> Answer:
    """80 x 70 pixels, cells of 2 or 3: the outline covers all, and every pixel that is not zero stands in its cell."""
    from astropy import units as u

    from instrument.observe.grid import ImageGrid

    rng = np.random.default_rng(2)
    stokes = rng.normal(size=(2, 4, 80, 70)) * (rng.random((80, 70)) < 0.2)
    grid = ImageGrid(pixels=(80, 70), pixel=2 * u.arcmin, centre=CENTRE)
    sky = ImageSky(grid=grid, stokes=stokes, frequencies=[150, 151] * u.MHz)
    freq = np.array([151e6, 150e6])
    flux = power(np.moveaxis(stokes[::-1], 1, -1)).sum(axis=(1, 2))
    cells = sky.cells_jy(freq)
    rows, cell = sky.pixels_of(np.arange(cells.shape[1]))
    whole = power(np.moveaxis(stokes[::-1].reshape(2, 4, -1), 1, -1))
    by_cell = np.stack([np.bincount(cell, w[rows], cells.shape[1]) for w in whole])
    middles, all_of_them = unit_vectors(*sky.outline()), unit_vectors(*grid.directions())
    apart = 2 * np.arcsin(np.linalg.norm(middles[cell] - all_of_them[rows], axis=1) / 2)
    own = [
        x.brightness(Sampling.block(still([[0, 0, 0]], freq), slice(None), slice(None))) for x in sky.parts(500, freq)
    ]
    bright = np.concatenate(own, axis=2)[0]
    i, q, u_, v = np.moveaxis(stokes[::-1].reshape(2, 4, -1)[:, :, sky.used], 1, 0)
    due = np.stack([np.stack([i + q, u_ + 1j * v], -1), np.stack([u_ - 1j * v, i - q], -1)], -2)
    kelvin_free = sky.planes(freq)
    return both(
        held(sky.total_jy(freq), flux, 1e-13),
        held(by_cell, cells, 1e-12),
        held(bright, due, 0.0),
        held(kelvin_free, stokes[::-1], 0.0),
        claim(len(rows) == sky.count == (stokes[0, 0] != 0).sum(), "pixels lost"),
        claim(apart.max() <= sky.reach_rad * (1 + 1e-9) < 2 * apart.max(), f"reach {sky.reach_rad}, {apart.max()}"),
    )


def _read(text: str, name: str = "x.csv", **how: Any) -> tuple[PointSky, str]:
    """A catalogue of so many words read back, and what was warned of."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        path = Path(folder) / name
        path.write_text(text, encoding="utf-8")
        sky = PointSky.read(path, **how)
    return sky, " ".join(str(w.message) for w in said)


@case("A1", "sky", "a table of fitted and of true sizes", "a point: DC_Maj = 0 counts, not Maj = 120 arcsec")
def deconvolved(_: None) -> Answer:
    """What PyBDSF writes (LoTSS): the fitted size holds the beam."""
    text = (
        "Source_Name,RA,E_RA,DEC,E_DEC,Peak_flux,Total_flux,Maj,Min,DC_Maj,DC_Min,PA,DC_PA,Isl_rms,S_Code,Mosaic_ID\n"
        "ILTJ1,10,0.2,50,0.2,5,1500,7,6.5,3.6,2.5,30,31,0.1,S,P1\nILTJ2,11,0.2,50,0.2,5,3,6,6,0,0,30,30,0.1,S,P1\n"
    )
    sky, _said = _read(text)
    arcsec = np.pi / 180 / 3600
    found = [np.asarray(x)[0] for x in (sky.major_rad, sky.minor_rad, sky.angle_rad)]
    return both(
        claim(sky.gaussian.tolist() == [True, False], "a Gaussian of the size of the beam"),
        held(found, [3.6 * arcsec, 2.5 * arcsec, np.deg2rad(31)], 1e-12),
        held(sky.stokes_jy[:, 0], [1.5, 0.003], 1e-12),
    )


@case("A2", "sky", "a table with ref_freq_mhz and alpha", "1.741 Jy at 75 MHz, and 0.574 at 300")
def alpha(_: None) -> Answer:
    """S = (nu / 150 MHz)^-0.8."""
    sky, _said = _read("ra_deg,dec_deg,i_jy,ref_freq_mhz,alpha\n123.4,48.2,1,150,-0.8\n")
    return both(
        held(sky.stokes(np.array([75e6, 300e6]))[:, 0, 0], [2**0.8, 2**-0.8], 1e-13),
        held([sky.ra_rad[0], sky.dec_rad[0]], np.deg2rad([123.4, 48.2]), 1e-15),
    )


@case("A4", "sky", "BBS: one name in two patches, seconds 60.0", "read: two sources, where they are")
def bbs(_: None) -> Answer:
    """What LSMTool and LINC write."""
    text = (
        "FORMAT = Name, Type, Patch, Ra, Dec, I, ReferenceFrequency='150e6', SpectralIndex='[]'\n"
        ", , p1, 08:00:00.0, 48.00.00.0\n, , p2, 08:10:00.0, 48.00.00.0\n"
        "s0, POINT, p1, 08:00:00.0, 48.30.00.0, 1.0, 150e6, [-0.8]\n"
        "s0, POINT, p2, 08:09:60.0, 48.00.00.0, 2.0, 150e6, [0.0]\n"
    )
    sky, _said = _read(text, "x.skymodel", centre=Direction(2.1, 0.84).skycoord)
    return both(
        claim(len(set(sky.names)) == 2, f"{sky.names}"),
        held(np.rad2deg(sky.ra_rad), [120.0, 122.5], 1e-12),
        held(np.rad2deg(sky.dec_rad), [48.5, 48.0], 1e-12),
        held(sky.stokes(np.array([75e6]))[0, :, 0], [2**0.8, 2.0], 1e-12),
    )


@case("A5", "sky", "a linear spectrum taken from 58 to 144 MHz", "-1.2 Jy, and the plan says negative and extrapolated")
def negative(_: None) -> Answer:
    """1 - 1.5 (144/58 - 1) Jy."""
    sky = points([0.1], 0.0, [1, 0, 0, 0], reference_hz=[58e6], spectral_terms=[[-1.5]], logarithmic=[False])
    words = " ".join(f"{k} {v}" for k, v in sky.doubts(np.array([144e6])).items())
    return both(
        held(sky.stokes(np.array([144e6]))[0, 0, 0], 1 - 1.5 * (144 / 58 - 1), 1e-14),
        claim("negative" in words, f"said: {words}", words),
    )


@case("A1b", "sky", "sizes that are upper limits (NVSS)", "points")
def limits(_: None) -> Answer:
    """'<' before a size is no size."""
    text = (
        "#Column NVSS\nNVSS\tRAJ2000\tDEJ2000\tS1.4\tl_MajAxis\tMajAxis\tl_MinAxis\tMinAxis\tPA\n"
        '\t"h:m:s"\t"d:m:s"\tmJy\t\tarcsec\t\tarcsec\tdeg\n'
        "-\t-\t-\t-\t-\t-\t-\t-\t-\n"
        "081336+481303\t08 13 36.05\t+48 13 02.9\t13900.1\t<\t14.0\t<\t13.2\t \n"
        "081400-001500\t08 14 00.00\t-00 15 00.0\t50\t \t40.0\t<\t20.0\t-30\n"
    )
    nvss, _said = _read(text, "nvss.tsv")
    arcsec = np.pi / 180 / 3600
    return both(
        held(np.asarray(nvss.major_rad) / arcsec, [0, 40], 1e-12),
        held(np.asarray(nvss.minor_rad), [0, 0], 0.0, scale=1.0),
        held([nvss.stokes_jy[0, 0], nvss.stokes_jy[1, 0]], [13.9001, 0.05], 1e-12),
    )


@case("A1c", "sky", "a table of three sources with spectral indices", "S (f / f0)^a at another frequency, nothing said")
def indices(_: None) -> Answer:
    """Indices of -0.7, -0.8 and 0; an inverted median is said, another is not."""
    text = "name,ra_deg,dec_deg,i_jy,ref_freq_mhz,alpha\n" + "".join(
        f"s{k},{123 + k},48,{k + 1},150,{a}\n" for k, a in enumerate((-0.7, -0.8, 0.0))
    )
    sky, said = _read(text, "three.csv")
    _other, inverted = _read(text.replace("-0.", "0."), "inverted.csv")
    due = np.array([1, 2, 3]) * (120 / 150) ** np.array([-0.7, -0.8, 0.0])
    told = "most spectral indices are positive" in inverted and "positive" not in said
    return both(held(sky.stokes(np.array([120e6]))[0, :, 0], due, 1e-14), claim(told, f"said '{said}', '{inverted}'"))
