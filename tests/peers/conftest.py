"""What the programs of others need to start, a LOFAR data set for them, and directions as they have them."""

import os
from importlib import metadata
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def peer_environment(tmp_path_factory):
    """Environment variables for EveryBeam and DP3, also set in this process; all data come with their packages."""
    casacore = pytest.importorskip("casacore")
    pytest.importorskip("everybeam")
    casarc = tmp_path_factory.mktemp("casa") / "casarc"
    casarc.write_text(f"measures.directory: {Path(casacore.__file__).parent / 'data'}\n")
    coefficients = next(f for f in metadata.files("everybeam") if f.name == "HamakerHBACoeff.h5").locate()
    ours = {"CASARCFILES": str(casarc), "EVERYBEAM_DATADIR": str(Path(coefficients).resolve().parent)}
    os.environ.update(ours)
    return os.environ | {"OPENBLAS_NUM_THREADS": "1"}  # DP3 refuses to start with more


@pytest.fixture(scope="session")
def make_ms(peer_environment):
    """`make_ms` of instrument.precision.lofar_ms, once the programs that read its sets find their data."""
    from instrument.precision.lofar_ms import make_ms

    return make_ms


@pytest.fixture(scope="session")
def casacore_itrf(peer_environment):
    """`casacore_itrf` of instrument.precision.casacore_frames, once casacore finds its data."""
    from instrument.precision.casacore_frames import casacore_itrf

    return casacore_itrf


@pytest.fixture(scope="session")
def with_everybeam_north(peer_environment):
    """`with_everybeam_north` of the same."""
    from instrument.precision.casacore_frames import with_everybeam_north

    return with_everybeam_north


@pytest.fixture(scope="session")
def as_dp3(peer_environment):
    """`as_dp3` of the same."""
    from instrument.precision.casacore_frames import as_dp3

    return as_dp3
