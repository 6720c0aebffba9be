"""A set with casacore's UVW, predicted into by DP3 and by us with the UVW of the set; casacore reads ours.

Our own UVW, of the IERS Earth, are those of casacore turned by 0.5 arcsec: 3e-3 of the visibilities at 70 km.
"""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import instrument
from instrument import MeasurementSet, Scene

pytestmark = pytest.mark.peer
tables = pytest.importorskip("casacore.tables")
pytest.importorskip("arcae")
if importlib.util.find_spec("dp3") is None:
    pytest.skip("DP3 is not installed", allow_module_level=True)
spec = importlib.util.spec_from_file_location("with_dp3", Path(__file__).with_name("test_dp3.py"))
with_dp3 = importlib.util.module_from_spec(spec)
spec.loader.exec_module(with_dp3)
night, sky = with_dp3.night, with_dp3.sky


def casacore_uvw(path):
    """Put casacore's UVW into a set, position of ANTENNA2 minus ANTENNA1 in J2000; how far they move, m."""
    from casacore.measures import measures
    from casacore.quanta import quantity

    with tables.table(f"{path}::ANTENNA", ack=False) as antennas, tables.table(f"{path}::FIELD", ack=False) as field:
        places, (ra, dec) = antennas.getcol("POSITION"), field.getcol("PHASE_DIR")[0, 0]
    frame = measures()
    frame.do_frame(frame.position("ITRF", *(quantity(float(x), "m") for x in places[0])))
    frame.do_frame(frame.direction("J2000", quantity(ra, "rad"), quantity(dec, "rad")))
    (sr, cr), (sd, cd) = ((np.sin(x), np.cos(x)) for x in (ra, dec))
    axes = np.array([[-sr, cr, 0], [-sd * cr, -sd * sr, cd], [cd * cr, cd * sr, sd]])
    with tables.table(str(path), readonly=False, ack=False) as ms:
        time, one, two, old = (ms.getcol(name) for name in ("TIME", "ANTENNA1", "ANTENNA2", "UVW"))
        new = old.copy()
        for slot in np.unique(time):
            frame.do_frame(frame.epoch("UTC", quantity(slot, "s")))
            columns = []
            for unit in np.eye(3):
                ends = (quantity(float(x) * 1e6, "m") for x in unit)
                seen = frame.measure(frame.baseline("ITRF", *ends), "J2000")
                lon, lat, length = seen["m0"]["value"], seen["m1"]["value"], seen["m2"]["value"] / 1e6
                columns.append(length * np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]))
            rows = time == slot
            new[rows] = (places[two[rows]] - places[one[rows]]) @ (axes @ np.array(columns).T).T
        ms.putcol("UVW", new)
    return float(np.abs(new - old).max())


@pytest.fixture(scope="module")
def data_set(make_ms, night, tmp_path_factory):
    path = tmp_path_factory.mktemp("set") / "night.MS"
    make_ms(path, instrument.load("telescopes", "lofar-hba"), night)
    assert 0.05 < casacore_uvw(path) < 1  # 70 km by 2.4e-6
    return path


@pytest.mark.parametrize(("beam", "bound"), [(False, 5e-8), (True, 3e-5)])  # rounding of complex64; places on Earth
def test_prediction_with_the_uvw_of_the_set_is_that_of_dp3(data_set, peer_environment, night, sky, beam, bound):
    theirs = with_dp3.predicted(data_set, with_dp3.sky_file(data_set.parent, sky), beam, peer_environment, night)
    one = MeasurementSet(data_set, column="PREDICTED")
    read = np.concatenate([block.data for block in one.blocks()])
    assert np.array_equal(read, theirs)
    lofar = instrument.load("telescopes", "lofar-hba", phase="everybeam", **({} if beam else {"beam": None}))
    ours = Scene(instrument=lofar, sky=sky, observation=one.observation()).plan(engine="matrix").run()
    assert with_dp3.error(ours.data, theirs, f"own UVW, beam {beam}") < bound
    if not beam:
        plain = Scene(instrument=lofar, sky=sky, observation=night).plan(engine="matrix").run()
        assert with_dp3.error(plain.data, theirs, "the Earth's UVW") > 1e-4  # what the UVW of the set are good for
        one.write("MODEL_DATA", ours)
        with tables.table(str(data_set), ack=False) as ms:
            found = ms.getcol("MODEL_DATA").reshape(night.count, -1, len(night.freq_hz), 2, 2).swapaxes(1, 2)
        assert np.array_equal(found, ours.data.astype(np.complex64))
