"""Jones terms by name: where they enter a chain, what of them calibration has to find, and a stranger's in a scene."""

import json
import re
from typing import ClassVar

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

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
    Parallactic,
    PointSky,
    ScalarTerm,
    Scene,
    load,
)
from instrument.conformance import check
from instrument.errors import BasisError, PluginError
from instrument.mat2 import IDENTITY
from instrument.pipeline.run import stream
from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import override, read_tables
from instrument.pipeline.stage import Running

STATIONS = ["CS001HBA0", "CS003HBA1", "CS302HBA1", "RS106HBA"]
SMALL = [
    f"instrument.stations={STATIONS}", "observation.duration='40 min'", "observation.interval='10 min'",
    "sky.shape=[3, 3]", "calibrate.kind='selfcal'",
]  # fmt: skip
WHEN = "2012-12-07T02:00:00"
C196 = SkyCoord("08h13m36.0s +48d13m03s")


class Square(JonesTerm):
    """Takes and gives one basis."""

    size: float = 1.0

    def jones(self, at):
        return self.size * IDENTITY[None, None, None, None]


class Receiver(Square):
    maps: ClassVar = ("feed", "feed")
    directional: ClassVar = False


class Screen(Square):
    maps: ClassVar = ("feed", "feed")


class Local(Square):
    maps: ClassVar = ("horizon", "horizon")


class Sky(Square):
    maps: ClassVar = ("sky", "sky")
    directional: ClassVar = False


def lofar(**fields):
    return load("telescopes", "lofar-hba", stations=STATIONS, **fields)


def small(*settings):
    tables = override(read_tables("mock-grid"), [*SMALL, *settings])
    return {name: table for name, table in tables.items() if name not in ("image", "analyze", "correct")}


def names(chain):
    return [type(term).__name__ for term in chain.terms]


def test_terms_enter_a_chain_at_the_leftmost_place_where_their_bases_fit():
    one, two = Sky(size=1.0), Sky(size=2.0)
    array = lofar(terms=[one, Screen(), Local(), Receiver(), two])
    order = ["Receiver", "GainTerm", "FeedTerm", "Screen", "StationBeam", "Local", "Parallactic", "Sky", "Sky"]
    assert names(array.chain()) == order
    assert array.chain().terms[-2:] == (one, two)  # of the same bases: in the order of the file
    assert names(array.chain().gains()) == order[:3] and names(array.chain().beams()) == order[3:]


def test_a_term_that_fits_nowhere_is_refused_with_the_bases_of_the_chain():
    with pytest.raises(BasisError, match=r"Local takes 'horizon' and gives 'horizon', which fits nowhere .* GainTerm"):
        lofar(beam=None, terms=[Local()]).chain()


def test_a_term_of_a_scene_that_fits_nowhere_is_told_by_its_label_and_what_would_do():
    tables = override(read_tables("mock-grid"), ["instrument.terms.turn={kind='parallactic'}"])
    said = (
        r"^\[instrument.terms.turn\] Parallactic takes .* fits nowhere .*: give one that takes and gives one of these$"
    )
    with pytest.raises(InputError, match=said):
        parse(tables).scene()


def test_errors_of_receivers_are_what_a_perfect_instrument_lacks():
    gain, cable, screen, ionosphere = GainTerm(rms=0.1), Receiver(size=2.0), Screen(), Sky()
    array = lofar(gain=gain, terms=[ionosphere, cable, screen])
    assert array.errors() == (cable, gain)
    assert array.receivers() == (cable, gain, FeedTerm())
    assert array.perfect() == lofar(terms=[ionosphere, screen])
    assert Chain(*array.receivers()).terms == array.chain().gains().terms


class Plain(Instrument):
    """A chain that knows nothing of what can be given."""

    def layout(self):
        return Layout.geodetic(["a"], np.array([[3826923.9, 460915.1, 5064643.2]]))

    def chain(self):
        return Chain(load("elements", "dipole", height=0.5 * u.m), Parallactic())


class Upon(Plain):
    """Calls the chain of its base."""

    def chain(self):
        return Chain(*super().chain().terms)


class Itself(Plain):
    """Places what was given itself."""

    def chain(self):
        sky = (t for t in self.terms if isinstance(t, Sky))
        return Chain(*self.receivers(), load("elements", "dipole", height=0.5 * u.m), Parallactic(), *sky)


def test_no_instrument_can_forget_what_was_given_nor_take_it_twice():
    given = {"gain": GainTerm(rms=0.1), "feed": FeedTerm(rms=0.2), "terms": [Receiver(), Sky()]}
    for kind in (Plain, Upon, Itself):
        assert names(kind(**given).chain()) == [
            "Receiver", "GainTerm", "FeedTerm", "CrossedDipole", "Parallactic", "Sky"
        ]  # fmt: skip
    assert names(Plain().chain()) == ["CrossedDipole", "Parallactic"]
    assert Plain.from_json(Plain(gain=GainTerm(rms=0.1), terms=[GainTerm(rms=0.2)]).to_json()).terms[0].rms == 0.2


def test_the_terms_of_a_composed_instrument_stay_as_given():
    terms = Chain(Screen(), Receiver(), load("elements", "dipole", height=0.5 * u.m), Parallactic())
    array = Composed(stations=Plain().layout(), gain=GainTerm(rms=0.1), terms=terms)
    assert names(array.chain()) == ["GainTerm", "Screen", "Receiver", "CrossedDipole", "Parallactic"]
    assert array.perfect().terms == terms.terms and array.errors() == (array.gain,)
    old = {"kind": "Composed", "stations": Plain().layout().to_dict(), "terms": terms.to_dict()}
    assert Composed.from_json(json.dumps({**old})).terms[2:] == terms.terms[2:]


