"""Extreme input is answered right, held to closed forms, exact arithmetic or `direct`; or it is refused in one line."""

import warnings
from decimal import Decimal, getcontext

import erfa
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.time import Time
from instrument_plugins.elements.dipole import CrossedDipole
from instrument_plugins.elements.hamaker import Hamaker

import instrument
from instrument import (
    Analyzer,
    Chain,
    Composed,
    GainTerm,
    Imager,
    InputError,
    InstrumentWarning,
    Layout,
    Observation,
    Parallactic,
    PointSky,
    Sampling,
    Scene,
    mueller,
)
from instrument.analyze.sources.photometry import ForcedPhotometry
from instrument.cli import main
from instrument.errors import InstrumentError, Outcome
from instrument.jones.towards import Towards
from instrument.observe.directions import LIGHT, earth_frame, lmn, offset
from instrument.predict.direct import Direct
from instrument.predict.matrix import Matrix
from instrument.units import Direction, unit_vectors

CENTRE = Direction(2.15, 0.84)
STATIONS = ["CS001HBA0", "CS002HBA1", "CS302HBA0", "RS106HBA", "RS406HBA", "RS508HBA"]


def lofar(band="hba", stations=None, **settings):
    return instrument.load("telescopes", f"lofar-{band}", stations=stations or STATIONS, **settings)


def equator(count=4, terms=None):
    """Dipoles on the equator at longitude 0: its zenith sets, 6 h after it culminates."""
    enu = np.array([[0, 0, 0], [60, 10, 0], [-20, 90, 1], [130, -70, 0], [40, 300, 2]])[:count]
    layout = Layout.from_enu(list("abcde")[:count], enu * u.m, 0 * u.rad, 0 * u.rad, 0 * u.m)
    return Composed(stations=layout, terms=terms or Chain(CrossedDipole(height=0.5 * u.m), Parallactic()))


def sky(lm, stokes, centre=CENTRE, **fields):
    l, m = np.atleast_2d(np.asarray(lm, float)).T
    ra, dec = offset(centre, l, m)
    names = tuple(f"s{k}" for k in range(len(l)))
    return PointSky(names=names, ra_rad=ra, dec_rad=dec, stokes_jy=np.atleast_2d(stokes), **fields)


def observation(centre=CENTRE, hours=6.0, minutes=60.0, mhz=(150,), **settings):
    settings = settings or {"transit": "2012-12-07"}
    return Observation(
        phase_centre=centre,
        duration=hours * u.hour,
        interval=minutes * u.min,
        frequencies=list(mhz) * u.MHz,
        **settings,
    )


def plan(array, of, when=None, **settings):
    return Scene(instrument=array, sky=of, observation=when or observation()).plan(**settings)


def both(array, of, when=None, **settings):
    """The plan, and its visibilities by `matrix`, held to the definition of the scene as it was given."""
    made = plan(array, of, when, engine="matrix", **settings)
    seen = made.run()
    assert np.isfinite(seen.data).all()
    assert np.abs(seen.data - Direct().sums(made.full)).max() <= made.error_bound * made.scale_jy
    return made, seen


# Exact arithmetic ------------------------------------------------------------------------------------------------

getcontext().prec = 50
PI = Decimal("3.14159265358979323846264338327950288419716939937510582")


def cos_sin(x):
    """Cosine and sine of a Decimal by their series, to 45 digits."""
    x = x % (2 * PI)
    cos = sin = Decimal(0)
    term, k = Decimal(1), 0
    while abs(term) > Decimal("1e-48"):
        if k % 2:
            sin += term if k % 4 == 1 else -term
        else:
            cos += term if k % 4 == 0 else -term
        k += 1
        term *= x / k
    return cos, sin


def exact_axes(ra, dec):
    """Rows east, north and towards, of a direction given in float64, as Decimals."""
    (cr, sr), (cd, sd) = cos_sin(Decimal(float(ra))), cos_sin(Decimal(float(dec)))
    return [[-sr, cr, Decimal(0)], [-sd * cr, -sd * sr, cd], [cd * cr, cd * sr, sd]]


def dot(a, b):
    return sum((x * y for x, y in zip(a, b, strict=True)), Decimal(0))


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def exact_visibility(problem, t, f, b):
    """Stokes I visibility of points without a beam from the formulas of docs/conventions.md, in 50 digits."""
    at = problem.at
    matrix = [[Decimal(float(x)) for x in row] for row in at.earth.matrices[t]]
    velocity = [Decimal(float(x)) for x in at.earth.velocity[t]]
    rows = exact_axes(at.centre.ra_rad, at.centre.dec_rad)
    turned = [[dot(m, r) for m in matrix] for r in rows]
    old = turned[2]
    moved = [dot(m, [x + v for x, v in zip(rows[2], velocity, strict=True)]) for m in matrix]
    length = dot(moved, moved).sqrt()
    new = [x / length for x in moved]
    k, scale = cross(old, new), 1 / (1 + dot(old, new))
    axes = []
    for row in turned:
        once = cross(k, row)
        axes.append([x + y + scale * z for x, y, z in zip(row, once, cross(k, once), strict=True)])
    p, q = (at.layout.positions_m[n[b]] for n in (problem.antenna1, problem.antenna2))
    baseline = [Decimal(float(x)) - Decimal(float(y)) for x, y in zip(p, q, strict=True)]
    uvw = [dot(row, baseline) * Decimal(float(at.freq_hz[f])) / Decimal(LIGHT) for row in axes]
    real = imag = Decimal(0)
    for ra, dec, flux in zip(at.ra_rad, at.dec_rad, problem.sky.stokes_jy[:, 0], strict=True):
        towards = exact_axes(ra, dec)[2]
        l, m, n = (dot(row, towards) for row in rows)
        c, s = cos_sin(2 * PI * dot(uvw, [l, m, n - 1]))
        real, imag = real + Decimal(float(flux)) * c, imag - Decimal(float(flux)) * s
    return complex(real, imag)


def exact_error(made, picks):
    """Largest error of both engines at some (t, f, b) against exact arithmetic, relative to the total flux."""
    found = [engine.sums(made.problem)[..., 0, 0] for engine in (Direct(), Matrix())]
    wanted = [exact_visibility(made.problem, *pick) for pick in picks]
    return (
        max(abs(have[pick] - want) for have in found for pick, want in zip(picks, wanted, strict=True)) / made.scale_jy
    )


LONG = ["RS205HBA", "RS508HBA", "RS509HBA", "CS302HBA0"]  # up to 62 km


