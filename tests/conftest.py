"""What all tests share: those that slow.txt lists are marked `long` (slow.py writes the list), and a small set."""

from pathlib import Path

import pytest

SLOW = Path(__file__).with_name("slow.txt")


def listed():
    """Files and tests, as pytest names them."""
    lines = SLOW.read_text().splitlines()
    return {line for line in lines if line and not line.startswith("#")}


@pytest.hookimpl(tryfirst=True)  # before tests are chosen by their marks
def pytest_collection_modifyitems(items):
    slow = listed()
    for item in items:
        file, _, name = item.nodeid.partition("::")
        if not {file, f"{file}::{name.partition('[')[0]}", item.nodeid}.isdisjoint(slow):
            item.add_marker("long")


@pytest.fixture(scope="session")
def small_set(tmp_path_factory):
    """A Measurement Set of two times and three LOFAR stations, one channel, with two sources: to be copied."""
    pytest.importorskip("arcae")
    from astropy import units as u

    import instrument
    from instrument import MeasurementSet, Observation, Scene

    lofar = instrument.load("telescopes", "lofar-hba", stations=("CS001HBA0", "CS002HBA1", "CS003HBA0"), beam=None)
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=20 * u.s, interval=10 * u.s,
        frequencies=[150.0] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    sky = instrument.load("skies", "grid", shape=(1, 2), spacing=1 * u.deg, flux=5 * u.Jy).about(night.phase_centre)
    path = tmp_path_factory.mktemp("small") / "a.MS"
    MeasurementSet.create(path, Scene(instrument=lofar, sky=sky, observation=night).plan().run(), instrument=lofar)
    return path