def test_one_station_has_beams_and_no_visibilities():
    array = Plain()
    beam = array.beam(C196, WHEN, 150 * u.MHz)
    assert beam.shape == (1, 1, 1, 1, 2, 2)
    mueller = array.mueller(C196, WHEN, 150 * u.MHz, state="absolute")
    assert np.isclose(mueller[0, 0, 0, 0, 0], (np.abs(beam) ** 2).sum() / 2)
    assert np.array_equal(mueller, array.mueller(C196, WHEN, 150 * u.MHz, baseline=("a", "a"), state="absolute"))
    night = Observation(
        phase_centre=C196, transit="2012-12-07", duration=10 * u.min, interval=10 * u.min, frequencies=[150] * u.MHz
    )
    with pytest.raises(InputError, match="needs at least two stations, got a: one alone") as error:
        Scene(instrument=array, sky=PointSky.at(C196, [1.0]), observation=night).plan()
    assert "\n" not in str(error.value)
    check(array).raise_if_failed()
    with pytest.raises(InputError, match="at least one station"):
        array.layout().select([])


class Named(ScalarTerm):
    """A number for each frame, by the name of its first station."""

    maps: ClassVar = ("feed", "feed")
    per_station: ClassVar = "frame"

    def scalar(self, at):
        first, group = at.layout.frames
        return np.array([len(at.layout.names[k]) for k in first[group]], complex)[None, None, :, None] * np.ones(
            (1, 1, 1, at.shape[3])
        )


class NamedMatrix(Named):
    structure: ClassVar = "full"


def test_names_of_stations_can_be_asked_by_terms_of_a_frame_in_every_engine():
    array = lofar(terms=[NamedMatrix()])
    night = Observation(
        phase_centre=C196, transit="2012-12-07", duration=20 * u.min, interval=10 * u.min, frequencies=[150] * u.MHz
    )
    scene = Scene(instrument=array, sky=PointSky.at(C196, [1.0]), observation=night)
    found = [scene.plan(engine=engine).run().data for engine in ("direct", "matrix")]
    assert np.abs(found[0] - found[1]).max() < 1e-10 * np.abs(found[0]).max()


def test_a_term_that_draws_has_a_seed_of_its_label():
    def drawn(*settings):
        file = parse(small(*settings))
        return file.telescope().terms

    one = drawn("instrument.terms.a={kind='gain', rms=0.1}", "instrument.terms.b={kind='gain', rms=0.1}")
    assert len({term.seed for term in one}) == 2
    assert drawn("instrument.terms.b={kind='gain', rms=0.1}") == one[1:]
    assert drawn("instrument.terms.b={kind='gain', rms=0.1, seed=3}")[0].seed == 3


def test_a_scene_may_have_a_wrong_beam():
    found = parse(small("instrument.terms.bad={kind='beam-error', rms=0.1, common=true}")).telescope()
    error = found.chain().terms[-1]
    assert names(found.chain())[-1] == "BeamError"
    assert (error.rms, error.common) == (0.1, True)
    assert error.seed != 0
    assert error.beam == found.with_fields(terms=()).chain().beams()


@pytest.mark.parametrize(
    ("setting", "line"),
    [
        ("instrument.terms.a={kind='gian'}", r"\[instrument.terms.a\] .*'gian': did you mean 'gain'"),
        ("instrument.terms.a={rms=1}", r"\[instrument.terms.a\] needs 'kind': one of .*gain"),
        (
            "instrument.terms.a={kind='gain', rsm=1}",
            r"\[instrument.terms.a\] GainTerm has no 'rsm': did you mean",
        ),
        ("instrument.terms=3", r"'terms' must be tables, \[instrument.terms.LABEL\]"),
        ("instrument.terms={kind='gain'}", r"'terms' must be tables, \[instrument.terms.LABEL\]"),
    ],
)
def test_a_wrong_table_of_a_term_is_one_line(setting, line):
    with pytest.raises((InputError, PluginError), match=line) as error:
        parse(small(setting)).telescope()
    assert "\n" not in str(error.value)


def test_a_term_of_a_stranger_works_from_a_scene_file_and_calibration_finds_it(stranger):
    stranger("terms", "cable", "Cable")
    # without beams: through them 4 stations tell one common direction to 5e-5 only, whatever the tolerance
    file = parse(small("instrument.terms.long={kind='cable', step='5 cm'}", "instrument.beam='none'"))
    scene = file.scene()
    plan = file.plan(scene)
    assert re.search(r"kept +receivers +cable: put into the perfect blocks as they pass", str(plan))
    running = Running(file.name, file.seed, scene.instrument, plan, file.running)
    stream(running)
    found = running.results["calibrate"]
    assert found.passed
    # phases of 0, 9, 18 and 27 deg: found to the tolerance of the solve once the common phase is taken off
    errors = found.errors.linear
    assert errors["input"]["iq"] < 1e-6 and errors["input"]["s"] > 10
    assert max(errors["difference, aligned"].values()) < 1e-4
    with pytest.raises(InputError, match=r"\[instrument.terms.long\] Cable has no 'stpe': did you mean 'step'"):
        parse(small("instrument.terms.long={kind='cable', stpe='1 m'}")).scene()
