"""LOFAR station Jones matrices (`phase="everybeam"`) against EveryBeam, for the same stations, tiles and dipoles.

Errors are the largest of all matrix elements, relative to the largest element in the comparison.
"""

from typing import Any, NamedTuple

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import Direction, Instrument, Observation, Sampling, mat2
from instrument.observe.directions import offset

pytestmark = pytest.mark.peer
everybeam = pytest.importorskip("everybeam")
pytest.importorskip("casacore")

# HBA: tile rotations of 24, 0 and 52 deg; RS406 and RS508 have antenna planes of their own
STATIONS = {
    "lofar-hba": ["CS001HBA0", "CS002HBA0", "CS002HBA1", "RS106HBA", "RS406HBA", "RS508HBA"],
    "lofar-lba": ["CS001LBA", "CS302LBA", "RS106LBA", "RS406LBA", "RS508LBA"],
}
FREQUENCIES = {"lofar-hba": [115, 130, 150, 180, 230] * u.MHz, "lofar-lba": [15, 30, 60, 80] * u.MHz}
REFERENCE = {"lofar-hba": 150 * u.MHz, "lofar-lba": 60 * u.MHz}


class Case(NamedTuple):
    lofar: Instrument
    night: Observation
    data_set: str
    reference: Any

    def sampling(self, where):
        layout, centre = self.lofar.layout(), self.night.phase_centre
        return Sampling.build(layout, self.night.times(layout), self.night.freq_hz, *where(centre), centre)

    def everybeam(self, **settings):
        return everybeam.load_telescope(self.data_set, element_response_model="hamaker", **settings)


@pytest.fixture(scope="module", params=STATIONS)
def case(request, make_ms, tmp_path_factory):
    """Some stations at hour angles -4, -2, 0, 2, 4 h."""
    name = request.param
    lofar = instrument.load("telescopes", name, stations=STATIONS[name], phase="everybeam")
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s",
        transit="2012-12-07",
        duration=10 * u.hour,
        interval=2 * u.hour,
        frequencies=FREQUENCIES[name],
    )
    path = tmp_path_factory.mktemp(name) / "stations.MS"
    make_ms(path, lofar, night.with_fields(frequencies=[REFERENCE[name]], channel_width=0.2 * u.MHz))
    return Case(lofar, night, str(path), REFERENCE[name])


def field(centre):
    """64 directions over 20 x 20 deg."""
    side = np.sin(np.deg2rad(np.linspace(-10, 10, 8)))
    return offset(centre, *(x.ravel() for x in np.meshgrid(side, side)))


def whole_sky(centre):
    """80 directions all over the sphere, those below the antenna planes too."""
    rng = np.random.default_rng(1)
    return rng.uniform(0, 2 * np.pi, 80), np.arcsin(rng.uniform(-1, 1, 80))


def their_jones(telescope, at, beam=None, tile=None):
    """EveryBeam's matrices for the ITRF vectors of `at`, (T, F, A, S, 2, 2); `beam`, `tile` (T, 3) point elsewhere."""
    out = np.empty((*at.shape, 2, 2), complex)
    stations = np.arange(len(at.layout), dtype=np.uint64)
    beam = at.centre_itrf if beam is None else beam
    tile = beam if tile is None else tile
    for t, slot in enumerate(at.slots_s):
        for s, d in enumerate(at.itrf[t]):
            # times, stations, frequencies; direction, station and tile beam former; rotate to north and east
            one = telescope.station_response(np.array([slot]), stations, at.freq_hz, d, beam[t], tile[t], True)
            out[t, :, :, s] = np.swapaxes(one[0], 0, 1)
    return out


def their_jones_from_coordinates(telescope, at):
    """EveryBeam's matrices (complex64) for the coordinates of `at`, by its own astronomy, (T, F, A, S, 2, 2)."""
    out = np.empty((*at.shape, 2, 2), complex)
    for t, f, a, s in np.ndindex(*at.shape):
        out[t, f, a, s] = telescope.station_response(at.slots_s[t], a, at.freq_hz[f], at.ra_rad[s], at.dec_rad[s])
    return out


def error(found, wanted, what):
    worst = np.abs(found - wanted).max() / np.abs(wanted).max()
    print(f"{what}: {worst:.2e} of the peak")
    return worst


