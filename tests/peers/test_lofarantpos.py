"""The stations of LofarHBA and LofarLBA against the survey in lofarantpos: the other peers are given ours."""

import numpy as np
import pytest

import instrument

pytestmark = pytest.mark.peer
lofarantpos = pytest.importorskip("lofarantpos.db")

INNER = [5, 6, *range(10, 14), *range(17, 23), *range(25, 31), *range(34, 38), 41, 42]  # HBA_DUAL_INNER


@pytest.fixture(scope="module")
def survey():
    return lofarantpos.LofarAntennaDatabase()


@pytest.mark.parametrize("name", ["lofar-hba", "lofar-lba"])
def test_positions_and_axes_equal_the_survey(survey, name):
    layout = instrument.load("telescopes", name).layout()
    for station, position, axes in zip(layout.names, layout.positions_m, layout.axes, strict=True):
        np.testing.assert_allclose(position, survey.phase_centres[station], atol=1e-3)  # the survey has 1 mm
        np.testing.assert_allclose(axes, survey.pqr_to_etrs[station].T, atol=1e-9)  # written with 10 digits


def test_tiles_and_dipoles_equal_the_survey(survey):
    lofar = instrument.load("telescopes", "lofar-hba")
    for station, tiles, dipoles in zip(lofar.stations, lofar.tile_offsets(), lofar.dipole_offsets(), strict=True):
        centres = survey.antenna_etrs(station) - survey.phase_centres[station]
        within = survey.hba_dipole_etrs(station).reshape(-1, 16, 3) - survey.antenna_etrs(station)[:, None]
        if len(centres) == 48:
            centres, within = centres[INNER], within[INNER]
        np.testing.assert_allclose(tiles, centres, atol=1e-3)
        # float32 there; their order within a tile does not matter, and is the same
        np.testing.assert_allclose(np.broadcast_to(dipoles, within.shape), within, atol=1e-5)


def test_antennas_of_the_low_band_equal_the_survey(survey):
    lofar = instrument.load("telescopes", "lofar-lba", antennas="all")
    (level,) = lofar.chain().beams().terms[0].levels
    for station, antennas in zip(lofar.stations, level.offsets_m, strict=True):
        np.testing.assert_allclose(antennas, survey.antenna_etrs(station) - survey.phase_centres[station], atol=1e-3)
