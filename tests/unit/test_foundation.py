"""Component and the units at its door: what it takes, what it refuses in one line, and what comes back from JSON."""

import json
import pickle
from abc import abstractmethod
from typing import Annotated, Any, ClassVar

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.time import Time
from instrument_plugins.elements.dipole import CrossedDipole
from instrument_plugins.elements.dish import Airy, Gaussian
from instrument_plugins.elements.hamaker import Hamaker
from instrument_plugins.telescopes.lofar import LofarHBA
from pydantic import Field

import instrument
from instrument import Chain, Composed, FeedTerm, GainTerm, Layout, Observation, Parallactic, Scene
from instrument.component import Component
from instrument.errors import InputError, Outcome, PluginError, UnitError, did_you_mean
from instrument.jones.base import ElementBeam, JonesTerm
from instrument.model import Instrument
from instrument.units import (
    ArrayOf,
    Direction,
    HertzArray,
    Instant,
    Metres,
    Radians,
    Seconds,
    SkyDirection,
    si_prefix,
    to_si,
)

STATIONS = ["CS001HBA0", "CS001HBA1", "RS106HBA"]


class Shape(Component):
    """Abstract."""

    @abstractmethod
    def area(self):
        """In m2."""


class Disc(Shape):
    radius: Annotated[Metres, Field(gt=0)]

    def area(self):
        return np.pi * self.radius**2


class Square(Shape):
    side: Metres

    def area(self):
        return self.side**2


class Everything(Component):
    """One field of each kind."""

    shape: Shape = Disc(radius=1 * u.m)
    shapes: tuple[Shape, ...] = ()
    length: Metres = 1.0
    wait: Seconds | None = None
    channels: HertzArray = np.array([1.5e8])
    angle: Radians = 0.25
    towards: SkyDirection | None = None
    when: Instant | None = None
    table: Annotated[Any, ArrayOf(complex, (None, 2))] = np.zeros((1, 2), complex)
    name: str = "x"


FULL = {
    "shape": Square(side=2 * u.km),
    "shapes": (Disc(radius=1 * u.cm), Square(side=3 * u.m)),
    "length": 3 * u.lyr,
    "wait": 2 * u.min,
    "channels": [120.1, 150.2] * u.MHz,
    "angle": 10 * u.arcmin,
    "towards": SkyCoord(123.4 * u.deg, 48.2175 * u.deg),
    "when": Time("2012-12-07T01:02:03.123456"),
    "table": np.array([[1 + 2j, 1 / 3], [np.pi * 1j, 1e-300]]),
    "name": "full",
}


# Units at the door -----------------------------------------------------------------------------------------------


def test_a_bare_number_is_refused_naming_field_unit_and_remedy():
    with pytest.raises(InputError, match=r"diameter needs a unit convertible to m, got the bare 30\.8; write it with"):
        Airy(diameter=30.8)


def test_a_unit_of_another_kind_is_refused_naming_the_value():
    with pytest.raises(InputError, match=r"diameter needs a unit convertible to m, got '30\.8 s'"):
        Airy(diameter=30.8 * u.s)


@pytest.mark.parametrize("given", [30.8 * u.m, 3080 * u.cm, "30.8 m", "0.0308 km", np.float32(30.8) * u.m])
def test_a_quantity_or_a_string_with_a_unit_is_stored_in_si(given):
    assert Airy(diameter=given).diameter == pytest.approx(30.8, rel=1e-7)  # the float32 one has 24 bits


@pytest.mark.parametrize("given", ["30.8", "thirty m", "30.8 metre and a bit", "", "30.8 MHz", None, True, [30.8]])
def test_what_is_not_a_length_is_refused_in_one_line(given):
    with pytest.raises(InputError, match="diameter") as caught:
        Airy(diameter=given)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("given", [0 * u.m, -1 * u.m, np.nan * u.m, np.inf * u.m, [1, 2] * u.m])
def test_an_impossible_length_is_refused(given):
    with pytest.raises(InputError, match="diameter"):
        Airy(diameter=given)


def test_a_list_of_strings_with_units_is_an_array():
    assert Everything(channels=["120 MHz", "0.15 GHz"]).channels.tolist() == [120e6, 150e6]


def test_a_table_of_frequencies_is_refused_where_a_list_is_wanted():
    with pytest.raises(InputError, match=r"channels takes a list of values, got \(1, 2\)"):
        Everything(channels=[[1, 2]] * u.MHz)


def test_to_si_refuses_with_the_error_of_units():
    with pytest.raises(UnitError, match="sefd needs a unit convertible to Jy"):
        to_si(2820, "Jy", "sefd")


@pytest.mark.parametrize("given", ["somewhere", SkyCoord([1, 2] * u.deg, [1, 2] * u.deg), 3.0, "08h13m36.0s"])
def test_what_is_not_one_direction_is_refused(given):
    with pytest.raises(InputError, match="towards"):
        Everything(towards=given)


