"""Errors of sources that are close together or resolved, leakages beside them, positions: right, or said (D7, B7)."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

import instrument
from instrument import Analyzer, InputError, Observation, Outcome, PointSky, Scene
from instrument.analyze.sources.offsets import OffsetSums
from instrument.analyze.sources.photometry import ForcedPhotometry

CENTRE = SkyCoord("08h13m36.0s +48d13m03s")
CORE = ["CS001HBA0", "CS002HBA0", "CS005HBA1", "CS011HBA0", "CS024HBA0", "CS028HBA1", "CS030HBA0", "CS103HBA1"]
FLAGGED = ForcedPhotometry()


def seen(sky):
    array = instrument.load("telescopes", "lofar-hba", beam=None, stations=CORE)
    night = Observation(
        phase_centre=CENTRE, transit="2012-12-07", duration=8 * u.hour, interval=20 * u.min,
        frequencies=[150] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    return Scene(instrument=array, sky=sky, observation=night).plan().run()


def beam_rad():
    """1 / longest baseline in wavelengths."""
    at = seen(PointSky.at(CENTRE.reshape(1), [1.0])).at
    uvw = at.uvw_m[:, :, None] - at.uvw_m[:, None]
    return 299792458.0 / 150e6 / np.linalg.norm(uvw, axis=-1).max()


def pair(apart_rad, fwhm_rad=0.0):
    where = CENTRE.spherical_offsets_by([0, np.rad2deg(apart_rad)] * u.deg, [0, 0] * u.deg)
    flux = np.array([[3, 0.03, 0, 0], [2, 0, 0.02, 0.01]])
    shape = {k: np.full(2, fwhm_rad) for k in ("major_rad", "minor_rad")} | {"angle_rad": np.zeros(2)}
    return PointSky.at(where, flux, **(shape if fwhm_rad else {}))


def pulls(sky, draws, flag=None):
    """(measured - true) / error of every source and Stokes parameter (draws, G, 4), and the last fluxes."""
    vis = seen(sky)
    vis = vis if flag is None else vis.flagged(flag)
    out = []
    for seed in range(draws):
        found = FLAGGED.measure(vis.with_noise(2820 * u.Jy, seed), sky)
        out.append((found.stokes_jy[0] - sky.stokes_jy) / found.error_jy[0])
    return np.array(out), found


def one_flag(vis_shape=(24, 1, 28)):
    flag = np.zeros(vis_shape, bool)
    flag[2, 0, 3] = True
    return flag


@pytest.mark.parametrize("flagged", [False, True])
@pytest.mark.parametrize(("beams", "wide"), [(0.1, 0), (0.01, 0), (1e-4, 0), (1.0, 5.0)], ids=str)
def test_d7_errors_of_close_and_of_resolved_sources_are_those_of_noise(beams, wide, flagged):
    beam = beam_rad()
    sky = pair(beams * beam, wide * beam)
    vis = seen(sky)
    flag = one_flag(vis.data.shape[:3]) if flagged else None
    found, last = pulls(sky, 15, flag)
    if last.outcome[0] is Outcome.SINGULAR:
        # resolved out, or nearer than flags allow: said
        pytest.fail("singular")
    # 15 draws of 2 x 4 numbers, of which the two of a pair are one and the same: 60
    assert 0.75 < found.std() < 1.3


def test_d7_a_leakage_is_measured_only_where_it_is():
    beam = beam_rad()
    measured = []
    for beams in (30, 1e-3):
        sky = pair(beams * beam)
        measured.append(Analyzer(visibilities=seen(sky).with_noise(20 * u.Jy, 1), sky=sky).leakage().measured.tolist())
    assert measured == [[True, True], [False, False]]


@pytest.mark.parametrize("flagged", [False, True])
def test_d7_sources_at_one_place_are_singular_either_way(flagged):
    sky = pair(np.deg2rad(1e-6))
    vis = seen(sky)
    if flagged:
        vis = vis.flagged(one_flag(vis.data.shape[:3]))
    found = ForcedPhotometry().measure(vis, sky)
    assert found.outcome == (Outcome.SINGULAR,)
    assert np.isnan(found.stokes_jy).all() and np.isnan(found.error_jy).all()


@pytest.mark.parametrize(
    ("what", "settings"),
    [("uv_range", (1,)), ("uv_range", (500, 100)), ("uv_range", (0, np.nan)), ("every", 0), ("every", "2"),
     ("every", True), ("accuracy", 0), ("accuracy", 1), ("accuracy", np.nan), ("iterations", -1), ("iterations", None)],
    ids=str,
)  # fmt: skip
def test_b7_numbers_of_photometry_go_through_the_door(what, settings):
    with pytest.raises(InputError, match=what) as error:
        ForcedPhotometry(**{what: settings})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("channel", [-1, 1, "0", True, None, np.nan, 0.5])
def test_b7_a_channel_of_a_leakage_is_one_that_is_there(channel):
    sky = pair(0.01)
    with pytest.raises(InputError, match="channel"):
        Analyzer(visibilities=seen(sky), sky=sky).leakage(channel=channel)


@pytest.mark.parametrize("wrong", [(1,), (500, 100), (0, np.nan), "5"])
def test_b7_a_uv_range_of_offsets_is_checked(wrong):
    with pytest.raises(InputError, match="uv_range"):
        OffsetSums(pair(0.01), np.arange(2), wrong)