@pytest.mark.parametrize("where", [field, whole_sky])
def test_station_jones_equal_everybeam_where_the_itrf_vectors_are_given(case, with_everybeam_north, where):
    at = case.sampling(where)
    at = with_everybeam_north(at, at.itrf)
    theirs = their_jones(case.everybeam(), at)
    worst = error(case.lofar.chain().jones(at), theirs, f"ITRF given, {where.__name__}")
    # measured 1.3e-10 in the field, 4e-9 all over the sky: both work in double precision, but the axes of the survey
    # are orthonormal to 7e-11 only, and phases reach 200 rad
    assert worst < 1e-8
    ours = case.lofar.with_fields(phase="fringe").chain().jones(at)
    worst = error(ours.conj(), theirs, f"the sign of the fringe, conjugated, {where.__name__}")
    assert worst < 1e-8  # as above
    # the test can fail: measured .044 of the peak in the field (HBA, 115 to 230 MHz) and .46 (LBA, 15 to 80 MHz)
    assert error(ours, theirs, "not conjugated") > 1e-2


def test_beam_former_with_one_frequency_for_the_band_equals_everybeam(case, with_everybeam_north):
    fixed = case.lofar.with_fields(reference_frequency=case.reference)
    near = case.night.with_fields(frequencies=case.reference + [-2, 0, 2] * u.MHz)
    at = case._replace(night=near).sampling(field)
    at = with_everybeam_north(at, at.itrf)
    theirs = their_jones(case.everybeam(use_channel_frequency=False), at)
    worst = error(fixed.chain().jones(at), theirs, "fixed reference frequency")
    assert worst < 1e-8  # as above


def test_stations_and_tiles_that_point_apart_equal_everybeam(case, with_everybeam_north):
    station, tile = Direction(2.19, 0.85), Direction(2.12, 0.80)  # 2 and 3 deg from the centre
    fields = {"beam_pointing": station, "tile_pointing": tile}
    lofar = case.lofar.with_fields(**{k: v for k, v in fields.items() if k in type(case.lofar).model_fields})
    at = case.sampling(field)
    at = with_everybeam_north(at, at.itrf)
    beam, tile = (at.earth.itrf(d.vector[None])[:, 0] for d in (station, tile))
    ours = lofar.chain().jones(at)
    worst = error(ours, their_jones(case.everybeam(), at, beam, tile), "pointing apart")
    assert worst < 1e-8  # as above


def test_beams_from_coordinates_equal_everybeam_within_the_accuracy_of_its_frames(case):
    at, chain, telescope = case.sampling(field), case.lofar.chain(), case.everybeam()
    raw, centre = chain.jones(at), chain.jones(at.at_centre())
    their_raw, their_centre = (their_jones_from_coordinates(telescope, x) for x in (at, at.at_centre()))
    # measured 3e-5: their north is towards the aberrated pole, ours is carried along with the source
    worst = error(raw, their_raw, "from coordinates, absolute")
    assert worst < 5e-5
    # measured 2.8e-6 (HBA) and 7e-6 (LBA, whose wide beam shows the turn of that north 10 deg out): casacore's
    # directions are 0.7 arcsec from ours, by polar motion and diurnal aberration
    ours, theirs = mat2.mul(mat2.inverse(centre), raw), mat2.mul(mat2.inverse(their_centre), their_raw)
    worst = error(ours, theirs, "from coordinates, differential")
    assert worst < 1e-5


def test_the_matrices_that_doctor_knows_are_everybeams(peer_environment):
    import runpy
    from importlib.resources import files
    from pathlib import Path

    from astropy.table import Table

    known = Table.read(str(files("instrument.data") / "everybeam_lofar.ecsv"), format="ascii.ecsv")
    script = Path(__file__).resolve().parents[2] / "docs" / "reports" / "doctor_beam.py"
    made = Table(runpy.run_path(str(script))["rows"]())
    assert known.colnames == made.colnames
    for name in known.colnames:
        if name[:2] in ("xx", "xy", "yx", "yy"):
            # complex64, and its own tables of the Earth may be newer
            np.testing.assert_allclose(made[name], known[name], atol=1e-6)
        else:
            assert list(made[name]) == list(known[name])