def test_a_direction_is_icrs_in_radians_whatever_frame_it_came_in():
    galactic = SkyCoord(123.4 * u.deg, 48.2175 * u.deg).galactic
    found = Everything(towards=galactic).towards
    # 1e-12 rad: two rotations between frames
    np.testing.assert_allclose(found, np.deg2rad([123.4, 48.2175]), rtol=1e-12)


@pytest.mark.parametrize("given", ["yesterday", 3, Time(["2012-12-07", "2012-12-08"])])
def test_what_is_not_one_time_is_refused(given):
    with pytest.raises(InputError, match="when"):
        Everything(when=given)


def test_an_array_field_never_drops_a_unit():
    # refused or converted: 1 km taken for 1 m is a wrong answer that looks fine
    try:
        found = Layout(names=("a", "b"), positions_m=[[0, 0, 0], [1, 1, 1]] * u.km, axes=[np.eye(3)] * 2)
    except InputError:
        return
    assert found.positions_m.max() == 1000.0


def test_positions_with_a_unit_are_not_taken_for_metres():
    site = (0.12 * u.rad, 0.92 * u.rad, 50 * u.m)
    with pytest.raises(InputError, match="enu needs a unit"):
        Layout.from_enu(["a", "b"], [[0, 0, 0], [1, 0, 0]], *site)
    found = Layout.from_enu(["a", "b"], [[0, 0, 0], [1, 0, 0]] * u.km, *site)
    assert found.longest_m == pytest.approx(1000.0)


@pytest.mark.parametrize("given", [Direction(np.nan, 0.1), Direction(0.1, np.inf), Direction(0.1, 3.0)])
def test_a_direction_that_is_none_is_refused_in_every_form(given):
    with pytest.raises(InputError, match="towards"):
        Everything(towards=given)


# Fields ----------------------------------------------------------------------------------------------------------


def test_an_unknown_field_is_refused_with_the_nearest_known_one():
    with pytest.raises(InputError, match="Airy has no 'diamter': did you mean 'diameter'"):
        Airy(diamter=30 * u.m)


def test_a_missing_field_is_named():
    with pytest.raises(InputError, match="Airy needs 'diameter'"):
        Airy()


def test_a_field_cannot_be_changed():
    dish = Airy(diameter=25 * u.m)
    with pytest.raises(InputError, match="frozen"):
        dish.diameter = 30.0
    assert dish.diameter == 25.0


def test_arrays_are_copied_in_and_read_only():
    mine = np.ones((1, 1, 2, 2), complex)
    gain = GainTerm(values=mine)
    mine[...] = 5
    assert gain.values.max() == 1
    with pytest.raises(ValueError, match="read-only"):
        gain.values[...] = 5


def test_an_array_of_another_shape_is_refused_naming_both():
    with pytest.raises(InputError, match=r"values has shape \(1, 1, 2, 3\), needed \(any, any, any, 2\)"):
        GainTerm(values=np.ones((1, 1, 2, 3)))


def test_an_abstract_component_cannot_be_made():
    with pytest.raises(TypeError, match="abstract"):
        Shape()


def test_a_component_of_another_kind_is_refused_naming_the_field():
    with pytest.raises(InputError, match="element"):
        LofarHBA(stations=STATIONS, element=Parallactic())


# Equality --------------------------------------------------------------------------------------------------------


def test_components_are_equal_when_their_fields_are_arrays_included():
    one, other = (GainTerm(values=np.ones((1, 1, 2, 2))) for _ in range(2))
    assert one == other
    assert hash(one) == hash(other)
    assert one.fingerprint() == other.fingerprint()
    assert one != GainTerm(values=np.ones((1, 1, 3, 2)))
    assert one != GainTerm(values=np.full((1, 1, 2, 2), 1 + 1e-16j))
    assert one != GainTerm()
    assert one != FeedTerm(values=np.ones((1, 1, 2, 2)))
    assert one != 3


def test_equal_components_have_equal_hashes():
    # or they are two keys of one dictionary
    plus, minus = (Everything(table=np.full((1, 2), zero)) for zero in (0.0, -0.0))
    assert plus == minus
    assert hash(plus) == hash(minus)


def test_nan_in_an_array_equals_itself():
    table = np.array([[np.nan, 1.0]])
    assert Everything(table=table) == Everything(table=table)


def test_components_inside_tuples_are_compared():
    gain = GainTerm(values=np.ones((1, 1, 2, 2)))
    assert Chain(gain, Hamaker(), Parallactic()) == Chain(gain, Hamaker(), Parallactic())
    assert Chain(gain) != Chain(gain, gain)


# JSON ------------------------------------------------------------------------------------------------------------


