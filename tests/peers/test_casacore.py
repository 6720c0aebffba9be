"""Directions and uvw axes against the measures of casacore, by which Measurement Sets are made.

casacore leaves out polar motion (0.3 to 0.4 arcsec) and points diurnal aberration (0.3 arcsec) along the site's
position instead of east, so 1 arcsec is as near as can be; the aberration of the Earth's orbit is 20 arcsec.
"""

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import Observation, Sampling
from instrument.observe.directions import offset, tangents

pytestmark = pytest.mark.peer
pytest.importorskip("casacore.measures")
ARCSEC = np.deg2rad(1 / 3600)


@pytest.fixture(scope="module", params=["2012-03-07", "2012-06-07", "2012-09-07", "2012-12-07"])
def at(request):
    """25 directions over 20 x 20 deg from the whole array, at three times around transit in each season."""
    layout = instrument.load("telescopes", "lofar-hba").layout()
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s",
        transit=request.param,
        duration=8 * u.hour,
        interval=8 / 3 * u.hour,
        frequencies=[150] * u.MHz,
    )
    side = np.sin(np.deg2rad(np.linspace(-10, 10, 5)))
    ra, dec = offset(night.phase_centre, *(x.ravel() for x in np.meshgrid(side, side)))
    return Sampling.build(layout, night.times(layout), night.freq_hz, ra, dec, night.phase_centre)


def casacore_uvw_axes(at):
    """Matrices (T, 3, 3) from ITRF vectors to u, v, w: ITRF baselines as casacore has them in J2000."""
    from casacore.measures import measures
    from casacore.quanta import quantity

    frame, centre = measures(), at.centre
    frame.do_frame(frame.position("ITRF", *(quantity(float(x), "m") for x in at.layout.centre_m)))
    frame.do_frame(frame.direction("J2000", *(quantity(x, "rad") for x in centre)))
    axes = np.concatenate([*tangents(np.array([centre.ra_rad]), np.array([centre.dec_rad])), centre.vector[None]])
    out = np.empty((len(at.slots_s), 3, 3))
    for t, slot in enumerate(at.slots_s):
        frame.do_frame(frame.epoch("UTC", quantity(float(slot), "s")))
        for k, unit in enumerate(np.eye(3)):
            seen = frame.measure(frame.baseline("ITRF", *(quantity(float(x) * 1e6, "m") for x in unit)), "J2000")
            lon, lat, length = (seen[m]["value"] for m in ("m0", "m1", "m2"))
            vector = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
            out[t, :, k] = axes @ vector * length / 1e6
    return out


def test_directions_equal_casacore_within_its_polar_motion_and_diurnal_aberration(at, casacore_itrf):
    theirs = casacore_itrf(at.slots_s, at.ra_rad, at.dec_rad, site=at.layout.centre_m)
    worst = np.linalg.norm(at.itrf - theirs, axis=-1).max() / ARCSEC
    print(f"directions: {worst:.2f} arcsec")
    assert worst < 1


def test_uvw_axes_equal_casacore_within_its_polar_motion_and_diurnal_aberration(at, peer_environment):
    turned = at.earth.uvw_axes(at.centre) @ np.swapaxes(casacore_uvw_axes(at), 1, 2)
    worst = np.abs(turned - np.eye(3)).max() / ARCSEC
    print(f"uvw axes: {worst:.2f} arcsec")
    assert worst < 1
