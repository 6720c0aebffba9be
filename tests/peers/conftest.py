"""What the programs of others need to start, a LOFAR data set for them, and directions as they have them."""

import os
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

# EveryBeam takes coordinates from J2000 to ITRF at this position, whose x lacks its leading 3
EVERYBEAM_SITE_M = (826577.022720000, 461022.995082000, 5064892.814)


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
    """Function (MJD seconds (T,), ra, dec (S,), site) -> ITRF unit vectors (T, S, 3) of casacore, aberration included.

    `site` is an ITRF position or the name of one of casacore's observatories.
    """
    from casacore.measures import measures
    from casacore.quanta import quantity

    def itrf(slots_s, ra_rad, dec_rad, site=EVERYBEAM_SITE_M):
        frame = measures()
        named = isinstance(site, str)
        place = frame.observatory(site) if named else frame.position("ITRF", *(quantity(x, "m") for x in site))
        frame.do_frame(frame.measure(place, "ITRF"))
        out = np.empty((len(slots_s), len(ra_rad), 3))
        for t, slot in enumerate(slots_s):
            frame.do_frame(frame.epoch("UTC", quantity(float(slot), "s")))
            for s, angles in enumerate(zip(ra_rad, dec_rad, strict=True)):
                seen = frame.measure(frame.direction("J2000", *(quantity(float(x), "rad") for x in angles)), "ITRF")
                lon, lat = seen["m0"]["value"], seen["m1"]["value"]
                out[t, s] = np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)
        return out

    return itrf


@pytest.fixture(scope="session")
def with_everybeam_north(casacore_itrf):
    """Function of a Sampling and ITRF directions (T, S, 3): the Sampling seeing them, north towards EveryBeam's pole.

    EveryBeam's north is towards the J2000 pole as casacore carries it to ITRF, with the aberration of the pole.
    """
    from dataclasses import replace

    def north(at, seen):
        east = np.cross(casacore_itrf(at.slots_s, [0.0], [np.pi / 2]), seen)
        return replace(at, seen=seen, seen_east=east / np.linalg.norm(east, axis=-1, keepdims=True))

    return north