def test_every_kind_of_field_comes_back_from_json_as_it_was():
    full = Everything(**FULL)
    back = Everything.from_json(full.to_json(indent=1))
    assert back == full
    assert type(back.shape) is Square
    assert [type(s) for s in back.shapes] == [Disc, Square]
    # bit for bit, but times: 1 ns
    assert back.table.tobytes() == full.table.tobytes()
    assert back.towards == full.towards
    assert abs((back.when - full.when).to_value("s")) < 1e-9
    assert not back.table.flags.writeable


def test_values_with_units_are_written_with_their_units():
    assert json.loads(Disc(radius=2 * u.cm).to_json()) == {
        "kind": "Disc",
        "radius": "0.02 m",
    }


@pytest.mark.parametrize("value", [1e-300, 1 / 3, 1e300, 5e-324, -0.0])
def test_extreme_numbers_come_back_bit_for_bit(value):
    back = Square.from_json(Square(side=value * u.m).to_json())
    assert np.float64(back.side).tobytes() == np.float64(value).tobytes()


@pytest.mark.parametrize("value", [complex(1, np.inf), complex(-np.inf, -0.0), complex(np.nan, 2)])
def test_extreme_complex_numbers_come_back_bit_for_bit(value):
    full = Everything(table=np.full((1, 2), value))
    assert Everything.from_json(full.to_json()).table.tobytes() == full.table.tobytes()


def test_any_direction_comes_back_from_json_bit_for_bit():
    # else a scene is another one after it has been written: its fingerprint, by which runs are resumed, differs
    rng = np.random.default_rng(0)
    given = [Direction(*x) for x in zip(rng.uniform(0, 6.28, 50), np.arcsin(rng.uniform(-1, 1, 50)), strict=True)]
    changed = [d for d in given if Everything.from_json(Everything(towards=d).to_json()).towards != d]
    assert changed == []


@pytest.mark.parametrize(
    "when",
    [
        Time(56268.1234567, format="mjd"),
        Time(2456268.5, 0.1 + 1e-16, format="jd"),
        Time("2012-12-07", out_subfmt="date") + 0.4 * u.day,  # as times counted from a transit are
    ],
    ids=["mjd", "jd", "of a day"],
)
def test_any_time_comes_back_from_json_equal(when):
    given = Everything(when=when)
    back = Everything.from_json(given.to_json())
    assert abs((back.when - when).to_value("ns")) < 1
    assert back == given


def test_json_read_by_an_abstract_class_gives_the_right_subclass():
    hba = LofarHBA(stations=STATIONS, element=CrossedDipole(height=1 * u.m), beam="element", gain=GainTerm(rms=1e-3))
    back = Instrument.from_json(hba.to_json())
    assert type(back) is LofarHBA
    assert type(back.element) is CrossedDipole
    assert back == hba
    assert JonesTerm.from_json(Airy(diameter=3 * u.m).to_json()) == Airy(diameter=3 * u.m)


def test_a_whole_scene_comes_back_from_json():
    scene = Scene(
        instrument=Composed(
            stations=LofarHBA(stations=STATIONS).layout(), terms=Chain(GainTerm(rms=0.1), Hamaker(), Parallactic())
        ),
        sky=instrument.load("skies", "grid", shape=(3, 3)),
        observation=Observation(
            phase_centre="08h13m36.0s +48d13m03s",
            start="2012-12-07T23:00:00.25",
            duration=1 * u.hour,
            interval=10 * u.s,
            frequencies=[150] * u.MHz,
            channel_width=195.3125 * u.kHz,
        ),
    )
    assert Scene.from_json(scene.to_json()) == scene


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not JSON"),
        ("[1, 2]", r"^JonesTerm = \[1, 2\] must be a table$"),
        ('{"kind": "os:path"}', "no term is called 'os:path'"),
        ('{"kind": 3}', "kind = 3 must be the name of a class"),
        ('{"kind": "GianTerm"}', "did you mean 'GainTerm'"),
        ('{"kind": "Layout"}', "'Layout' is Layout, which is not a JonesTerm"),
        ('{"component": "os:path"}', "no term is called 'os:path'"),
        ('{"component": "no.such.module:X"}', "no term is called"),
        ('{"component": "instrument.jones.gain:NoSuchTerm"}', "no term is called"),
        ('{"component": "instrument.jones.gain:GainTerm", "rsm": 1}', "did you mean 'rms'"),
        ('{"component": "instrument.observe.layout:Layout"}', "is not a"),
        ("{}", "kind"),
    ],
)
def test_text_that_is_not_a_component_is_refused(text, message):
    with pytest.raises(InputError, match=message):
        JonesTerm.from_json(text)


def test_a_pickled_component_is_equal_and_still_read_only():
    # blocks travel to other processes this way
    gain = GainTerm(values=np.ones((1, 1, 2, 2)))
    back = pickle.loads(pickle.dumps(gain))
    assert back == gain
    assert not back.values.flags.writeable