@pytest.mark.parametrize("degrees", [7.0, 60.0])
def test_rounding_bound_holds_against_exact_arithmetic_far_from_the_centre(degrees):
    r = np.sin(np.deg2rad(degrees))
    made = plan(lofar(stations=LONG, beam=None), sky([[r, 0], [-0.6 * r, 0.8 * r]], [[1, 0, 0, 0], [2, 0, 0, 0]]))
    assert exact_error(made, [(0, 0, 0), (2, 0, 3), (4, 0, 5), (5, 0, 1)]) <= made.error_bound


@pytest.mark.parametrize("arcsec", [0.0, 60.0, 3600.0])
def test_rounding_bound_holds_against_exact_arithmetic_near_the_centre(arcsec):
    """l and m carry an absolute rounding of 1e-16, which a bound that falls with l and m forgets."""
    r = np.sin(np.deg2rad(arcsec / 3600))
    made = plan(lofar(stations=LONG, beam=None), sky([[0.8 * r, 0.6 * r]], [[1, 0, 0, 0]]))
    assert exact_error(made, [(0, 0, 0), (2, 0, 3), (4, 0, 5), (5, 0, 1)]) <= made.error_bound


def earth_wide():
    positions = [[6378137.0, 0, 0], [-3.0e6, 5.5e6, 1.0e6], [3826577.0, 461022.0, 5064892.0], [0, -6.3e6, 9e5]]
    return Composed(stations=Layout.geodetic(list("abcd"), np.array(positions)))


def test_phases_on_baselines_of_1e7_m_are_exact_to_the_rounding_of_their_turns():
    """5e6 wavelengths: 1.1e-16 of l, m, n and four roundings of u, v, w are 1e-8 rad; a float32 would be 1 rad off."""
    made = plan(earth_wide(), sky([[0.1, -0.07]], [[1, 0, 0, 0]]))
    assert made.problem.at.layout.longest_m > 1e7
    error = exact_error(made, [(0, 0, 0), (3, 0, 1), (5, 0, 4)])
    assert error <= 1e-8
    assert error <= made.error_bound


def test_bound_holds_when_gains_amplify():
    """Visibilities of stations with gains of 1000 are a million times the flux, and so is their rounding."""
    values = 10.0 ** np.random.default_rng(3).uniform(0, 3, (1, 1, 6, 2))
    both(lofar(beam=None, gain=GainTerm(values=values)), sky([[0.5, -0.3]], [[1, 0.3, 0, 0]]))


def test_bound_holds_for_stations_whose_axes_are_nearly_parallel():
    """Axes within 1e-9 are taken as one frame: that moves dipole beams by as much, a thousand times the rounding."""
    rng, first = np.random.default_rng(0), equator(5).layout()
    axes = []
    for own in first.axes:
        turned = np.linalg.qr((own + 3e-10 * rng.normal(size=(3, 3))).T)[0].T
        axes.append(turned * np.sign(np.sum(turned * own, axis=1))[:, None])
    layout = Layout(names=first.names, positions_m=first.positions_m, axes=np.array(axes))
    array = Composed(stations=layout, terms=Chain(CrossedDipole(height=0.5 * u.m), Parallactic()))
    centre = Direction(2.15, 0.3)
    both(array, sky([[0.3, 0.4], [0.6, -0.5]], [[1, 0, 0, 0], [1, 0.5, 0.2, 0]], centre), observation(centre))


@pytest.mark.parametrize("seed", range(6))
def test_bound_holds_for_random_scenes(seed):
    rng = np.random.default_rng(seed)
    centre = Direction(rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 1.5))
    gain = GainTerm(rms=0.3, seed=seed) if seed % 2 else None
    array = lofar(gain=gain, beam=[None, "full", "element"][seed % 3])
    count = 30
    lm = rng.normal(size=(count, 2)) * 10.0 ** rng.uniform(-3, -1.2)
    stokes = 10.0 ** rng.uniform(-12, 6, (count, 1)) * rng.choice([-1, 0.5, 1], (count, 4))
    tolerance = [0.0, 1e-6, 1e-2][seed % 3]
    made, _ = both(array, sky(lm, stokes, centre), observation(centre, 20, 300, (120, 180)), tolerance=tolerance)
    assert made.error_bound <= max(tolerance, 1e-9)


# A check must be able to fail -------------------------------------------------------------------------------------


def test_verify_does_not_pass_nan():
    from dataclasses import replace

    class Broken(Matrix):
        def sums(self, problem):
            return np.full((*problem.shape, 2, 2), np.nan, complex)

    made = plan(lofar(beam=None), sky([[0, 0]], [[1, 0, 0, 0]]))
    check = replace(made, engine=Broken()).verify(samples=8)
    assert not check.passed


# Places on the sky -----------------------------------------------------------------------------------------------


def test_centre_that_goes_through_the_zenith_and_sets_is_corrected_while_up_and_flagged_when_down():
    """A source at the centre, alone: after correction its own Stokes parameters exactly, or flagged; never garbage."""
    array = equator()
    centre = Direction(2.0, 0.0)
    stokes = [3.0, 0.5, -0.4, 0.2]
    made, seen = both(array, sky([[0, 0]], [stokes], centre), observation(centre, 16, 20))
    elevation = np.arcsin(made.problem.at.centre_itrf @ array.layout().axes[0, 2])
    assert np.rad2deg(elevation.max()) > 87
    down = elevation <= 0
    assert 10 < down.sum() < 40
    assert np.all(seen.data[down] == 0)
    out = seen.without_beam(array)
    assert np.all(out.flag[down])
    assert not out.flag[~down].any()
    # 20 min below and above the horizon: the beam is 1e-2 there and its inverse amplifies rounding by its square
    assert np.abs(out.data[~down] - mueller.brightness(np.array(stokes))).max() < 1e-10
    leaked = Analyzer(visibilities=out, sky=sky([[0, 0]], [stokes], centre)).leakage()
    assert leaked.stokes_jy[0] == pytest.approx(stokes, abs=1e-10)
    image = Imager(pixels=32, pixel=1 * u.arcmin).image(out)
    assert image.data[0, :, 16, 16] == pytest.approx(stokes, abs=1e-5)
    with pytest.raises(InputError, match="singular"):
        array.beam(SkyCoord(2.0, 0.0, unit="rad"), seen.times[down], 150 * u.MHz, state="differential")


