"""Cases held to extended precision: chains, skies, elements, telescopes, entry by entry from their formulas."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from instrument import mat2
from instrument.jones.base import ElementBeam, JonesTerm
from instrument.jones.chain import Chain
from instrument.jones.feed import FeedTerm
from instrument.jones.gain import GainTerm
from instrument.jones.parallactic import Parallactic
from instrument.jones.station import ArrayFactor, Level, StationBeam
from instrument.model import Instrument
from instrument.observe.layout import Layout
from instrument.observe.sampling import Sampling
from instrument.precision import truth
from instrument.predict.base import EVERY, Predictor, Problem
from instrument.sky.points import PointSky
from instrument.stress.bench import claimed, ready, small_array, towards
from instrument.stress.case import Answer, Unfit, both, case, claim, held
from instrument.units import Complex, Direction

CENTRE = Direction(2.15, 0.84)


class Slanted(ElementBeam):
    """An antenna without any symmetry, complex (T, 1, A, S, 2, 2), and the same in extended precision."""

    def peak(self, at: Sampling) -> float:
        """2: entries of at most 1.3."""
        return 2.0

    def jump(self, at: Sampling) -> float:
        """8: its matrix turns with the azimuth."""
        return 8.0

    def jones(self, at: Sampling) -> Complex:
        """Entries that differ in amplitude and phase."""
        cos, sin = at.azimuth_cos_sin
        up = np.maximum(np.cos(at.zenith_angle), 0.0)
        rows = (cos + 0.25j * sin, -sin, (1 + 0.125j) * sin + 0.25, cos - 0.25j)
        return mat2.pack(*(up * x for x in rows))[:, None]

    def truth(self, at: Sampling, g: Any) -> Any:
        """The same from the geometry of `precision.truth`."""
        cos, sin = g.azimuth
        up = np.maximum(np.cos(g.zenith), 0)
        rows = (cos + sin / 4 * truth.I, -sin, (1 + truth.I / 8) * sin + 0.25, cos - truth.I / 4)
        return truth.matrix(*(up * x for x in rows))[:, None]


def _sky(shaped: bool, count: int = 7) -> PointSky:
    """Sources within 8 deg: negative and polarized beyond I, spectra of both kinds, rotation measures, shapes."""
    rng = np.random.default_rng(5)
    more: dict[str, Any] = {}
    if shaped:
        major = np.where(np.arange(count) % 2, 3e-3 * rng.random(count), 0.0)
        more = {"major_rad": major, "minor_rad": major * 0.4, "angle_rad": rng.uniform(0, 3, count)}
    return PointSky(
        names=tuple(f"s{k}" for k in range(count)),
        ra_rad=CENTRE.ra_rad + 0.2 * rng.uniform(-1, 1, count),
        dec_rad=CENTRE.dec_rad + 0.14 * rng.uniform(-1, 1, count),
        stokes_jy=rng.normal(size=(count, 4)) * rng.uniform(0.5, 5, (count, 1)),
        reference_hz=rng.uniform(100e6, 200e6, count),
        spectral_terms=rng.normal(size=(count, 3)) * 0.7,
        logarithmic=np.arange(count) % 3 > 0,
        polarization_follows_i=np.arange(count) % 2 > 0,
        rotation_measure=rng.uniform(-30, 30, count),
        **more,
    )


def _turned(layout: Layout, kinds: int) -> Layout:
    """Stations whose p and q are turned by one of so many angles."""
    angle = 0.4 * (np.arange(len(layout)) % kinds)
    cos, sin, zero, one = np.cos(angle), np.sin(angle), 0 * angle, 0 * angle + 1
    turn = np.stack([cos, sin, zero, -sin, cos, zero, zero, zero, one], axis=1).reshape(-1, 3, 3)
    return layout.with_fields(axes=turn @ layout.axes)


def _given(sky: PointSky, *terms: JonesTerm, kinds: int = 2) -> Problem:
    """Eight stations, two times, three channels."""
    from astropy.time import Time

    layout = _turned(small_array(8, spread=300.0), kinds)
    times = Time(["2012-12-07T01:00:00", "2012-12-07T04:30:00"], scale="utc")
    at = Sampling.build(layout, times, np.array([120e6, 151e6, 188e6]), *sky.directions(), CENTRE)
    a, b = layout.baselines
    return Problem(at, Chain(*terms), sky, a, b, interval_s=10.0, width_hz=1e5)


def _station() -> StationBeam:
    rng = np.random.default_rng(6)
    tiles, dipoles = rng.normal(size=(8, 3, 3)) * 12, rng.normal(size=(1, 4, 3)) * 2
    tiles[3:] = tiles[3]
    levels = (Level(offsets_m=tiles), Level(offsets_m=dipoles, pointing=Direction(2.18, 0.86)))
    return StationBeam(element=Slanted(), levels=levels)


RECEIVERS = (GainTerm(rms=0.3, seed=3), FeedTerm(rms=0.2, seed=4))


@cache
def _chains() -> list[tuple[Problem, Complex]]:
    """Problems and their sums in extended precision, which take longest."""
    station, points, shaped = _station(), _sky(False), _sky(True)
    plain = points.with_fields(stokes_jy=points.stokes_jy * [1, 0, 0, 0])
    given = (
        _given(points, *RECEIVERS, station, Parallactic()),
        _given(shaped, *RECEIVERS, station, Parallactic(), kinds=8),
        _given(shaped, RECEIVERS[0], kinds=1),
        _given(points, ArrayFactor(levels=station.levels), kinds=1),
        _given(plain, ArrayFactor(levels=station.levels, phase="everybeam"), kinds=1),
        _given(plain.with_fields(polarization_follows_i=None)),
    )
    return [(one, truth.visibilities(one).astype(complex)) for one in given]


@case("X1", "engines", "chains and skies of every kind", "the sums in extended precision, to 1e-11 of the flux")
def chains(engine: Predictor) -> Answer:
    """Phased stations of one, two and eight frames; receivers alone; an array factor alone; no term at all."""
    answers = []
    for given, due in _chains():
        found, claims = claimed(engine, given)
        scale = float(np.abs(due).max())
        answers.append(held(found, due, 1e-11 + claims / scale, scale=scale))
    return both(*answers)


@case("X2", "engines", "an image of pixels", "the sums of its pixels as points, to 1e-11, or to the bound given")
def pixels(engine: Predictor) -> Answer:
    """5 x 4 pixels in 3 channels, through phased stations."""
    from astropy import units as u

    from instrument.observe.grid import ImageGrid
    from instrument.sky.image import ImageSky

    stokes = np.random.default_rng(8).normal(size=(3, 4, 5, 4))
    freq = np.array([120e6, 151e6, 188e6])
    image = ImageSky(
        grid=ImageGrid(pixels=(5, 4), pixel=0.02 * u.rad, centre=CENTRE), stokes=stokes, frequencies=freq * u.Hz
    )
    ra, dec = image.directions()
    flat = np.moveaxis(stokes.reshape(3, 4, 20), 1, -1)
    names = tuple(map(str, range(20)))
    whole = PointSky(names=names, ra_rad=ra, dec_rad=dec, stokes_jy=flat[0])
    given = _given(whole, *RECEIVERS, _station(), Parallactic())
    given = replace(given, sky=image, at=given.at.towards(*image.outline()))
    prepared = ready(engine, given)
    found = prepared.sums(EVERY, EVERY)
    flux = float(image.total_jy(freq).max())
    # where pixels stand: x runs to the west, the centre is pixel (2, 2)
    x, y = np.meshgrid(-0.02 * (np.arange(4) - 2), 0.02 * (np.arange(5) - 2))
    g = truth.geometry(given.at.towards(ra, dec))
    answers = [held(np.asarray(g.lmn[:, :2], float), np.stack([x.ravel(), y.ravel()], axis=1), 1e-13, scale=1.0)]
    for f in range(3):
        sky = whole.with_fields(stokes_jy=flat[f])
        one = replace(_given(sky, *RECEIVERS, _station(), Parallactic()))
        due = truth.visibilities(one.block(slice(None), slice(f, f + 1))).astype(complex)
        limit = 1e-11 + prepared.bound * flux / np.abs(due).max()
        answers.append(held(found[:, f : f + 1], due, limit))
    return both(*answers)


def _known(term: Any) -> None:
    """Raise `Unfit` for a term whose formula does not stand in `precision.truth`, and that brings no `truth`."""
    for part in (term, *(getattr(term, n) for n in type(term).model_fields if n == "element")):
        if not hasattr(part, "truth") and type(part).__name__ not in truth.TERMS:
            raise Unfit(f"{type(part).__name__} brings no `truth(at, geometry)`")


@case("18b", "elements", "about the zenith, aside, at the horizon", "its formula in extended precision, to 1e-12")
def formula(element: ElementBeam) -> Answer:
    """1e-13 rad from the zenith from 8 azimuths, and 12 directions of all heights, at four frequencies."""
    _known(element)
    low, high = element.band_hz()
    high = high if np.isfinite(high) else max(2 * low, 250e6)
    freq = low + (high - low) * np.array([0.2, 0.5, 0.7, 0.95])
    rng = np.random.default_rng(3)
    angle = np.concatenate([np.full(8, 1e-13), rng.uniform(0, 1.6, 12)])
    azimuth = np.concatenate([np.arange(8) * np.pi / 4, rng.uniform(0, 2 * np.pi, 12)])
    at = towards(freq, angle, azimuth)
    due = truth.of_term(element, at, truth.geometry(at)).astype(complex)
    found = np.broadcast_to(element.jones(at), due.shape)
    return held(found, due, 1e-12)


@case("X3", "telescopes", "the whole chain of some stations", "its terms in extended precision, to 1e-10")
def whole_chain(telescope: Instrument) -> Answer:
    """Four directions within 20 deg of the zenith and one below the horizon, six hours apart."""
    from astropy import units as u

    from instrument.stress.cases_beam import sight

    when: Any
    centre: Any
    when, centre, freq = sight(telescope)
    away = centre.directional_offset_by([0, 30, 140, 250, 10] * u.deg, [0, 2, 9, 20, 120] * u.deg)
    at = telescope.sampling(away, when, [freq, 1.1 * freq] * u.Hz, centre)
    chain = telescope.chain()
    g = truth.geometry(at)
    due = truth.matrix(1, 0, 0, 1)
    for term in chain.terms:
        _known(term)
        one = truth.of_term(term, at, g)
        due = truth.product(due, one.conj() if isinstance(term, ElementBeam) else one)
    found = telescope.beam(away, when, [freq, 1.1 * freq] * u.Hz, centre)
    return held(found, np.broadcast_to(due, found.shape).astype(complex), 1e-10)


@case(
    "X4",
    "telescopes",
    "where the parts of phased stations stand",
    "about their centre, in the plane, not upon each other",
)
def parts(telescope: Instrument) -> Answer:
    """Sums over all levels: no two nearer than within one; a lattice that stands for a survey is within 5 cm of it."""
    from scipy.spatial import KDTree

    stations = [t for t in telescope.chain().terms if isinstance(t, StationBeam) and t.levels]
    if not stations:
        raise Unfit("its stations are not phased")
    layout, answers = telescope.layout(), []
    offsets = [np.asarray(level.offsets_m) for level in stations[0].levels]
    for each in offsets:
        extent = np.sqrt((each**2).sum(axis=2).mean(axis=1))
        up = np.abs(np.einsum("amc,ac->am", each, np.broadcast_to(layout.axes[:, 2], (len(each), 3)))).max(axis=1)
        middle = np.linalg.norm(each.mean(axis=1), axis=1)
        answers.append(claim(bool((middle < 0.2 * extent).all()), f"centred to {(middle / extent).max():.2g}"))
        answers.append(claim(bool((up < 0.02 * extent + 0.3).all()), f"up to {up.max():.2g} m above the plane"))
    for a in range(0, len(layout), 7):
        whole, least = np.zeros((1, 3)), np.inf
        for each in offsets:
            mine = each[a if len(each) > 1 else 0]
            least = min(least, float(KDTree(mine).query(mine, k=2)[0][:, 1].min()))
            whole = (whole[:, None] + mine).reshape(-1, 3)
        apart = float(KDTree(whole).query(whole, k=2)[0][:, 1].min())
        answers.append(
            claim(apart > 0.95 * least, f"{layout.names[a]}: parts {apart:.2g} m apart, within one {least:.2g}")
        )
    if {"tiles", "tile_offsets"} <= set(dir(type(telescope))) | set(type(telescope).model_fields):
        made: Any = telescope.with_fields(tiles="ideal")
        lattice = np.asarray(made.chain().terms[-2].levels[0].offsets_m)
        # the survey lists tiles row by row, as the lattice does
        answers.append(Answer(float(np.abs(lattice - offsets[0]).max()), 0.05, graded=False))
    return both(*answers)
