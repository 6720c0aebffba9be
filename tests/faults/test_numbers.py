"""The one door for numbers, and the one way to say what was not used: values that are none are refused in one line."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument.component import Component
from instrument.errors import InputError, InstrumentWarning, UnitError, UnusedWarning, unused, unused_ledger, warn
from instrument.numbers import COUNT, FINITE, SEED, SHARE, TOLERANCE, UV_RANGE, Count, Real, Seed, UvRange, Whole
from instrument.units import PositiveSeconds, one_si, plain, to_si

OLD = Path(__file__).parent / "old"
NO_NUMBERS = [None, True, np.True_, "2", b"2", 1j, [1], (1,), {}, 3 * u.m, np.array([1, 2]), float("nan"), float("inf")]
DOORS = [COUNT, SEED, FINITE, SHARE, TOLERANCE, Whole(), Real(above=0)]


@pytest.mark.parametrize("door", DOORS, ids=str)
@pytest.mark.parametrize("value", NO_NUMBERS, ids=repr)
def test_what_is_no_number_is_refused_in_one_line(door, value):
    with pytest.raises(InputError, match=r"^speed = .* must be a (finite|whole) number") as said:
        door.check(value, "speed")
    assert "\n" not in str(said.value)
    assert len(str(said.value)) < 150


@pytest.mark.parametrize(
    ("door", "good", "bad"),
    [
        (COUNT, [1, 3.0, np.int32(7), np.array(2)], [0, -1, 2.5]),
        (SEED, [0, 2**70], [-1, 0.5]),
        (SHARE, [0, 1, 0.3, np.float32(0.5)], [-1e-9, 1.0000001]),
        (TOLERANCE, [0, 0.999], [1, -1e-300, 2.0]),
        (Real(above=0), [5e-324], [0, -0.0]),
        (FINITE, [-1e308, 10**22], [10**5000, -(10**5000)]),
    ],
    ids=["count", "seed", "share", "tolerance", "above", "finite"],
)
def test_a_number_passes_exactly_where_it_lies_in_its_range(door, good, bad):
    for value in good:
        assert door.check(value, "x") == value
    for value in bad:
        with pytest.raises(InputError, match=r"^x = "):
            door.check(value, "x")


def test_a_count_comes_out_as_an_int_and_keeps_every_digit():
    assert type(COUNT.check(3.0, "n")) is int
    assert SEED.check(2**63 + 1, "seed") == 2**63 + 1


@pytest.mark.parametrize("value", [(1,), (500, 100), (1, 1), (np.nan, 2), (0, np.inf), "12", (-1, 2), None, ("1", "2")])
def test_a_range_is_two_increasing_numbers(value):
    with pytest.raises(InputError, match=r"uv_range = .* must be two increasing finite numbers of at least 0"):
        UV_RANGE.check(value, "uv_range")
    assert UV_RANGE.check([30, np.float64(800)], "uv_range") == (30.0, 800.0)


class Knobs(Component):
    """Every kind of number as a field."""

    bins: Count = 12
    seed: Seed = 0
    uv_range: UvRange | None = None
    wait: PositiveSeconds = 1.0


def test_fields_go_through_the_same_door():
    assert Knobs(bins=np.int64(3), uv_range=[1, 2]).uv_range == (1.0, 2.0)
    for name in ("bins", "seed", "uv_range"):
        for value in (True, "2", -1, np.nan):
            with pytest.raises(InputError, match=rf"{name} = .* must be"):
                Knobs(**{name: value})
    with pytest.raises(InputError, match="wait = 0 s must be above 0 s"):
        Knobs(wait=0 * u.s)
    assert Knobs.from_json(Knobs(seed=2**70).to_json()) == Knobs(seed=2**70)


def test_quantities_are_finite_real_and_within_their_range():
    assert to_si("2 km", "m") == 2000
    for value, text in ((np.nan * u.m, "finite"), ("inf m", "finite"), (1j * u.m, "real"), (-1 * u.m, "at least 0")):
        with pytest.raises(InputError, match=text):
            to_si(value, "m", "height", at_least=0)
    with pytest.raises(InputError, match="takes one value"):
        one_si([1, 2] * u.m, "m", "height")
    with pytest.raises(UnitError, match=r"'a{50,56}\.\.\. is not a number with a unit"):
        to_si(["a" * 999], "m")


def test_arrays_of_numbers_hold_no_text_and_lose_nothing():
    assert plain([1, 2], float, "x").dtype == float
    for value, dtype in ((["1"], float), ([1j], float), ([1.5], int), ([None], float), ([1] * u.m, float)):
        with pytest.raises(InputError, match=r"^x "):
            plain(value, dtype, "x")
    with pytest.raises(InputError, match="x must be finite"):
        plain([np.nan], float, "x", finite=True)
    with pytest.raises(InputError, match="x must be at least 0, got -1"):
        plain([2, -1], float, "x", at_least=0)


# What was not used -----------------------------------------------------------------------------------------------


def test_what_was_not_used_stands_in_a_warning_and_in_the_ledger():
    with (
        unused_ledger() as ledger,
        pytest.warns(UnusedWarning, match=r"a\.csv: not used: alpha, note \(no such column\)"),
    ):
        unused("a.csv", ["alpha", "note"], "no such column")
        unused("a.csv", ["note"])
        unused("b.csv", [])
    assert ledger == {"a.csv": ["alpha", "note"]}


def test_a_warning_points_at_the_line_of_the_user():
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        warn("look here")
    assert (said[0].filename, said[0].category) == (__file__, InstrumentWarning)


# Tags by public name ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["scene_lofar", "scene_composed"])
def test_i2_scenes_written_with_module_paths_still_load_and_are_written_by_public_name(name):
    scene = instrument.Scene.from_json((OLD / f"{name}.json").read_text())
    assert '"component"' not in scene.to_json()
    assert instrument.Scene.from_json(scene.to_json()) == scene
    assert Component.from_json(scene.to_json()) == scene
    if name == "scene_lofar":
        assert scene.to_dict()["instrument"]["kind"] == "lofar-hba"
        assert scene.to_dict()["instrument"]["phase"] == "fringe"  # a scene that does not say
        assert scene.to_dict()["instrument"]["element"] == {"kind": "dipole", "height": "0.5 m", "x_azimuth": "0.0 rad"}


def test_i2_settings_of_an_analysis_written_before_still_load():
    found = instrument.CubeAnalysis.from_json((OLD / "cube_analysis.json").read_text())
    assert (found.remove, found.remover) == ("gmca", {"components": 3})


@pytest.mark.parametrize("tag", ["kind", "component"])
@pytest.mark.parametrize("text", ["antigravity:X", "this:s", "os:path", "antigravity", "this.X"])
def test_i2_no_text_imports_a_module(tag, text):
    import sys

    before = set(sys.modules)
    with pytest.raises(InputError, match=r"is called|must name a class|has no 'component'"):
        Component.from_json(f'{{"{tag}": "{text}"}}')
    assert {"antigravity", "this"} & (set(sys.modules) - before) == set()


def test_g2_an_element_is_given_by_kind_with_its_settings():
    lofar = instrument.load(
        "telescopes", "lofar-hba", stations=["CS001HBA0", "CS002HBA0"], element={"kind": "dipole", "height": "0.5 m"}
    )
    assert lofar.element.height == 0.5
    with pytest.raises(InputError, match="no element is called 'dipol': did you mean 'dipole'"):
        instrument.load("telescopes", "lofar-hba", element={"kind": "dipol"})
    with pytest.raises(InputError, match="did you mean 'height'"):
        instrument.load("telescopes", "lofar-hba", element={"kind": "dipole", "hight": "0.5 m"})