def test_leakage_expected_of_a_centre_that_sets_is_the_mean_over_the_time_it_is_up():
    from instrument.analyze.sources.leakage import expected_percent

    array, centre = equator(), Direction(2.0, 0.0)
    at = plan(array, sky([[0.05, 0.02]], [[1, 0, 0, 0]], centre), observation(centre, 16, 60)).problem.at
    up = at.centre_itrf @ array.layout().axes[0, 2] > 0
    first, last = np.flatnonzero(up)[[0, -1]]
    one = np.array([[1.0, 0, 0, 0]])
    while_up = expected_percent(array.chain(), at.block(slice(first, last + 1), slice(None)), one)
    assert np.isfinite(while_up).all()
    assert expected_percent(array.chain(), at, one) == pytest.approx(while_up, rel=1e-9)


def test_a_centre_that_sets_leaves_no_nan_in_what_a_run_writes(tmp_path, monkeypatch):
    from astropy.table import QTable

    monkeypatch.chdir(tmp_path)
    (tmp_path / "set.toml").write_text(SETTING)
    assert main(["run", "set.toml", "--out", "out"]) == 0
    table = QTable.read(tmp_path / "out" / "leakage.ecsv")
    assert np.isfinite(table["I"].value).all()
    assert np.isfinite(table["linear_expected"].value).all()


SETTING = """
name = "set"
[instrument]
telescope = "lofar-hba"
stations = ["CS001HBA0", "CS002HBA0", "CS003HBA1"]
[observation]
phase_centre = "08h13m36.0s +02d13m03s"
transit = "2012-12-07"
duration = "20 h"
interval = "1 h"
frequency = { centre = "150 MHz", width = "0.19 MHz", channels = 1 }
[sky]
kind = "grid"
shape = [1, 3]
spacing = "1 deg"
flux = "1 Jy"
[correct]
beam = "centre"
[analyze]
products = ["leakage"]
"""


@pytest.mark.parametrize("ra0_deg", [0.1, 359.9])
def test_right_ascensions_on_both_sides_of_zero_are_neighbours(ra0_deg):
    centre = Direction(np.deg2rad(ra0_deg), 0.84)
    ra, dec = np.deg2rad([359.9, 0.1, 0.0, 360.0]), np.array([0.84, 0.85, 0.84, 0.84])
    step = np.deg2rad(np.array([359.9, 0.1, 0.0, 360.0]) - ra0_deg)
    step = (step + np.pi) % (2 * np.pi) - np.pi
    l, m, _ = lmn(unit_vectors(ra, dec), centre).T
    assert np.abs(l - np.cos(dec) * np.sin(step)).max() < 5e-16
    assert np.abs(m - (np.sin(dec) * np.cos(0.84) - np.cos(dec) * np.sin(0.84) * np.cos(step))).max() < 5e-16
    of = PointSky(names=tuple("abcd"), ra_rad=ra, dec_rad=dec, stokes_jy=np.eye(4)[[0, 0, 0, 0]])
    both(lofar(), of, observation(centre))
    # 0 and 360 deg are one direction
    one, other = (both(lofar(), of.select([k]), observation(centre))[1].data for k in (2, 3))
    assert np.abs(one - other).max() < 1e-10
    middle = of.middle.skycoord
    assert middle.separation(SkyCoord(0 * u.deg, np.rad2deg(0.8425) * u.deg)).deg < 0.2
    # the image has them where they belong, on either side of the wrap
    image = Imager(pixels=64, pixel=1 * u.arcmin).image(both(lofar(beam=None), of.select([0]), observation(centre))[1])
    y, x = np.unravel_index(np.argmax(image.data[0, 0]), (64, 64))
    found = image.wcs.celestial.pixel_to_world(x, y)
    assert found.separation(SkyCoord(359.9 * u.deg, 0.84 * u.rad)).arcmin < 0.75


def test_a_phase_centre_at_the_pole_has_closed_form_direction_cosines_and_finite_beams():
    pole = Direction(0.7, np.pi / 2)
    ra, dec = np.linspace(0, 2 * np.pi, 9), np.full(9, np.deg2rad(88))
    l, m, _ = lmn(unit_vectors(ra, dec), pole).T
    assert np.abs(l - np.cos(dec) * np.sin(ra - 0.7)).max() < 1e-16
    assert np.abs(m + np.cos(dec) * np.cos(ra - 0.7)).max() < 1e-16
    stokes = np.random.default_rng(1).normal(size=(9, 4))
    of = PointSky(names=tuple("abcdefghi"), ra_rad=ra, dec_rad=dec, stokes_jy=stokes)
    _, seen = both(lofar(), of, observation(pole))
    leaked = Analyzer(visibilities=seen.without_beam(lofar()), sky=of.select(range(8))).leakage()
    assert np.isfinite(leaked.stokes_jy).all()


