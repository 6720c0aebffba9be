"""BeamError: what is wrong with a beam, by how much and for whom, and what of it a scene keeps."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from scipy.spatial.transform import Rotation

import instrument
from instrument import BeamError, Chain, GainTerm, InputError, JonesTerm, Observation, Parallactic, Scene, conformance

LOFAR = instrument.load("telescopes", "lofar-hba", stations=["CS001HBA0", "CS002HBA1", "CS004HBA0", "RS106HBA"])
CENTRE = SkyCoord("08h13m36.0s +48d13m03s")
NIGHT = Observation(
    phase_centre=CENTRE, transit="2012-12-07", duration=6 * u.hour, interval=1 * u.hour, frequencies=[150] * u.MHz,
)  # fmt: skip
TIMES, FREQ = ["2012-12-07T22:00:00", "2012-12-08T02:00:00", "2012-12-08T05:30:00"], 150 * u.MHz
PLACES = CENTRE.directional_offset_by([10, 70, 200, 300] * u.deg, [0.5, 1.5, 2.5, 4] * u.deg)


def wrong(telescope=LOFAR, **settings):
    return telescope.with_fields(terms=[BeamError(**settings)])


def beam(telescope, state="absolute", places=PLACES):
    return telescope.beam(places, TIMES, FREQ, CENTRE, state)


def in_carried_axes(jones, places=PLACES):
    """Jones (..., S, 2, 2) with columns along north and east of the centre, turned with the sphere that moves there."""
    to = places.cartesian.xyz.value.T
    c = CENTRE.cartesian.xyz.value
    axes = [CENTRE.directional_offset_by(a * u.deg, 90 * u.deg).cartesian.xyz.value for a in (0, 90)]
    out = np.empty_like(jones)
    for s, d in enumerate(to):
        axis = np.cross(c, d)
        turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.arctan2(np.linalg.norm(axis), c @ d))
        own = [places[s].directional_offset_by(a * u.deg, 90 * u.deg).cartesian.xyz.value for a in (0, 90)]
        out[..., s, :, :] = jones[..., s, :, :] @ np.array([[o @ turn.apply(a) for a in axes] for o in own])
    return out


def test_off_diagonals_and_half_difference_are_wrong_by_the_draws_in_carried_axes():
    """By the same factors at every time and place to 1e-9, and the half-sum is right."""
    for common in (False, True):
        error = BeamError(rms=0.3, seed=5, common=common)
        right = in_carried_axes(beam(LOFAR, "differential"))
        found = in_carried_axes(beam(LOFAR.with_fields(terms=[error]), "differential"))
        at = LOFAR.sampling(PLACES, TIMES, FREQ, CENTRE)
        draws = 1 + np.broadcast_to(error.draws(at), (4, 3))
        assert (len(np.unique(draws[:, 0])) == 1) == common
        half = [j[..., 0, 0] - j[..., 1, 1] for j in (found, right)]
        np.testing.assert_allclose(half[0], draws[:, :1] * half[1], rtol=1e-9)
        np.testing.assert_allclose(found[..., 0, 1], draws[:, 1:2] * right[..., 0, 1], rtol=1e-9)
        np.testing.assert_allclose(found[..., 1, 0], draws[:, 2:] * right[..., 1, 0], rtol=1e-9)
        sums = [j[..., 0, 0] + j[..., 1, 1] for j in (found, right)]
        np.testing.assert_allclose(*sums, rtol=1e-12)


class Still(JonesTerm):
    """The same receptors in every direction, along axes carried from the centre."""

    maps = ("sky", "feed")

    def jones(self, at):
        """(1, 1, 1, S, 2, 2)."""
        places = SkyCoord(at.ra_rad, at.dec_rad, unit="rad")
        here = np.broadcast_to(np.eye(2, dtype=complex), (1, 1, 1, len(places), 2, 2))
        return here if len(places) == 1 else np.linalg.inv(in_carried_axes(here, places))


def test_the_turn_of_local_north_is_not_wrong():
    """A beam that changes by no more than that stays as it is with rms 1, to 1e-12."""
    at = LOFAR.sampling(PLACES, TIMES, FREQ, CENTRE)
    right, found = Chain(Still()).jones(at), BeamError(beam=Chain(Still()), rms=1.0).jones(at)
    assert 0.02 < np.abs(right[..., 0, 1]).max() < 0.12  # 4 deg away at a declination of 48 deg
    np.testing.assert_allclose(found, np.broadcast_to(right, found.shape), atol=1e-12)


def test_it_is_linear_in_rms_and_nothing_towards_the_centre():
    right = beam(LOFAR)
    small, large = (beam(wrong(rms=rms, seed=2)) - right for rms in (0.01, 0.1))
    np.testing.assert_allclose(large, 10 * small, atol=1e-13)
    assert np.abs(large).max() > 1e-4
    there = CENTRE.directional_offset_by([0] * u.deg, [0] * u.deg)
    np.testing.assert_allclose(beam(wrong(rms=0.1), places=there), beam(LOFAR, places=there), atol=1e-14)


def test_it_is_smooth_over_a_field():
    """Between 14 x 14 Chebyshev points of 4 deg as good as the beam itself, to a factor of 2."""
    x = np.cos((2 * np.arange(14) + 1) * np.pi / 28)
    basis = np.polynomial.chebyshev.chebvander
    fit = np.linalg.inv(basis(x, 13))
    some = np.random.default_rng(0).uniform(-1, 1, (2, 30))

    def at(a, b):
        r, angle = np.hypot(a, b).ravel() * 2, np.arctan2(b, a).ravel()
        return CENTRE.directional_offset_by(angle * u.rad, r * u.deg)

    left = []
    for telescope in (LOFAR, wrong(rms=0.1)):
        nodes = beam(telescope, "differential", at(*np.meshgrid(x, x, indexing="ij")))[0, 0]
        nodes = nodes.reshape(4, 14, 14, 2, 2)
        there = np.einsum("sx,sy,xa,yb,qabij->qsij", *(basis(c, 13) for c in some), fit, fit, nodes, optimize=True)
        left.append(np.abs(there - beam(telescope, "differential", at(*some))[0, 0]).max())
    assert left[0] < 1e-4
    assert left[1] < 2 * left[0]


def test_draws_are_of_names_and_seeds():
    """Fewer stations, in another order, keep theirs; another seed, or one draw for all, is another."""
    whole = beam(wrong(rms=0.1, seed=3))
    few = LOFAR.with_fields(stations=[LOFAR.layout().names[k] for k in (2, 0)])
    # 1e-8: the same sky is seen from the centre of fewer stations
    np.testing.assert_allclose(beam(wrong(few, rms=0.1, seed=3)), whole[:, :, [2, 0]], atol=1e-8)
    for other in ({"seed": 4}, {"seed": 3, "common": True}):
        assert np.abs(beam(wrong(rms=0.1, **other)) - whole).max() > 1e-4


def test_it_takes_the_beams_of_a_chain_and_leaves_it_where_nothing_is_wrong():
    found = wrong(LOFAR.with_fields(gain=GainTerm(rms=0.1)), rms=0.1).chain()
    assert [t.called for t in found.terms] == ["GainTerm", "FeedTerm", "BeamError"]
    assert found.known() == LOFAR.with_fields(gain=GainTerm(rms=0.1)).chain()
    sky = instrument.load("skies", "grid", shape=(2, 2), spacing=2 * u.deg, flux=1 * u.Jy)
    plan, right, bad = (
        Scene(instrument=t, sky=sky, observation=NIGHT).plan() for t in (wrong(), LOFAR, wrong(rms=0.1, seed=1))
    )
    assert "rms 0: no error of the beam" in str(plan)
    np.testing.assert_array_equal(plan.run().data, right.run().data)
    assert "StationBeam, Parallactic with errors of 0.1, drawn for each station" in str(bad)
    assert bad.verify().passed
    assert np.abs(bad.run().data - right.run().data).max() > 1e-5
    bare = Scene(instrument=wrong(LOFAR.with_fields(beam=None), rms=0.1), sky=sky, observation=NIGHT).plan()
    assert "no beam to be wrong" in str(bare)
    with pytest.raises(InputError, match="takes a beam from 'sky' to 'feed', this one is from 'horizon' to 'feed'"):
        BeamError(beam=Chain(instrument.load("elements", "hamaker")))


def test_a_beam_without_an_inverse_stays_as_it_is():
    """A pointing below the horizon at some times: finite, and zero as the beam is."""
    low = SkyCoord("20h13m36.0s -48d13m03s")
    there = low.directional_offset_by([10] * u.deg, [1] * u.deg)
    found = wrong(rms=0.1).beam(there, TIMES, FREQ, low)
    assert not found.any()


def test_it_keeps_the_contract_of_terms():
    beam = Chain(instrument.load("elements", "hamaker"), Parallactic())
    for term in (BeamError(rms=0.1), BeamError(beam=beam), BeamError(beam=beam, rms=0.1, common=True)):
        conformance.check(term).raise_if_failed()
    conformance.check(wrong(rms=0.1, seed=7)).raise_if_failed()
