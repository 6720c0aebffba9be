"""Where antennas are, which chain is in the data, how long is observed, and numbers at the door (faults B1 to B7)."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from instrument_plugins.elements.dipole import CrossedDipole

import instrument
from instrument import (
    Chain,
    Composed,
    FeedTerm,
    GainTerm,
    InputError,
    Instrument,
    JonesTerm,
    Layout,
    Observation,
    PointSky,
    Sampling,
    Scene,
    Towards,
    conformance,
    mat2,
)
from instrument.errors import BeamStateError, InstrumentWarning
from instrument.jones.parallactic import Parallactic
from instrument.observe.layout import geodetic_axes
from instrument.units import Direction
from instrument.visibilities import Visibilities

C196 = SkyCoord("08h13m36.0s +48d13m03s")
SITE = (6.87 * u.deg, 52.9 * u.deg, 50 * u.m)
ENU = np.array([[0, 0, 0], [100, 0, 0.0]])


def night(**fields):
    fields = {
        "transit": "2012-12-07",
        "duration": 20 * u.s,
        "interval": 10 * u.s,
        "frequencies": [150] * u.MHz,
    } | fields
    return Observation(phase_centre=C196, **fields)


# B1, B2: where antennas are and which way they stand ------------------------------------------------------------------


@pytest.mark.parametrize(
    "positions",
    [ENU, np.array([[3826.9, 460.9, 5064.6], [3826.8, 460.9, 5064.6]]), np.array([[6.5e6, 0, 0], [6.5e6, 9, 0]])],
)
def test_b1_geodetic_positions_lie_on_the_earth(positions):
    """Offsets in m about a site, ITRF in km: up would be (0, 0, 1) or nonsense, 100 deg off."""
    with pytest.raises(InputError, match=r"'a' .* from the centre of the Earth.*from_enu") as error:
        Layout.geodetic(("a", "b"), positions)
    assert "\n" not in str(error.value)


def test_b1_the_same_offsets_about_a_site_see_3c196_where_it_is():
    layout = Layout.from_enu(("a", "b"), ENU * u.m, *SITE)
    assert np.allclose(Layout.geodetic(("a", "b"), layout.positions_m).axes, layout.axes, atol=1e-4)
    times = night().times(layout)
    at = Sampling.build(layout, times, 150e6, *np.deg2rad([[C196.ra.deg], [C196.dec.deg]]), Direction(2.15, 0.84))
    # at culmination: latitude minus declination; the axes are those of the ellipsoid
    assert np.rad2deg(at.zenith_angle[0, 0, 0]) == pytest.approx(52.9 - 48.2175, abs=0.1)


def test_b1_a_layout_in_the_middle_of_the_earth_is_refused_with_axes_too():
    with pytest.raises(InputError, match="from the centre of the Earth"):
        Layout(names=("a", "b"), positions_m=ENU, axes=[np.eye(3)] * 2)


def standing(axes):
    positions = Layout.from_enu(("a", "b"), ENU * u.m, *SITE).positions_m
    return Layout(names=("a", "b"), positions_m=positions, axes=axes)


def test_b2_axes_are_right_handed_with_the_third_one_up():
    east, north, up = geodetic_axes(standing(geodetic_axes(np.repeat(upright(), 2, 0))).positions_m)[0]
    right = standing([[east, north, up]] * 2)
    turned = standing([[north, -east, up]] * 2)  # the same antennas turned by 90 deg: right-handed
    for wrong, word in (
        ([north, east, up], "left-handed"),
        ([east, north, -up], "left-handed"),
        ([north, up, east], "deg from the vertical"),
        ([up, east, north], "deg from the vertical"),
        ([east, -north, -up], "deg from the vertical"),
    ):
        with pytest.raises(InputError, match=f"'a'.*{word}"):
            standing([wrong, wrong])
    # the dipole of the note's example: with p east and q north
    times = night().times(right)
    dipole = Chain(CrossedDipole(height=0.5 * u.m), Parallactic())
    j, other = (
        dipole.jones(Sampling.build(x, times, 150e6, np.array([2.4]), np.array([0.7]), Direction(2.15, 0.84)))
        for x in (right, turned)
    )
    rotation = np.array([[0, 1], [-1, 0]])  # p of the turned one is q of the other, q is -p
    assert np.abs(other[0, 0, 0, 0] - rotation @ j[0, 0, 0, 0]).max() < 1e-12


def upright():
    return np.array([[3826577.0, 461022.0, 5064892.0]])


def test_b2_a_tilt_of_some_degrees_is_a_tilt():
    for degrees, fine in ((0.0, True), (9.0, True), (11.0, False)):
        c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
        axes = np.array([[1, 0, 0], [0, c, s], [0, -s, c]]) @ geodetic_axes(standing_position())
        if fine:
            standing(axes)
        else:
            with pytest.raises(InputError, match="11 deg from the vertical"):
                standing(axes)


def standing_position():
    return Layout.from_enu(("a", "b"), ENU * u.m, *SITE).positions_m


@pytest.mark.parametrize(
    "latitude, height", [(190 * u.deg, 0 * u.m), (np.nan * u.deg, 0 * u.m), (50 * u.deg, 1 * u.R_earth)]
)
def test_b1_a_site_is_on_the_earth(latitude, height):
    with pytest.raises(InputError, match=r"latitude|height"):
        Layout.from_enu(("a", "b"), ENU * u.m, 0 * u.deg, latitude, height)


# B3: which chain is in the data ---------------------------------------------------------------------------------------

STATIONS = ["CS001HBA0", "CS003HBA1", "RS106HBA"]


def lofar(**fields):
    return instrument.load("telescopes", "lofar-hba", stations=STATIONS, **fields)


@pytest.fixture(scope="module")
def seen():
    """The same sky with the full beam, the element alone, and none."""
    sky = PointSky.at(C196, [1.0])
    made = {
        beam: Scene(instrument=lofar(beam=beam), sky=sky, observation=night()) for beam in ("full", "element", None)
    }
    return {beam: scene.plan(workers=1).run() for beam, scene in made.items()}


def test_b3_a_beam_that_is_not_in_the_data_is_not_taken_out(seen):
    for taken in (
        lambda: seen[None].without_beam(lofar()),
        lambda: seen[None].corrected(Towards(chain=lofar().chain())),
        lambda: seen["element"].without_beam(lofar()),
        lambda: seen["full"].without_beam(lofar(beam="element")),
    ):
        with pytest.raises(BeamStateError):
            taken()
    assert "no beam" in str(seen[None])


def test_b3_the_beam_that_is_in_the_data_is_taken_out(seen):
    for beam in ("full", "element"):
        # other gains: they are no part of the beam
        left = seen[beam].without_beam(lofar(beam=beam, gain=GainTerm(rms=0.1, seed=1)))
        assert np.abs(left.stokes()[..., 0] - 1).max() < 1e-12
        assert left.beam_state.removed == "centre"
    same = seen[None].without_beam(lofar(beam=None))
    assert np.array_equal(same.data, seen[None].data)


def test_b3_blocks_and_blocks_that_are_predicted_know_their_chain_too():
    scene = Scene(instrument=lofar(beam=None), sky=PointSky.at(C196, [1.0]), observation=night())
    for block in scene.plan(workers=1).blocks():
        with pytest.raises(BeamStateError):
            block.without_beam(lofar())


def test_b3_another_beam_on_purpose_is_taken_out_with_a_word(seen):
    with pytest.warns(InstrumentWarning, match="not the beam that is in the data"):
        left = seen["full"].corrected(Towards(chain=lofar(beam="element").chain().beams()))
    assert "another" in str(left.beam_state)
    with pytest.raises(BeamStateError, match="mix"):
        left - seen["full"].without_beam(lofar())


def test_b3_data_whose_chain_is_not_known_trust_the_user(seen):
    vis = seen["full"]
    unknown = Visibilities(data=vis.data, at=vis.at, antenna1=vis.antenna1, antenna2=vis.antenna2, interval_s=10.0)
    assert np.abs(unknown.without_beam(lofar()).stokes()[..., 0] - 1).max() < 1e-12


class Both(JonesTerm):
    """A composite that hides what it holds: gains times the beam towards the centre."""

    maps = ("sky", "feed")
    directional = False
    gain: GainTerm
    beam: JonesTerm

    def jones(self, at):
        """Their product."""
        return mat2.mul(self.gain.jones(at), self.beam.jones(at))


class TakenApart(Both):
    """The same, that says what it is the product of."""

    def parts(self):
        """Gain and beam."""
        return (self.gain, *self.beam.parts())


@pytest.mark.parametrize("kind", [Both, TakenApart])
@pytest.mark.parametrize("deep", [False, True])
def test_b3_a_beam_inside_a_composite_term_is_not_taken_out_twice(seen, kind, deep):
    term = kind(gain=GainTerm(), beam=Towards(chain=lofar().chain().beams()))
    term = kind(gain=GainTerm(), beam=term) if deep else term
    for given in (term, Chain(term)):
        left = seen["full"].corrected(given)
        assert left.beam_state.removed == "centre"
        with pytest.raises(BeamStateError, match="taken out already"):
            left.without_beam(lofar())
        with pytest.raises(BeamStateError):
            seen[None].corrected(given)
        back = left.corrupted(given)
        assert back.beam_state.removed == "nothing"
        assert np.abs(back.data - seen["full"].data).max() < 1e-12


def test_b3_a_beam_is_not_put_on_twice(seen):
    beam = Towards(chain=lofar().chain().beams())
    with pytest.raises(BeamStateError, match="in the data already"):
        seen["full"].corrupted(beam)
    put = seen[None].corrupted(beam)
    assert np.abs(put.without_beam(lofar()).data - seen[None].data).max() < 1e-12


# B4: how long is observed ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "duration, interval, nearest",
    [
        (25 * u.s, 10 * u.s, "20 s or 30 s"),
        (15 * u.min, 10 * u.min, "600 s or 1200 s"),
        (11 * u.s, 10 * u.s, "10 s or 20 s"),
    ],
)
def test_b4_a_duration_that_is_no_whole_number_of_intervals_names_the_two_nearest(duration, interval, nearest):
    with pytest.raises(InputError, match=f"duration .*{nearest}"):
        night(duration=duration, interval=interval)


@pytest.mark.parametrize(
    "duration, interval, count", [(8 * u.h, 10 * u.s, 2880), (0.3 * u.s, 0.1 * u.s, 3), (1 * u.h, 1 / 3 * u.min, 180)]
)
def test_b4_rounding_does_not_decide_whether_it_is_whole(duration, interval, count):
    assert night(duration=duration, interval=interval).count == count


def test_b4_integrations_are_not_shorter_than_times_resolve():
    with pytest.raises(InputError, match="microsecond"):
        night(duration=1e-5 * u.s, interval=1e-6 * u.s).times(Forgetful().layout())


# B5: how wide a channel is --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mhz", [[120, 180], [120, 150, 180], [50, 60], [130, 140, 150]])
def test_b5_channels_that_are_not_adjacent_need_a_width(mhz):
    observation = night(frequencies=mhz * u.MHz)
    assert observation.width_hz is None
    scene = Scene(instrument=lofar(beam=None), sky=PointSky.at(C196, [1.0]), observation=observation)
    with pytest.raises(InputError, match="channel_width"):
        scene.plan(workers=1).run().with_noise(1e3 * u.Jy, seed=1)
    given = night(frequencies=mhz * u.MHz, channel_width=0.2 * u.MHz)
    vis = Scene(instrument=lofar(beam=None), sky=PointSky.at(C196, [1.0]), observation=given).plan(workers=1).run()
    assert vis.noise_jy(1e3 * u.Jy) == pytest.approx(1e3 / np.sqrt(2 * 0.2e6 * 10))


def test_b5_the_spacing_of_adjacent_channels_is_their_width():
    assert night(frequencies=[150, 150.2, 150.4] * u.MHz).width_hz == pytest.approx(0.2e6)
    assert night(frequencies=[150.4, 150, 150.2] * u.MHz).width_hz == pytest.approx(0.2e6)
    assert night(frequencies=[150, 151, 155] * u.MHz).width_hz == pytest.approx(1e6)  # some are missing
    assert night(frequencies=[150] * u.MHz).width_hz is None


# B6: gains that a chain forgets ---------------------------------------------------------------------------------------


class Forgetful(Instrument):
    """Its chain leaves out gain and feed."""

    def layout(self):
        """Two stations."""
        return Layout.from_enu(("a", "b"), ENU * u.m, *SITE)

    def chain(self):
        """A dipole."""
        return Chain(CrossedDipole(height=0.5 * u.m), Parallactic())


class Careful(Forgetful):
    """Its chain begins with its receivers."""

    def chain(self):
        """Receivers and a dipole."""
        return Chain(*self.receivers(), CrossedDipole(height=0.5 * u.m), Parallactic())


@pytest.mark.parametrize("error", [{"gain": GainTerm(rms=0.5, seed=1)}, {"feed": FeedTerm(rms=0.5, seed=1)}])
def test_b6_gains_and_feeds_that_a_chain_forgets_are_put_in(error):
    sky = PointSky.at(C196, [1.0])
    for action in (
        lambda array: Scene(instrument=array, sky=sky, observation=night()).plan(workers=1).run().data,
        lambda array: array.beam(C196, "2012-12-07T02:00:00", 150 * u.MHz),
    ):
        forgetful = action(Forgetful(**error))
        assert np.array_equal(forgetful, action(Careful(**error)))
        assert not np.allclose(forgetful, action(Forgetful()))


def test_b6_every_instrument_has_its_gain_and_feed_in_its_chain():
    both = {"gain": GainTerm(rms=0.5, seed=1), "feed": FeedTerm(rms=0.5, seed=1)}
    for kind in (Forgetful, Careful):
        assert [type(t).__name__ for t in kind(**both).chain().terms[:2]] == ["GainTerm", "FeedTerm"]
        assert len(kind(**both).chain().terms) == 4
    for array in (Forgetful(), Careful(), Composed(stations=Forgetful().layout())):
        assert conformance.check(array).passed


# B7: numbers at the door ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "frequency", [0 * u.MHz, np.nan * u.MHz, -150 * u.MHz, np.inf * u.Hz, 150, "150", [150e6, 0] * u.Hz]
)
def test_b7_a_beam_is_asked_at_positive_frequencies(frequency):
    with pytest.raises(InputError, match="frequencies"):
        lofar().beam(C196, "2012-12-07T02:00:00", frequency, pointing=C196)
    with pytest.raises(InputError, match="frequencies"):
        lofar().mueller(C196, "2012-12-07T02:00:00", frequency, pointing=C196)


def some(seen, **fields):
    return replace(seen["full"], **fields)


@pytest.mark.parametrize(
    "fields, name",
    [
        ({"weight": np.full((1, 1, 1), np.nan)}, "weight"),
        ({"weight": np.full((1, 1, 1), -1.0)}, "weight"),
        ({"weight": np.full((1, 1, 1), np.inf)}, "weight"),
        ({"weight": np.full((1, 1, 1), "1")}, "weight"),
        ({"flag": np.full((1, 1, 1), 2.5)}, "flag"),
        ({"interval_s": np.nan}, "interval_s"),
        ({"interval_s": 0.0}, "interval_s"),
        ({"interval_s": "10"}, "interval_s"),
        ({"width_hz": -1.0}, "width_hz"),
        ({"width_hz": True}, "width_hz"),
        ({"antenna1": np.array([0, 0, 7])}, "antenna1"),
        ({"antenna2": np.array([-1, 1, 2])}, "antenna2"),
    ],
)
def test_b7_numbers_of_visibilities_are_checked_once(seen, fields, name):
    with pytest.raises(InputError, match=name) as error:
        some(seen, **fields)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("seed", [-1, 1.5, "2", True, None, np.nan])
def test_b7_a_seed_is_a_whole_number_that_is_not_negative(seen, seed):
    with pytest.raises(InputError, match="seed"):
        seen["full"].with_noise(1e3 * u.Jy, seed=seed)
    with pytest.raises(InputError, match="seed"):
        GainTerm(rms=0.1, seed=seed)


@pytest.mark.parametrize("sefd", [-1 * u.Jy, np.nan * u.Jy, np.inf * u.Jy, 1e3, "1e3", [1, 2] * u.Jy, 3 * u.m])
def test_b7_a_system_temperature_is_one_positive_flux(seen, sefd):
    with pytest.raises(InputError, match="sefd"):
        seen["full"].with_noise(sefd, seed=1)


@pytest.mark.parametrize("rms", [-0.1, np.nan, np.inf, "0.1", True, 1e200])
def test_b7_an_rms_is_a_number_that_gains_can_have(rms):
    with pytest.raises(InputError, match="rms"):
        GainTerm(rms=rms)


@pytest.mark.parametrize("field", ["duration", "interval", "channel_width"])
@pytest.mark.parametrize("value", [0 * u.s, -1 * u.s, np.nan * u.s, np.inf * u.s, 10, "10", True, [10, 10] * u.s])
def test_b7_times_and_widths_of_an_observation(field, value):
    if field == "channel_width" and isinstance(value, u.Quantity):
        value = value.value * u.Hz
    with pytest.raises(InputError, match=field):
        night(**{field: value})


@pytest.mark.parametrize("frequencies", [[0] * u.Hz, [-1] * u.Hz, [np.nan] * u.Hz, [], [150], [150, 150] * u.MHz])
def test_b7_frequencies_of_an_observation(frequencies):
    with pytest.raises(InputError, match="frequencies"):
        night(frequencies=frequencies)


@pytest.mark.parametrize(
    "change, name",
    [
        ({"ra": np.nan}, "ra_rad"),
        ({"dec": np.inf}, "dec_rad"),
        ({"freq": 0.0}, "freq_hz"),
        ({"freq": np.nan}, "freq_hz"),
    ],
)
def test_b7_a_sampling_is_at_finite_places(change, name):
    layout = Layout.from_enu(("a", "b"), ENU * u.m, *SITE)
    given = {"freq": 150e6, "ra": 2.0, "dec": 0.8} | change
    with pytest.raises(InputError, match=name):
        Sampling.build(layout, night().times(layout), given["freq"], given["ra"], given["dec"], Direction(2.0, 0.8))


def test_b7_baselines_and_stations_are_asked_by_their_names():
    for baseline in (("CS001HBA0",), ("CS001HBA0", "CS003HBA1", "RS106HBA"), (0, 1), "CS001HBA0", ("CS001HBA0", "no")):
        with pytest.raises(InputError):
            lofar().mueller(C196, "2012-12-07T02:00:00", 150 * u.MHz, baseline=baseline)
