"""The many-directions laboratory: clusters of a sky, what is left of them after subtraction, and its figures."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.table import QTable

import instrument
from instrument import GainTerm, InputError, Observation, PointSky, Scene
from instrument.calibrate.directional import DirectionalCal
from instrument.experiments.many_directions import ManyDirections, cluster_of
from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import override, read_tables

CENTRE = SkyCoord("08h13m36.0s +48d13m03s")
PLACES = np.array([(0, 0), (2, 1), (-1.5, 2), (-2, -1.8)])  # deg
FLUXES = np.array([80.0, 40, 30, 20])
MINUTE = DirectionalCal(interval=60 * u.s)
LONG = 1e9 * u.s  # the matrices stand still


def field(**more):
    """Four bright sources, and a fainter one near each."""
    x, y = np.concatenate([PLACES, PLACES + np.array([0.15, 0.1])]).T
    where = CENTRE.spherical_offsets_by(x * u.deg, y * u.deg)
    return PointSky.at(where, np.concatenate([FLUXES, 0.1 * FLUXES]), **more)


def plan(minutes=4, stations=16, sky=None, **settings):
    names = instrument.load("telescopes", "lofar-hba", beam=None).layout().names
    chosen = [names[i] for i in np.linspace(0, len(names) - 1, stations).astype(int)]
    array = instrument.load("telescopes", "lofar-hba", stations=chosen, **{"beam": None, **settings})
    night = Observation(
        phase_centre=CENTRE, transit="2012-12-07", duration=minutes * u.min, interval=10 * u.s,
        frequencies=[150] * u.MHz, channel_width=0.19 * u.MHz,
    )  # fmt: skip
    return Scene(instrument=array, sky=sky or field(), observation=night).plan()


@pytest.fixture(scope="module")
def noisy():
    return ManyDirections(clusters=4, calibrator=MINUTE, sefd=2820 * u.Jy, seed=3).run(plan(10))


def test_every_source_belongs_to_the_nearest_of_the_brightest():
    assert list(cluster_of(field(), 4)) == [0, 1, 2, 3] * 2
    assert list(cluster_of(field(), 1)) == [0] * 8
    patches = ("pair", "", "", "", "pair", "", "", "")
    assert list(cluster_of(field(patches=patches), 4)) == [0, 1, 2, 3] * 2


def test_without_noise_clusters_are_subtracted_where_matrices_stand_still():
    found = ManyDirections(clusters=4, period=LONG, calibrator=MINUTE).run(plan())
    assert found.passed and found.noise_jy == 0
    assert found.left < 1e-6 and found.wrong_jy < 1e-6 * found.data_jy
    assert found.error.max() < 1e-6
    assert found.ratio > 1e4
    assert "of the data" in "\n".join(found.lines())


def test_beams_and_gains_of_the_instrument_are_part_of_it():
    gain = GainTerm(values=(1 + 0.1 * np.random.default_rng(1).normal(size=(1, 1, 16, 2))).astype(complex))
    found = ManyDirections(clusters=4, period=LONG, calibrator=MINUTE).run(plan(2, beam="full", gain=gain))
    # the beam polarizes the model by 1e-4: what only that determines comes in slowly, and is worth no more
    assert found.passed and found.left < 1e-5
    assert found.one_failed == 0 and found.ratio > 1e3


def test_what_is_left_without_noise_is_the_turning_within_intervals():
    found = ManyDirections(clusters=4, calibrator=MINUTE).run(plan())
    assert 1e-3 < found.left <= found.due_jy / found.data_jy < 1e-2  # a solution fits no worse than the means


def test_with_noise_what_is_left_is_due_and_one_direction_leaves_more(noisy):
    assert noisy.passed and noisy.left <= 2
    assert noisy.left_jy == pytest.approx(noisy.due_jy, rel=0.01)
    assert noisy.ratio > 2 and noisy.one_wrong_jy > 2 * noisy.wrong_jy
    assert np.all(noisy.error < 0.05)
    assert noisy.noise_jy == pytest.approx(2820 / np.sqrt(2 * 0.19e6 * 10) * np.sqrt(2), rel=0.01)


def test_pieces_are_the_whole(noisy, monkeypatch):
    monkeypatch.setattr("instrument.experiments.many_directions.BLOCK_BYTES", 1.0)  # an interval at a time
    done = []
    settings = ManyDirections(clusters=4, calibrator=MINUTE, sefd=2820 * u.Jy, seed=3)
    found = settings.run(plan(10), progress=done.append)
    assert len(done) == 10 and done[-1] == 1
    assert found.left_jy == pytest.approx(noisy.left_jy, rel=1e-6)
    assert found.due_jy == pytest.approx(noisy.due_jy, rel=1e-9)
    assert found.error == pytest.approx(noisy.error, rel=1e-4)


def test_intervals_of_clusters_and_a_short_last_one():
    names = field().names
    cal = DirectionalCal(interval=30 * u.s, intervals={names[3]: 120 * u.s})
    found = ManyDirections(clusters=4, period=LONG, calibrator=cal).run(plan(3))
    assert found.passed and found.left < 1e-6 and found.error.max() < 1e-6


def test_the_table_and_its_file(noisy, tmp_path):
    noisy.write(tmp_path)
    back = QTable.read(tmp_path / "many_directions.ecsv")
    assert [p.name for p in tmp_path.iterdir()] == ["many_directions.ecsv"]
    assert list(back["sources"]) == [2, 2, 2, 2, 8] and back["cluster"][-1] == "all"
    assert back["flux"].to_value(u.Jy) == pytest.approx([*1.1 * FLUXES, 187])
    assert back["left_over_noise"][-1] == pytest.approx(noisy.left) and np.isnan(back["ratio"][0])
    assert back["left"].unit == u.Jy and np.all(back["failed"] == 0)
    assert len(noisy.lines()) == 7


def test_intervals_that_fail_are_counted_and_left_out():
    cal = DirectionalCal(interval=60 * u.s, iterations=1)
    found = ManyDirections(clusters=4, calibrator=cal).run(plan(2))
    assert not found.passed and np.all(found.failed == 1)
    assert np.isnan(found.left) and np.all(np.isnan(found.error))
    assert np.isfinite(found.one_left_jy) and "8 stopped at the iteration limit" in "\n".join(found.lines())
    assert found.lines() and len(found.table()) == 5


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"clusters": 9}, "clusters = 9, but the sky has 8 sources"),
        ({"calibrator": DirectionalCal(intervals={"nobody": 60 * u.s})}, "nobody"),
    ],
)
def test_what_does_not_fit_the_sky_is_refused_in_one_line(settings, words):
    with pytest.raises(InputError, match=words) as error:
        ManyDirections(**settings).run(plan(1))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("wrong", ["clusters=0", "rms=-1", "period='0 s'", "interval=60", "sefd='-1 Jy'", "clutsers=3"])
def test_wrong_settings_of_a_scene_are_refused_in_one_line(wrong):
    tables = override(read_tables("many-directions"), [f"calibrate.{wrong}"])
    with pytest.raises(InputError) as error:
        parse(tables)
    assert str(error.value).startswith("[calibrate]") and "\n" not in str(error.value)


def test_the_scene_says_what_it_solves():
    found = parse(read_tables("many-directions")).stages["calibrate"].laboratory
    assert isinstance(found, ManyDirections)
    assert found.clusters == 5 and found.sefd == 2820 and found.calibrator.interval == 60
    assert ManyDirections.from_json(found.to_json()) == found
