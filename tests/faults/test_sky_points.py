"""A5, A8 and the numbers of skies: what spectra make of fluxes stands in the plan; numbers are checked."""

import warnings

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import AltAz, EarthLocation, SkyCoord
from astropy.time import Time

import instrument as ins
from instrument.errors import InputError, InstrumentWarning
from instrument.sky.mocks import FaradaySky, GridSky, MockField, RandomSky
from instrument.sky.points import PointSky
from instrument.sky.readers import Catalogue
from instrument.units import Direction, direction

CENTRE = SkyCoord("08h13m36.0s +48d13m03s")
ENU = np.array([[0, 0, 0], [100, 0, 0], [0, 200, 1.0]])


def plan(sky, mhz):
    layout = ins.Layout.from_enu(["a", "b", "c"], ENU * u.m, 0.12 * u.rad, 0.92 * u.rad, 50 * u.m)
    observation = ins.Observation(
        phase_centre=CENTRE, transit="2012-12-07", duration=20 * u.s, interval=10 * u.s, frequencies=mhz * u.MHz
    )
    return ins.Scene(instrument=ins.Composed(stations=layout), sky=sky, observation=observation).plan()


def linear(**fields):
    here = {"names": ("3C1", "b"), "ra_rad": [2.15, 2.15], "dec_rad": [0.84, 0.84], "reference_hz": [58e6, 140e6]}
    spectra = {"spectral_terms": [[-1.5], [0.0]], "logarithmic": [False, True]}
    return PointSky(**{**here, **spectra, "stokes_jy": [[1, 0, 0, 0], [2, 0, 0, 0]], **fields})


def test_a5_a_flux_that_turns_negative_and_how_far_it_is_extrapolated_stand_in_the_plan():
    sky = linear()
    assert sky.stokes(np.array([144e6]))[0, 0, 0] == pytest.approx(1 - 1.5 * (144 / 58 - 1), rel=1e-12)  # -1.22 Jy
    text = str(plan(sky, [144]))
    assert "not modelled  spectra" in text
    assert "1 of 2 sources is negative in I by its spectrum, at worst '3C1': -1.22 Jy at 144 MHz" in text
    assert "fluxes are taken up to 2.48 times away from where they were measured: '3C1', 58 MHz, at 144 MHz" in text


def test_a5_nothing_is_said_of_spectra_near_their_frequency():
    sky = linear(reference_hz=[140e6, 140e6])
    assert "spectra" not in str(plan(sky, [134, 166]))
    negative = linear(reference_hz=[140e6, 140e6], stokes_jy=[[-1, 0, 0, 0], [2, 0, 0, 0]])
    assert "negative" not in str(plan(negative, [144]))  # a clean component that is meant so


def test_a5_a_sky_without_spectra_says_that_it_is_constant():
    sky = linear(spectral_terms=None, logarithmic=None, reference_hz=[1.4e9, 1.4e9])
    assert "up to 10 times away from where they were measured: '3C1', 1400 MHz, at 140 MHz; 2 of 2 without" in str(
        plan(sky, [140])
    )


def test_a5_a_spectrum_without_a_finite_flux_is_refused():
    sky = linear(spectral_terms=[[0.0, 900.0], [0.0, 0.0]], logarithmic=[True, True])
    with pytest.raises(InputError, match="source '3C1' has no finite flux at 1 MHz by its spectrum"):
        sky.doubts(np.array([1e6]))
    with pytest.raises(InputError, match="the sky has inf Jy"):
        plan(sky, [1])


def test_a_rotation_measure_of_which_float64_knows_no_angle_is_refused():
    """A fuzzed 1e308 made Q and U NaN, a maximum dropped the NaN, and the plan divided by a flux of zero."""
    with pytest.raises(InputError, match=r"rotation_measure of source '3C1' is 1e\+308 rad/m2: beyond 1e\+15"):
        linear(rotation_measure=[1e308, 0.0])


def test_a2_columns_that_were_not_read_stand_in_the_plan(tmp_path):
    (tmp_path / "t.csv").write_text("ra_deg,dec_deg,i_jy,log_curv\n123.4,48.2,1,5\n")
    with pytest.warns(InstrumentWarning, match="not used: log_curv"):
        sky = Catalogue(path=str(tmp_path / "t.csv"))
        text = str(plan(sky, [150]))
    assert "not modelled  not read" in text
    assert "t.csv: log_curv" in text


@pytest.mark.parametrize("make", [lambda c: PointSky.at(c, [1.0]), direction])
def test_a8_directions_that_lack_a_time_or_place_are_asked_for_as_icrs(make):
    for frame in (
        AltAz(),
        AltAz(obstime=Time("2012-12-07")),
        AltAz(location=EarthLocation(0 * u.m, 0 * u.m, 6e6 * u.m)),
    ):
        with pytest.raises(InputError, match="ICRS") as caught:
            make(SkyCoord(10 * u.deg, 20 * u.deg, frame=frame))
        assert str(caught.value).isprintable()
    with pytest.raises(InputError, match=r"ICRS|not one direction"):
        make(5.0)


def test_a8_directions_that_have_both_are_turned():
    place = EarthLocation.from_geodetic(6.87 * u.deg, 52.9 * u.deg, 50 * u.m)
    frame = AltAz(obstime=Time("2012-12-07T23:00:00"), location=place)
    sky = PointSky.at(CENTRE.transform_to(frame), [1.0])
    # there and back: astropy's own closure is of the order of a microarcsecond
    assert np.rad2deg([sky.ra_rad[0], sky.dec_rad[0]]) == pytest.approx([123.4, 48.2175], abs=1e-8)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda v: RandomSky(count=v), "count"),
        (lambda v: FaradaySky(count=v), "count"),
        (lambda v: GridSky(shape=(v, 3)), "shape"),
        (lambda v: RandomSky(seed=v), "seed"),
        (lambda v: MockField(seed=v), "seed"),
        (lambda v: RandomSky(polarization=v), "polarization"),
        (lambda v: MockField(pairs=v), "pairs"),
        (lambda v: RandomSky(scatter=v), "scatter"),
        (lambda v: RandomSky(slope=v), "slope"),
        (lambda v: GridSky(spectral_index=v), "spectral_index"),
        (lambda v: FaradaySky(depths=(v, 5.0)), "depths"),
        (lambda v: GridSky(polarization=(v, 0.0, 0.0)), "polarization"),
        (lambda v: Catalogue(path="x", brightest=v), "brightest"),
        (lambda v: PointSky.at(CENTRE, [1.0]).brightest(v), "count"),
    ],
)
def test_numbers_of_skies_go_through_the_checked_door(make, message):
    for value in (np.nan, np.inf, "2", True, 1j, [1]):
        with pytest.raises(InputError, match=message) as caught:
            make(value)
        assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    "make",
    [
        lambda: GridSky(flux=-1 * u.Jy),
        lambda: GridSky(centre_flux=-1 * u.Jy),
        lambda: FaradaySky(flux=-1 * u.Jy),
    ],
)
def test_a_negative_flux_of_a_generated_sky_is_said(make):
    with pytest.warns(InstrumentWarning, match=r"flux = .*a negative flux is taken as it stands"):
        make()


def test_usual_skies_say_nothing():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for sky in (GridSky(), RandomSky(), FaradaySky(), MockField()):
            sky.about(Direction(2.15, 0.84))
        Catalogue(path="mock_150mhz.csv", brightest=3).about(Direction(2.15, 0.84))