def bench(towards):
    """A Sampling of one station on the equator at longitude 0 that sees exactly the ITRF vectors (S, 3)."""
    towards = np.asarray(towards, float)
    at = Sampling.build(
        equator(2).layout(), Time(["2012-12-07T00:00:00"]), 150e6, np.zeros(len(towards)), np.zeros(len(towards)),
        Direction(0.0, 0.0),
    )  # fmt: skip
    from dataclasses import replace

    axes = np.repeat(np.array([[[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]]), 2, 0)  # east, north, up
    east = np.cross([0.0, 0, 1], towards)
    east[np.linalg.norm(east, axis=1) == 0] = [0, 1, 0]
    layout = Layout(names=("a", "b"), positions_m=at.layout.positions_m, axes=axes)
    return replace(
        at, layout=layout, seen=towards[None], seen_east=(east / np.linalg.norm(east, axis=1)[:, None])[None]
    )


def test_a_source_exactly_at_the_zenith_has_the_beam_of_the_zenith():
    at = bench([[1.0, 0, 0]])
    rotation = Parallactic().jones(at)[0, 0, 0, 0]
    assert np.abs(rotation @ rotation.T - np.eye(2)).max() < 1e-15
    quarter = CrossedDipole(height=LIGHT / 150e6 / 4 * u.m)
    # X along p, which is east, and Y along q, which is north; columns north, east
    assert np.abs(Chain(quarter, Parallactic()).jones(at)[0, 0, 0, 0] - [[0, 1], [1, 0]]).max() < 1e-15
    assert np.isfinite(Chain(Hamaker(), Parallactic()).jones(at)).all()


@pytest.mark.parametrize("element", [CrossedDipole(height=0.5 * u.m), Hamaker(), Hamaker(band="lba")])
def test_a_source_on_the_antenna_plane_or_below_is_exactly_nothing(element):
    turns = np.linspace(0, 2 * np.pi, 7)
    plane = np.stack([0 * turns, np.cos(turns), np.sin(turns)], axis=1)
    at = bench(np.concatenate([plane, [[-1.0, 0, 0]]]))
    found = Chain(element, Parallactic()).jones(at)
    assert np.isfinite(found).all()
    if isinstance(element, Hamaker):  # docs: exactly zero at and below the plane
        assert np.all(found == 0)
    assert np.abs(found[..., :-1, :, :]).max() < 1e-15
    assert np.all(found[..., -1, :, :] == 0)


def test_a_source_at_the_antipode_of_the_phase_centre_has_the_phase_of_twice_w():
    centre = Direction(0.5, 0.3)
    opposite = PointSky(
        names=("x",), ra_rad=[0.5 + np.pi], dec_rad=[-0.3], stokes_jy=[[1.0, 0, 0, 0]]
    )  # n - 1 = -2: V = exp(+4 pi i w)
    made, seen = both(lofar(beam=None), opposite, observation(centre))
    assert made.problem.at.lmn[0] == pytest.approx([0, 0, -2], abs=1e-15)
    w = seen.uvw_m[..., 2] * 150e6 / LIGHT
    assert np.abs(seen.data[:, 0, :, 0, 0] - np.exp(4j * np.pi * w)).max() < 1e-9


def test_the_whole_sphere_of_sources_agrees_with_the_definition():
    rng = np.random.default_rng(2)
    ra, dec = rng.uniform(0, 2 * np.pi, 200), np.arcsin(rng.uniform(-1, 1, 200))
    of = PointSky(names=tuple(map(str, range(200))), ra_rad=ra, dec_rad=dec, stokes_jy=rng.normal(size=(200, 4)))
    both(lofar(beam=None), of)
    both(lofar(), of)


# Few of everything -----------------------------------------------------------------------------------------------


def test_one_baseline_one_time_one_channel_one_source_is_the_closed_form():
    made, seen = both(lofar(stations=STATIONS[:2], beam=None), sky([[0.02, 0.01]], [[2, 1, 0.5, -0.5]]),
                      observation(hours=1, minutes=60))  # fmt: skip
    assert seen.data.shape == (1, 1, 1, 2, 2)
    l, m, n1 = made.problem.at.lmn[0]
    phase = (seen.uvw_m[0, 0] @ [l, m, n1]) * 150e6 / LIGHT
    want = np.array([[3, 0.5 - 0.5j], [0.5 + 0.5j, 1]]) * np.exp(-2j * np.pi * phase)
    assert np.abs(seen.data[0, 0, 0] - want).max() < 1e-12


def quietly(function):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        return function(), [str(w.message) for w in said if issubclass(w.category, InstrumentWarning)]


def test_a_psf_of_one_fringe_is_said_to_be_no_beam(tmp_path):
    """One baseline at one time: stripes across the whole image, of which no width can be true."""
    seen = both(lofar(stations=STATIONS[:2], beam=None), sky([[0, 0]], [[1, 0, 0, 0]]), observation(hours=1))[1]
    image, said = quietly(lambda: Imager(pixels=64, pixel=30 * u.arcmin / 64).image(seen))
    assert image.data[0, 0, 32, 32] == pytest.approx(1, abs=1e-5)
    image.write(tmp_path / "fringe.fits")
    assert said


def zero_baseline():
    layout = lofar().layout()
    return Composed(
        stations=Layout(names=("a", "b"), positions_m=np.repeat(layout.positions_m[:1], 2, 0), axes=layout.axes[:2])
    )


def test_stations_at_one_position_see_the_total_flux():
    of = sky([[0, 0], [0.05, -0.3]], [[1, 0.5, 0, 0], [2, 0, 0.5, 0.1]])
    _, seen = both(zero_baseline(), of)
    assert np.abs(seen.data - mueller.brightness(of.stokes_jy.sum(axis=0))).max() < 1e-15
    assert ForcedPhotometry().measure(seen, of).outcome[0] is Outcome.SINGULAR


def test_a_psf_without_any_baseline_length_is_written_or_refused_in_one_line(tmp_path):
    seen = plan(zero_baseline(), sky([[0, 0]], [[1, 0, 0, 0]])).run()
    try:
        image, said = quietly(lambda: Imager(pixels=64, pixel=1 * u.arcmin).image(seen))
        image.write(tmp_path / "flat.fits")
    except InstrumentError:
        return
    assert said


def test_a_psf_wider_than_the_image_warns_as_its_docstring_says():
    seen = plan(lofar(stations=STATIONS[:3], beam=None), sky([[0, 0]], [[1, 0, 0, 0]])).run()
    _, said = quietly(lambda: Imager(pixels=64, pixel=1 * u.arcsec).image(seen))
    assert said


def test_a_cube_with_a_channel_without_data_is_written(tmp_path):
    """The first channel is flagged whole, as channels are: NaN there, and a file all the same."""
    seen = plan(lofar(beam=None), sky([[0, 0]], [[1, 0, 0, 0]]), observation(mhz=(140, 150), minutes=20)).run()
    flag = np.zeros((1, 2, 1), bool)
    flag[:, 0] = True
    image = Imager(pixels=64, pixel=30 * u.arcsec).image(seen.flagged(flag))
    assert np.isnan(image.data[0]).all()
    assert image.data[1, 0, 32, 32] == pytest.approx(1, abs=1e-5)
    image.write(tmp_path / "cube.fits")


# Channels and numbers --------------------------------------------------------------------------------------------


def test_channels_in_any_order_are_the_same_channels():
    mhz = (170, 120, 150, 135)
    fields = {"reference_hz": [150e6], "spectral_terms": [[-0.7]], "rotation_measure": [2.0]}
    of = sky([[0.02, 0.03]], [[1, 0.3, 0, 0]], **fields)
    gain = GainTerm(
        values=np.arange(1, 5).reshape(1, 4, 1, 1) * np.ones((1, 4, 6, 2)), freq_hz=[120e6, 135e6, 150e6, 170e6]
    )
    array = lofar(gain=gain)
    _, mixed = both(array, of, observation(mhz=mhz))
    for f, value in enumerate(mhz):
        alone = both(array, of, observation(mhz=(value,)))[1]
        assert np.abs(mixed.data[:, f] - alone.data[:, 0]).max() < 1e-12 * 16
    bare = plan(lofar(beam=None), of, observation(mhz=mhz)).run()
    image = Imager(pixels=64, pixel=20 * u.arcsec).image(bare)
    assert list(image.freq_hz / 1e6) == sorted(mhz)
    fluxes = ForcedPhotometry().measure(bare, of)
    assert list(fluxes.freq_hz / 1e6) == sorted(mhz)
    assert np.abs(fluxes.stokes_jy[:, 0] - of.stokes(fluxes.freq_hz)[:, 0]).max() < 1e-12


def test_fluxes_of_1e_300_and_1e12_jy_side_by_side_keep_their_place():
    of = sky([[0, 0], [0.03, 0.01], [-0.02, 0.04]], [[1e12, 0, 0, 0], [1e-300, 0, 0, 0], [1, 0.5, 0, 0]])
    made, _ = both(lofar(), of)
    assert made.problem.at.shape[3] == 3
    bare = both(lofar(beam=None), of)[1]
    assert np.abs(bare.data[..., 0, 0]).max() == pytest.approx(1e12, rel=1e-9)
    # with a tolerance the fainter two are left out, within a bound that says so
    dropped = plan(lofar(), of, tolerance=1e-9)
    assert dropped.problem.at.shape[3] == 1
    assert dropped.error_bound <= 1e-9
    only = sky([[0.03, 0.01]], [[1e-300, 0, 0, 0]])
    assert np.abs(both(lofar(beam=None), only)[1].data[..., 0, 0]).max() == pytest.approx(1e-300, rel=1e-12)


def test_errors_of_photometry_hold_at_a_dynamic_range_of_1e12():
    """1 Jy beside 1e12 Jy: what float64 leaves of it is not an error of zero."""
    of = sky([[0, 0], [0.01, 0.02]], [[1e12, 0, 0, 0], [1, 0, 0, 0]])
    fluxes = ForcedPhotometry().measure(plan(lofar(beam=None), of).run(), of)
    off = abs(fluxes.stokes_jy[0, 1, 0] - 1)
    assert off < 0.1
    assert off <= 10 * fluxes.error_jy[0, 1, 0]


def test_equal_sources_at_one_place_add_up_and_cannot_be_told_apart():
    of = sky([[0, 0], [0.01, 0.02], [0.01, 0.02]], [[1, 0, 0, 0], [2, 0, 0, 0], [6, 0, 0, 0]])
    _, seen = both(lofar(beam=None), of)
    one = both(lofar(beam=None), sky([[0, 0], [0.01, 0.02]], [[1, 0, 0, 0], [8, 0, 0, 0]]))[1]
    assert np.abs(seen.data - one.data).max() < 1e-12
    fluxes = ForcedPhotometry().measure(seen, of)
    assert fluxes.outcome[0] is Outcome.SINGULAR
    assert np.isnan(fluxes.stokes_jy).all()


def test_conjugate_gradients_do_not_call_coinciding_sources_converged():
    """With a uv range (or unequal weights) the fluxes 2 and 6 Jy come out as 4 and 4, "converged"."""
    of = sky([[0, 0], [0.01, 0.02], [0.01, 0.02]], [[1, 0, 0, 0], [2, 0, 0, 0], [6, 0, 0, 0]])
    seen = plan(lofar(beam=None), of).run()
    fluxes = ForcedPhotometry(uv_range=(0, 1e6)).measure(seen, of)
    right = np.abs(fluxes.stokes_jy[0, :, 0] - [1, 2, 6]).max() < 1e-6
    assert right or fluxes.outcome[0] is not Outcome.CONVERGED


# Polarization ----------------------------------------------------------------------------------------------------


def test_a_sky_of_q_and_u_only_goes_the_whole_way():
    of = sky([[0, 0], [0.004, 0.003]], [[0, 1, 0, 0], [0, 0.5, -0.5, 0]])
    array = lofar()
    made, seen = both(array, of, observation(minutes=20))
    assert [i.name for i in made.left_out if "of the sky" in i.name] == ["I, V of the sky"]
    bare = both(lofar(beam=None), of, observation(minutes=20))[1]
    assert np.abs(bare.stokes()[..., [0, 3]]).max() < 1e-15
    image = Imager(pixels=64, pixel=20 * u.arcsec).image(bare)
    assert np.abs(image.data[0, [0, 3]]).max() < 1e-12
    for k in (1, 2):  # at the centre an image is the mean of the visibilities
        assert image.data[0, k, 32, 32] == pytest.approx(bare.stokes()[..., k].real.mean(), abs=1e-6)
    fluxes = ForcedPhotometry().measure(bare, of)
    assert np.abs(fluxes.stokes_jy[0] - of.stokes_jy).max() < 1e-10
    leaked = Analyzer(visibilities=seen.without_beam(array), sky=of).leakage()
    assert not leaked.measured.any()  # a leakage of I says nothing where there is no I
    assert not leaked.near_null.any()  # which has nothing to do with the beam
    assert leaked.stokes_jy[0] == pytest.approx([0, 1, 0, 0], abs=1e-3)
    assert np.isnan(leaked.inside(4.0)["linear_median"])


def test_negative_stokes_i_is_the_negative_of_positive_stokes_i():
    lm, stokes = [[0, 0], [0.02, 0.01]], np.array([[1, 0.1, 0, 0], [2, 0, 0, 0]])
    array = lofar()
    plus, minus = (both(array, sky(lm, s))[1] for s in (stokes, -stokes))
    assert np.abs(plus.data + minus.data).max() < 1e-15
    leaks = [
        Analyzer(visibilities=v.without_beam(array), sky=sky(lm, s)).leakage()
        for v, s in ((plus, stokes), (minus, -stokes))
    ]
    assert leaks[0].linear_percent == pytest.approx(leaks[1].linear_percent, abs=1e-9)
    assert not leaks[1].near_null.any()
    assert leaks[0].stokes_jy == pytest.approx(-leaks[1].stokes_jy, abs=1e-9)


def test_a_patch_with_a_negative_component_is_measured_right():
    """Components of 5 and -1 Jy, as CLEAN makes them: the patch is 4 Jy, not a mixture of 5 : +1."""
    of = sky([[0, 0], [0.01, 0.02], [0.0101, 0.02]], [[1, 0, 0, 0], [5, 0, 0, 0], [-1, 0, 0, 0]])
    of = of.with_fields(patches=("", "p", "p"))
    fluxes = ForcedPhotometry().measure(plan(lofar(beam=None), of).run(), of)
    assert fluxes.stokes_jy[0, :, 0] == pytest.approx([1, 4], abs=1e-9)


def test_a_patch_is_mixed_anew_in_every_channel():
    """Two components of spectral index +3 and -3: their shares change by 9 to 1 over the band."""
    fields = {"reference_hz": [150e6] * 3, "spectral_terms": [[0.0], [3.0], [-3.0]]}
    of = sky([[0, 0], [0.01, 0.02], [0.0101, 0.02]], np.outer([1, 5, 5], [1, 0, 0, 0]), **fields)
    of = of.with_fields(patches=("", "p", "p"))
    seen = plan(lofar(beam=None), of, observation(mhz=(120, 150, 180))).run()
    fluxes = ForcedPhotometry().measure(seen, of)
    assert np.abs(fluxes.stokes_jy[..., 0] - fluxes.model_jy[..., 0]).max() < 1e-9


# Weights, flags, NaN ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def night():
    of = sky([[0, 0], [0.01, 0.02]], [[1, 0, 0, 0], [2, 0, 0, 0]])
    return of, plan(lofar(beam=None), of, observation(minutes=60)).run()


@pytest.mark.parametrize("how", ["weights", "flags", "nan"])
def test_without_any_good_datum_there_is_no_answer(night, how):
    of, seen = night
    none = {
        "weights": lambda: seen.weighted(np.zeros((1, 1, 1))),
        "flags": lambda: seen.flagged(np.ones((1, 1, 1), bool)),
        "nan": lambda: seen.with_data(np.full_like(seen.data, np.nan)),
    }[how]()
    for weighting in ("natural", "uniform", "briggs"):
        with pytest.raises(InstrumentError, match="no visibility"):
            Imager(pixels=32, pixel=1 * u.arcmin, weighting=weighting).image(none)
    fluxes = ForcedPhotometry().measure(none, of)
    assert fluxes.outcome[0] is Outcome.REFUSED
    assert np.isnan(fluxes.stokes_jy).all()
    leaked = Analyzer(visibilities=none, sky=of).leakage()
    assert not leaked.measured.any()


@pytest.mark.parametrize("bad", [np.nan, np.inf, complex(0, -np.inf)])
def test_one_bad_number_in_one_correlation_takes_its_visibility_out_and_nothing_else(night, bad):
    of, seen = night
    data = seen.data.copy()
    data[2, 0, 3, 1, 0] = bad
    flag = np.zeros(seen.data.shape[:3], bool)
    flag[2, 0, 3] = True
    imager = Imager(pixels=32, pixel=1 * u.arcmin)
    spoilt, cut = seen.with_data(data), seen.flagged(flag)
    assert np.abs(imager.image(spoilt).data - imager.image(cut).data).max() < 1e-12  # threads add in any order
    a, b = (ForcedPhotometry().measure(v, of).stokes_jy for v in (spoilt, cut))
    assert np.array_equal(a, b)
    assert np.abs(a[0, :, 0] - [1, 2]).max() < 1e-9


def test_weights_that_change_with_time_only_are_heeded():
    """A flux that triples in the second half of the night, which has no weight to speak of."""
    of = sky([[0, 0], [0.01, 0.02]], [[1, 0, 0, 0], [2, 0, 0, 0]])
    seen = plan(lofar(beam=None), of).run()
    data, weight = seen.data.copy(), np.ones((6, 1, 1))
    data[3:] *= 3
    weight[3:] = 1e-9
    fluxes = ForcedPhotometry().measure(seen.with_data(data).weighted(weight), of)
    assert fluxes.stokes_jy[0, :, 0] == pytest.approx([1, 2], abs=1e-6)


def test_every_nth_integration_is_taken_in_every_channel_however_a_run_is_cut():
    from dataclasses import replace

    of = sky([[0, 0], [0.01, 0.02]], [[1, 0, 0, 0], [2, 0, 0, 0]])
    made = plan(lofar(beam=None), of, observation(mhz=(140, 150, 160, 170)))
    whole = ForcedPhotometry(every=2).measure(made.run(), of)
    cut = ForcedPhotometry(every=2).measure(list(replace(made, block_shape=(1, 2)).blocks()), of)
    assert cut.outcome == whole.outcome
    assert cut.stokes_jy == pytest.approx(whole.stokes_jy, abs=1e-9)


# Gains -----------------------------------------------------------------------------------------------------------


def test_gains_of_rms_0_are_left_out():
    of = sky([[0.01, 0.02]], [[1, 0, 0, 0]])
    made = plan(lofar(gain=GainTerm(rms=0.0, seed=5)), of)
    assert "GainTerm" in [i.name for i in made.left_out]
    assert np.array_equal(made.run().data, plan(lofar(), of).run().data)


def test_a_dead_station_gives_zeros_and_cannot_be_corrected():
    values = np.ones((1, 1, 6, 2), complex)
    values[0, 0, 2] = 0
    gain = GainTerm(values=values)
    _, seen = both(lofar(gain=gain), sky([[0.01, 0.02]], [[1, 0, 0, 0]]))
    dead = (seen.antenna1 == 2) | (seen.antenna2 == 2)
    assert np.all(seen.data[:, :, dead] == 0)
    out = seen.corrected(gain)
    assert np.array_equal(out.flag[0, 0], dead)
    assert np.isfinite(out.data).all()
    one = values.copy()
    one[0, 0, 2] = [1, 0]  # one receptor only
    assert np.array_equal(seen.corrected(GainTerm(values=one)).flag[0, 0], dead)
    every = plan(lofar(gain=GainTerm(values=np.zeros((1, 1, 6, 2)))), sky([[0, 0]], [[1, 0, 0, 0]]), tolerance=1e-3)
    assert np.all(every.run().data == 0)
    assert every.verify().passed


# Pointings -------------------------------------------------------------------------------------------------------


def test_a_beam_that_points_elsewhere_is_1_there_and_is_taken_out_at_the_phase_centre():
    pointing = Direction(CENTRE.ra_rad + 0.03, CENTRE.dec_rad - 0.01)
    array = lofar(beam_pointing=pointing)
    stokes = [1.0, 0.2, -0.1, 0.05]
    of = sky([[0, 0]], [stokes])
    made, seen = both(array, of)
    chain = array.chain().beams()
    factor = next(t for t in chain.parts if type(t).__name__ == "ArrayFactor")
    there = made.problem.at.towards(np.array([pointing.ra_rad]), np.array([pointing.dec_rad]))
    assert np.abs(factor.scalar(there) - 1).max() < 1e-13
    assert np.abs(factor.scalar(made.problem.at)).max() < 0.9
    out = seen.without_beam(array)
    assert out.beam_state.towards == CENTRE
    assert np.abs(out.data - mueller.brightness(np.array(stokes))).max() < 1e-11
    nominal = array.beam(CENTRE.skycoord, seen.times, 150 * u.MHz, pointing=CENTRE.skycoord, state="differential")
    assert np.abs(nominal - np.eye(2)).max() < 1e-12
    same = lofar(beam_pointing=CENTRE)
    assert np.array_equal(plan(same, of).run().data, plan(lofar(), of).run().data)


# Mixing ----------------------------------------------------------------------------------------------------------


def test_visibilities_of_two_phase_centres_cannot_be_subtracted():
    other = Direction(CENTRE.ra_rad + 0.1, CENTRE.dec_rad)
    a, b = (
        plan(lofar(beam=None), sky([[0, 0]], [[1, 0, 0, 0]], c), observation(c, start="2012-12-07T22:00:00")).run()
        for c in (CENTRE, other)
    )
    with pytest.raises(InputError):
        a - b


def test_visibilities_of_two_arrays_cannot_be_subtracted():
    a, b = (
        plan(
            lofar(stations=s, beam=None), sky([[0, 0]], [[1, 0, 0, 0]]), observation(start="2012-12-07T22:00:00")
        ).run()
        for s in (STATIONS, STATIONS[::-1])
    )
    with pytest.raises(InputError):
        a - b


def test_the_beam_of_other_stations_cannot_be_taken_out():
    """As many stations, in another order: their tiles stand elsewhere."""
    seen = plan(lofar(), sky([[0, 0]], [[1, 0, 0, 0]])).run()
    with pytest.raises(InputError):
        seen.without_beam(lofar(stations=STATIONS[::-1]))


def test_the_beam_state_follows_what_is_done_to_the_data():
    array = lofar()
    seen = plan(array, sky([[0, 0]], [[1, 0, 0, 0]])).run()
    beam = Towards(chain=array.chain().beams())
    assert seen.corrected(beam).corrupted(beam).beam_state == seen.beam_state
    assert seen.corrected(Chain(beam)).beam_state.removed == "centre"


# Time ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("start", ["2016-12-31T23:59:30", "2012-12-07T23:59:30"])
def test_integrations_cross_midnight_and_a_leap_second_evenly(start):
    """2016-12-31 has a second 23:59:60. The Earth turns on: its angle between integrations is that of 10 s."""
    when = observation(hours=70 / 3600, minutes=10 / 60, start=start)
    layout = lofar().layout()
    times = when.times(layout)
    assert np.abs(np.diff(times.tai.unix_tai) - 10).max() < 1e-6
    leaps = start.startswith("2016")
    assert times[-1].isot[-12:] == ("00:00:34.000" if leaps else "00:00:35.000")
    frame = earth_frame(times, layout.centre_m)
    pole = frame.matrices[0] @ np.array([0, 0, 1.0])
    angle = [np.arctan2(*(frame.matrices[k] @ frame.matrices[0].T)[[0, 1], [1, 1]]) for k in range(len(times))]
    assert np.abs(np.diff(angle) - 10 * 7.2921158e-5).max() < 1e-9
    assert abs(pole[2]) > 0.99
    gain = GainTerm(rms=0.1, seed=1)
    _, seen = both(lofar(gain=gain), sky([[0.01, 0]], [[1, 0, 0, 0]]), when)
    assert len(np.unique(gain.jones(seen.at)[:, 0, 0, 0, 0, 0])) == 7
    assert np.abs((seen.times - times).sec).max() < 1e-5
    # the same integrations, asked for from the middle on
    later = observation(hours=30 / 3600, minutes=10 / 60, start=(times[4] - 5 * u.s).isot)
    again = plan(lofar(gain=gain), sky([[0.01, 0]], [[1, 0, 0, 0]]), later).run()
    assert np.abs(again.data - seen.data[4:]).max() < 1e-7


@pytest.mark.filterwarnings("ignore::erfa.ErfaWarning")
@pytest.mark.parametrize("start", ["2060-01-01T20:00:00", "1972-06-01T20:00:00", "1965-01-01T20:00:00"])
def test_times_outside_the_table_of_the_earth_warn_and_stay_finite(start):
    with pytest.warns(InstrumentWarning, match="outside the Earth orientation table"):
        made = plan(
            lofar(stations=STATIONS[:3]), sky([[0.01, 0]], [[1, 0, 0, 0]]), observation(start=start, minutes=180)
        )
    assert made.verify(samples=8).passed
    assert isinstance(erfa.ErfaWarning("x"), Warning)


def test_drawn_errors_before_1858_are_drawn_or_refused_in_one_line():
    """A day before MJD 0 has negative seconds, which no seed takes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            made = plan(
                lofar(gain=GainTerm(rms=0.1)), sky([[0, 0]], [[1, 0, 0, 0]]), observation(start="1850-01-01T20:00:00")
            )
        except InstrumentError:
            return
        assert np.isfinite(made.run().data).all()


def test_noise_without_a_channel_width_is_refused_and_several_channels_have_one():
    one = plan(lofar(beam=None), sky([[0, 0]], [[1, 0, 0, 0]])).run()
    with pytest.raises(InputError, match="channel_width"):
        one.with_noise(sefd=3000 * u.Jy, seed=1)
    many = plan(lofar(beam=None), sky([[0, 0]], [[1, 0, 0, 0]]), observation(mhz=(160, 150, 150.5))).run()
    assert many.noise_jy(3000 * u.Jy) == pytest.approx(3000 / np.sqrt(2 * 0.5e6 * 3600))


# Low band, large pixels ------------------------------------------------------------------------------------------


def test_the_low_band_is_the_definition_from_15_to_90_mhz():
    array = lofar("lba", ["CS001LBA", "CS302LBA", "RS106LBA", "RS406LBA", "RS508LBA"])
    rng = np.random.default_rng(4)
    of = sky(rng.uniform(-0.5, 0.5, (30, 2)), rng.normal(size=(30, 4)))
    both(array, of, observation(mhz=(15, 60, 90)))
    stokes = [1.0, 0.1, 0.2, -0.3]
    centre = both(array, sky([[0, 0]], [stokes]), observation(mhz=(15, 60, 90)))[1].without_beam(array)
    assert np.abs(centre.data - mueller.brightness(np.array(stokes))).max() < 1e-11


def test_an_image_that_is_larger_than_the_sky_is_refused_or_blank_beyond_it():
    """64 pixels of 5 deg are 5.6 in l: beyond l2 + m2 = 1 there is no sky, and no number may stand there."""
    seen = plan(lofar(beam=None), sky([[0, 0]], [[1, 0, 0, 0]])).run()
    try:
        image, _ = quietly(lambda: Imager(pixels=64, pixel=5 * u.deg).image(seen))
    except InputError:
        return
    side = np.deg2rad(5) * (np.arange(64) - 32)
    beyond = np.add.outer(side**2, side**2) > 1
    assert np.isnan(image.data[0, 0][beyond]).all()


def test_an_image_to_the_edge_of_the_sky_is_the_plain_sum_in_its_corners():
    """64 pixels of 0.02 rad: corners at l2 + m2 = 0.82, baselines beyond the Nyquist limit of the pixels."""
    of = sky([[0.3, -0.2]], [[1, 0, 0, 0]])
    seen = plan(lofar(stations=STATIONS[:3], beam=None), of, observation(minutes=120)).run()
    image, _ = quietly(lambda: Imager(pixels=64, pixel=0.02 * u.rad, accuracy=1e-9).image(seen))
    for x, y in ((0, 0), (63, 1), (32, 32), (5, 60)):
        l, m = -0.02 * (x - 32), 0.02 * (y - 32)
        n1 = np.sqrt(1 - l**2 - m**2) - 1
        turns = seen.uvw_m @ [l, m, n1] * 150e6 / LIGHT
        want = (seen.stokes()[:, 0, :, 0] * np.exp(2j * np.pi * turns)).real.mean()
        assert image.data[0, 0, y, x] == pytest.approx(want, abs=1e-7)


@pytest.mark.parametrize("arcmin", [0.4, 3.0, 60.0])
def test_pixels_wider_than_the_beam_are_said_to_be(arcmin):
    """A beam of 0.2 arcmin in one pixel: the fit stays where it began, 2 pixels wide, and K per Jy is wrong by 1e2."""
    seen = plan(lofar(beam=None), sky([[0, 0]], [[1, 0, 0, 0]]), observation(minutes=30)).run()
    _, said = quietly(lambda: Imager(pixels=64, pixel=arcmin * u.arcmin).image(seen))
    assert said


# The command line ------------------------------------------------------------------------------------------------

TINY = SETTING.replace('"20 h"', '"3 h"').replace("+02d", "+48d").replace('"set"', '"tiny"')
# without images and figures, which take a run of this size nine tenths of its time
BARE = TINY.partition("[correct]")[0]


def one_line(capsys, *words):
    status = main(list(words))
    err = [t for t in capsys.readouterr().err.strip().splitlines() if "warning" not in t]
    assert status == 2
    assert len(err) == 1
    return err[0]


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.toml").write_text(TINY)
    return tmp_path


@pytest.fixture
def bare(tiny):
    (tiny / "tiny.toml").write_text(BARE)
    return tiny


@pytest.mark.parametrize("setting", ["seed=-1", "instrument.gain={rms=0.1,seed=-5}"])
def test_a_negative_seed_is_one_clear_line(tiny, capsys, setting):
    assert "seed" in one_line(capsys, "run", "tiny.toml", "--set", setting, "--set", "instrument.feed.rms=0.1")
    assert [p.name for p in tiny.iterdir()] == ["tiny.toml"]


def test_a_folder_below_a_file_is_one_clear_line(tiny, capsys):
    assert "tiny.toml" in one_line(capsys, "run", "tiny.toml", "--out", "tiny.toml/x")


def test_a_folder_that_may_not_be_written_is_one_clear_line(tiny, capsys, monkeypatch):
    """Before anything is computed; as root no folder is read-only, so the refusal of the system is played."""
    from pathlib import Path

    def refuse(self, *args, **settings):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "mkdir", refuse)
    assert "out" in one_line(capsys, "run", "tiny.toml", "--out", "out")


def test_the_current_folder_when_empty_is_a_folder_to_write(bare, capsys, monkeypatch):
    (bare / "empty").mkdir()
    monkeypatch.chdir(bare / "empty")
    status = main(["run", "../tiny.toml", "--out", "."])
    assert status in (0, 2)
    assert status == 2 or (bare / "empty" / "run.json").is_file()


def test_a_toml_time_is_a_time_or_one_clear_line(bare, capsys):
    """start = 2012-12-07T20:00:00 without quotes is a time in TOML."""
    (bare / "time.toml").write_text(BARE.replace('transit = "2012-12-07"', "start = 2012-12-07T20:00:00"))
    status = main(["run", "time.toml", "--out", "out"])
    assert status in (0, 2)
    if status == 0:
        assert main(["plan", "out/scene.toml"]) == 0


def test_what_a_run_records_is_json_when_nothing_could_be_measured(tiny):
    import json

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    (tiny / "qu.csv").write_text("ra_deg,dec_deg,i_jy,q_jy,u_jy\n123.4,48.2175,0,1,0\n124.0,48.5,0,0.5,0.5\n")
    assert main(["run", "tiny.toml", "--out", "qu", "--set", "sky={kind='catalogue',path='qu.csv'}"]) == 0
    json.loads((tiny / "qu" / "run.json").read_text(), parse_constant=refuse)


def test_leakage_measured_and_expected_are_of_one_channel(tiny):
    """Channels given from high to low: fluxes are sorted by frequency, the expectation was made for the first one."""
    from astropy.table import QTable

    found = []
    for name, order in (("up", "'120 MHz','180 MHz'"), ("down", "'180 MHz','120 MHz'")):
        where = "phase_centre='08h13m36.0s +48d13m03s',transit='2012-12-07',duration='3 h',interval='1 h'"
        setting = f"observation={{{where},frequencies=[{order}]}}"
        assert main(["run", "tiny.toml", "--out", name, "--no-verify", "--set", setting]) == 0
        found.append(QTable.read(tiny / name / "leakage.ecsv"))
    assert found[0].meta["frequency_hz"] == found[1].meta["frequency_hz"]
    for column in ("linear", "linear_expected"):
        assert found[0][column].value == pytest.approx(found[1][column].value, rel=1e-6)


def test_nested_parents_are_made_and_a_second_run_takes_the_next_name(bare):
    assert main(["run", "tiny.toml", "--out", "a/b/c"]) == 0
    assert sorted(p.name for p in (bare / "a" / "b").iterdir()) == ["c"]
    for _ in range(2):
        assert main(["run", "tiny.toml"]) == 0
    assert sorted(p.name for p in (bare / "runs").iterdir()) == ["tiny", "tiny-2"]


def test_an_interrupted_run_leaves_nothing_behind(tiny, monkeypatch, capsys):
    from instrument.pipeline import run

    def stop(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(run, "_write", stop)
    assert main(["run", "tiny.toml", "--out", "a/b/c"]) == 1
    assert "nothing was written" in capsys.readouterr().err
    assert [p.name for p in tiny.iterdir()] == ["tiny.toml"]


def test_two_runs_of_one_name_at_a_time_do_not_share_a_folder(bare, monkeypatch):
    """The second begins while the first computes: the folder of the first must not be taken from under it."""
    from instrument.pipeline import run

    inner, started = run._compute, []

    def compute(*given):
        inner(*given)
        if not started:
            started.append(True)
            assert main(["run", "tiny.toml"]) == 0

    monkeypatch.setattr(run, "_compute", compute)
    assert main(["run", "tiny.toml"]) == 0
    assert len(list((bare / "runs").iterdir())) == 2