# with_fields -----------------------------------------------------------------------------------------------------


def test_with_fields_changes_what_is_given_and_keeps_the_rest():
    full = Everything(**{**FULL, "wait": None})
    other = full.with_fields(name="other", length=5 * u.m)
    assert (other.name, other.length) == ("other", 5.0)
    assert full.name == "full"
    assert other.with_fields(name="full", length=full.length * u.m) == full


def test_with_fields_keeps_an_optional_value_with_a_unit():
    dish = Gaussian(fwhm=3 * u.deg, frequency=150 * u.MHz)
    assert dish.with_fields(fwhm=2 * u.deg).frequency == 150e6


def test_with_fields_validates_like_the_first_time():
    with pytest.raises(InputError, match="length needs a unit convertible to m"):
        Everything().with_fields(length=3.0)
    with pytest.raises(InputError, match="Everything has no 'lenght': did you mean 'length'"):
        Everything().with_fields(lenght=3 * u.m)


def test_with_fields_takes_a_field_by_the_name_it_was_given_by():
    assert LofarHBA(stations=STATIONS).with_fields(beam="element") == LofarHBA(stations=STATIONS, beam="element")


# Plugins by name -------------------------------------------------------------------------------------------------


def test_a_field_takes_a_plugin_by_its_name():
    assert LofarHBA(stations=STATIONS, element="hamaker").element == Hamaker()


def test_a_plugin_that_does_not_exist_is_refused_with_the_nearest():
    with pytest.raises(InputError, match="no element is called 'hamakr': did you mean 'hamaker'"):
        LofarHBA(stations=STATIONS, element="hamakr")


def test_a_plugin_that_needs_settings_says_which():
    with pytest.raises(InputError, match=r"element: Airy needs 'diameter'|element.*diameter"):
        LofarHBA(stations=STATIONS, element="airy")


def test_a_plugin_of_another_kind_is_refused(monkeypatch):
    import instrument.registry as registry

    monkeypatch.setattr(registry, "_resolve", lambda kind, name: Parallactic)

    class Holder(Component):
        element: ElementBeam

    with pytest.raises(InputError, match=r"Parallactic is not an? ElementBeam"):
        Holder(element="hamaker")


# Errors ----------------------------------------------------------------------------------------------------------


def test_input_errors_are_value_errors():
    # so that a caller who knows nothing of this package catches them
    assert issubclass(InputError, ValueError)
    assert issubclass(UnitError, InputError)
    assert issubclass(PluginError, InputError)


def test_did_you_mean_names_the_nearest_and_lists_a_dozen():
    assert did_you_mean("beem", ["beam", "gain"]) == "did you mean 'beam'? (known: beam, gain)"
    assert did_you_mean("CS001hba0", ["CS001HBA0"]).startswith("did you mean 'CS001HBA0'")
    assert did_you_mean("qqq", ["beam"]) == "known: beam"
    assert did_you_mean("x", []) == "none is known"
    assert did_you_mean("zz", map(str, range(20))).endswith("and 8 more")


def test_only_a_converged_outcome_passes_its_check():
    Outcome.CONVERGED.check()
    for outcome in set(Outcome) - {Outcome.CONVERGED}:
        with pytest.raises(instrument.InstrumentError, match=str(outcome.value)[:20]):
            outcome.check()


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (7.2e10, "72 GFlop"),
        (999, "999 Flop"),
        (1e3, "1 kFlop"),
        (0, "0 Flop"),
        (2.5e16, "25 PFlop"),
        (-3e6, "-3 MFlop"),
    ],
)
def test_si_prefix_keeps_three_digits(value, text):
    assert si_prefix(value, "Flop") == text


def test_direction_goes_to_a_unit_vector_and_to_astropy():
    pole = Direction(1.0, np.pi / 2)
    np.testing.assert_allclose(pole.vector, [0, 0, 1], atol=1e-16)
    assert Direction(*np.deg2rad([123.4, 48.2175])).skycoord.separation(FULL["towards"]).arcsec < 1e-9


def test_layout_counts_its_stations_and_finds_them():
    layout = LofarHBA(stations=STATIONS).layout()
    assert isinstance(layout, Layout)
    assert (len(layout), layout.index("RS106HBA")) == (3, 2)
    with pytest.raises(InputError, match="no station 'RS105HBA': did you mean 'RS106HBA'"):
        layout.index("RS105HBA")


class Unhashable(Component):
    """A component is hashable whatever it holds."""

    kind: ClassVar[str] = "x"
    numbers: list[int] = Field(default_factory=lambda: [1, 2])


def test_components_can_be_keys():
    assert {Unhashable(): 1}[Unhashable(numbers=[1, 2])] == 1
