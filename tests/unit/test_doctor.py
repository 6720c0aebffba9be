"""Doctor: optional parts with their commands, programs that cannot share a process, beams that are known."""

import tomllib
from pathlib import Path

import pytest

from instrument import doctor_checks
from instrument.doctor import doctor
from instrument.doctor_checks import ADDS, BEAM_AGREES, coexistence, extras, known_beams

ROOT = Path(__file__).resolve().parents[2]


EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


@pytest.fixture
def of_this_tree(monkeypatch):
    """The requirements of pyproject.toml, as an installation that is not stale has them."""

    def required(_):
        for extra, wanted in EXTRAS.items():
            for name, _, marker in (text.partition(";") for text in wanted):
                yield f'{name}; {f"({marker}) and " if marker else ""}extra == "{extra}"'

    monkeypatch.setattr(doctor_checks.metadata, "requires", lambda name: list(required(name)))


def test_every_extra_of_the_package_is_known_to_it():
    assert set(ADDS) == set(EXTRAS)


def test_an_extra_of_another_platform_is_said(monkeypatch):
    monkeypatch.setattr(
        doctor_checks.metadata, "requires", lambda _: ['radler; sys_platform == "x" and extra == "radler"']
    )
    lines = {line.split()[0]: line for line in extras()}
    assert "not for this platform (radler)" in lines["radler"]
    assert "not known to what is installed: pip install -U instrument" in lines["ms"]


@pytest.mark.usefixtures("of_this_tree")
def test_what_is_missing_has_its_command_and_what_is_there_its_version(monkeypatch):
    monkeypatch.setattr(doctor_checks, "package_version", lambda name: {"pyuvdata": "3.2"}.get(name, "not installed"))
    lines = {line.split()[0]: line for line in extras()}
    assert "pyuvdata 3.2: UVFITS and UVH5" in lines["uv"]
    assert "not installed; lacks arcae: pip install 'instrument[ms]' adds Measurement Sets" in lines["ms"]
    assert set(lines) == set(ADDS)


@pytest.mark.parametrize(
    ("versions", "said"),
    [
        ({}, []),
        ({"python-casacore": "3.8.1"}, []),
        ({"python-casacore": "3.8.1", "casatools": "6.7"}, ["python-casacore and casatools crash each other"]),
        ({"arcae": "0.5.8", "python-casacore": "3.8.1"}, ["arcae 0.5.8 reads Measurement Sets here, and lives beside"]),
        ({"arcae": "0.5.1", "casatools": "6.7"}, ["arcae 0.5.1 crashes beside casatools: pip install -U"]),
        ({"arcae": "0.5.1"}, ["arcae 0.5.1 reads Measurement Sets here"]),
    ],
)
def test_programs_that_cannot_share_a_process_are_said(monkeypatch, versions, said):
    monkeypatch.setattr(doctor_checks, "package_version", lambda name: versions.get(name, "not installed"))
    lines = list(coexistence())
    assert len(lines) == len(said)
    assert all(line.startswith(start) for line, start in zip(lines, said, strict=True))


def test_beams_are_everybeams_to_what_the_frames_differ_by():
    found = known_beams()
    assert set(found) == {"lofar-hba", "lofar-lba"}
    assert all(1e-7 < apart < BEAM_AGREES for apart in found.values())  # not the same numbers, but the same beam


def test_a_beam_that_is_wrong_is_found(monkeypatch):
    """With the sign of time of the fringe it is the conjugate: what has to be caught."""
    from instrument import registry

    load = registry.load
    monkeypatch.setattr(registry, "load", lambda *names, **given: load(*names, **(given | {"phase": "fringe"})))
    assert all(apart > 1e-2 for apart in known_beams().values())
    lines = []
    assert not doctor(lines.append)
    assert sum("against EveryBeam's matrices" in line and "(WRONG)" in line for line in lines) == 2
