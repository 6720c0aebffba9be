"""UVFITS that CASA imports: times, stations and data are those that were written; what it has of its own is told."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import MeasurementSet, Observation, Visibilities, write_uv
from instrument.errors import InstrumentWarning
from instrument.observe.sampling import Sampling

pytestmark = pytest.mark.peer
pytest.importorskip("pyuvdata")
pytest.importorskip("arcae")
spec = importlib.util.spec_from_file_location("casa", Path(__file__).with_name("casa.py"))
casa = importlib.util.module_from_spec(spec)
spec.loader.exec_module(casa)
IMPORT = "import sys, casatools; one = casatools.ms(); one.fromfits(sys.argv[2], sys.argv[1]); one.close()"


def test_casa_imports_what_is_written(tmp_path):
    lofar = instrument.load("telescopes", "lofar-hba", stations=["CS001HBA0", "CS002HBA1", "RS106HBA"], beam=None)
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=30 * u.s, interval=10 * u.s,
        frequencies=[150.0, 150.2] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    layout, centre = lofar.layout(), night.phase_centre
    at = Sampling.build(layout, night.times(layout), night.freq_hz, centre.ra_rad, centre.dec_rad, centre)
    one, two = layout.baselines
    noise = np.random.default_rng(1).normal(size=(3, 2, len(one), 2, 2, 2)).astype(np.float32) @ [1, 1j]
    vis = Visibilities(noise, at, one, two, 10.0, 0.2e6)
    write_uv(tmp_path / "a.uvfits", vis)
    casa.run(IMPORT, tmp_path, tmp_path / "a.uvfits", tmp_path / "b.MS")
    with pytest.warns(InstrumentWarning, match="UVW"):
        found = next(MeasurementSet(tmp_path / "b.MS").blocks())
    assert found.layout.names == vis.layout.names and np.array_equal(found.freq_hz, vis.freq_hz)
    assert np.abs(found.at.slots_s - vis.at.slots_s).max() < 1e-4
    # CASA keeps UVW of station 1 minus 2 and conjugates: fringes are the same, and V has the other sign
    assert np.array_equal(found.data, vis.data.conj()) and np.abs(found.uvw_m + vis.uvw_m).max() < 1e-3
    # and it does not turn the places of stations about the pole, by the longitude of the array
    turned = np.deg2rad(6.868)
    back = np.array([[np.cos(turned), -np.sin(turned), 0], [np.sin(turned), np.cos(turned), 0], [0, 0, 1]])
    places = vis.layout.positions_m - vis.layout.positions_m[0]
    assert np.abs((found.layout.positions_m - found.layout.positions_m[0]) @ back.T - places).max() < 0.5
