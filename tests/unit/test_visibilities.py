"""Visibilities: noise, correction, beam states, flags; nothing is changed in place."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

import instrument
from instrument import FeedTerm, GainTerm, InputError, Observation, PointSky, Scene, Towards
from instrument.errors import BeamStateError

CENTRE = SkyCoord("08h13m36.0s +48d13m03s")
STATIONS = ["CS001HBA0", "CS003HBA1", "CS302HBA1", "RS106HBA", "RS508HBA"]


def scene(interval=1 * u.hour, frequencies=(150,), **settings):
    observation = Observation(
        phase_centre=CENTRE, transit="2012-12-07", duration=8 * u.hour, interval=interval,
        frequencies=frequencies * u.MHz, channel_width=0.19 * u.MHz,
    )  # fmt: skip
    sky = PointSky.at(CENTRE.spherical_offsets_by([0, 1] * u.deg, [0, 2] * u.deg), [[3, 0.1, 0.2, 0.3], [1, 0, 0, 0]])
    return Scene(
        instrument=instrument.load("telescopes", "lofar-hba", stations=STATIONS, **settings),
        sky=sky,
        observation=observation,
    )


def test_noise_has_the_rms_of_the_radiometer_equation_and_independent_parts():
    vis = scene(interval=10 * u.s).plan().run()
    noise = vis.with_noise(sefd=2820 * u.Jy, seed=3).data - vis.data
    sigma = 2820 / np.sqrt(2 * 0.19e6 * 10)
    assert sigma == pytest.approx(1.45, abs=0.005)  # the figure of the LOFAR documentation
    parts = np.stack([noise.real, noise.imag], -1).reshape(-1, 8)
    covariance = np.cov(parts.T) / sigma**2
    few = 5 / np.sqrt(len(parts))
    assert np.abs(covariance - np.eye(8)).max() < few * np.sqrt(2)
    assert np.abs(parts.mean(axis=0)).max() < few * sigma
    # Stokes I has sigma / sqrt2 in each part
    assert vis.with_noise(2820 * u.Jy, 3).stokes()[..., 0].real.std() > 0


def test_noise_depends_on_seed_and_time_not_on_blocks():
    vis = scene(frequencies=(150, 151)).plan().run()
    from dataclasses import replace

    part = replace(vis, data=vis.data[2:5, 1:], at=vis.at.block(slice(2, 5), slice(1, 2)))
    whole = vis.with_noise(1000 * u.Jy, seed=1)
    assert np.array_equal(part.with_noise(1000 * u.Jy, seed=1).data, whole.data[2:5, 1:])
    assert not np.allclose(whole.data, vis.with_noise(1000 * u.Jy, seed=2).data)
    with pytest.raises(InputError, match="unit"):
        vis.with_noise(sefd=2820, seed=1)


def test_correction_undoes_corruption_for_full_jones_errors():
    errors = instrument.Chain(GainTerm(rms=0.2, seed=1), FeedTerm(rms=0.2, seed=2))
    vis = scene(beam=None).plan().run()
    back = vis.corrupted(errors).corrected(errors)
    assert np.abs(back.data - vis.data).max() < 1e-13 * np.abs(vis.data).max()
    assert np.abs(vis.corrupted(errors).data - vis.data).max() > 0.1
    with_errors = scene(beam=None, gain=GainTerm(rms=0.2, seed=1), feed=FeedTerm(rms=0.2, seed=2)).plan().run()
    assert np.abs(with_errors.corrected(errors).data - vis.data).max() < 1e-13 * np.abs(vis.data).max()


def test_taking_the_beam_out_at_the_centre_is_recorded_and_cannot_be_mixed_or_repeated():
    made = scene()
    vis = made.plan().run()
    term = Towards(chain=made.instrument.chain())
    corrected = vis.corrected(term)
    assert corrected.beam_state.removed == "centre"
    assert corrected.beam_state.towards == vis.phase_centre
    assert vis.beam_state.removed == "nothing"
    with pytest.raises(BeamStateError, match="cannot mix visibilities of differential beam"):
        corrected - vis
    with pytest.raises(BeamStateError, match="taken out already"):
        corrected.corrected(term)
    assert np.abs((corrected - corrected).data).max() == 0


def test_differential_beam_is_prediction_with_the_inverse_on_the_left():
    made = scene()
    vis = made.plan().run().corrected(Towards(chain=made.instrument.chain()))
    sky, times = made.sky, vis.times
    where = SkyCoord(sky.ra_rad, sky.dec_rad, unit="rad")
    j = made.instrument.beam(where, times, 150 * u.MHz, pointing=CENTRE, state="differential")[:, 0]
    b = sky.brightness(vis.at.towards(*sky.directions()))[0, 0]
    lmn = vis.at.towards(*sky.directions()).lmn
    phase = np.exp(-2j * np.pi * np.einsum("tbc,sc->tbs", vis.uvw_m * 150e6 / 299792458.0, lmn))
    ja, jb = j[:, vis.antenna1], j[:, vis.antenna2]
    want = np.einsum("tbs,tbsij,sjk,tbslk->tbil", phase, ja, b, jb.conj())
    assert np.abs(vis.data[:, 0] - want).max() < 1e-11


def test_singular_jones_matrices_are_flagged_never_passed_on():
    vis = scene(beam=None).plan().run()
    gains = np.ones((1, 1, len(STATIONS), 2), complex)
    gains[0, 0, 2, 1] = 0.0
    corrected = vis.corrected(GainTerm(values=gains))
    hit = (vis.antenna1 == 2) | (vis.antenna2 == 2)
    assert np.all(corrected.flag[..., hit])
    assert not np.any(corrected.flag[..., ~hit])
    assert np.isfinite(corrected.data).all()


def test_directional_terms_cannot_correct_visibilities():
    made = scene()
    with pytest.raises(InputError, match="use Towards"):
        made.plan().run().corrected(made.instrument.chain())


def test_nothing_is_changed_in_place():
    vis = scene().plan().run()
    before = vis.data.copy()
    vis.with_noise(100 * u.Jy, 1)
    vis.corrected(GainTerm(rms=0.1, seed=1))
    vis.flagged(np.ones((1, 1, 1), bool))
    vis.weighted(np.zeros((1, 1, 1)))
    assert np.array_equal(vis.data, before)
    assert not vis.flag.any()
    with pytest.raises(InputError, match="not negative"):
        vis.weighted(np.full((1, 1, 1), -1.0))
    with pytest.raises(InputError, match="data has shape"):
        vis.with_data(before[:3])


def test_times_and_baselines_are_what_the_observation_says():
    made = scene()
    vis = made.plan().run()
    want = made.observation.times(made.instrument.layout())
    assert np.abs((vis.times - want).to_value("s")).max() < 2e-6
    lengths = np.linalg.norm(vis.uvw_m, axis=-1)
    xyz = vis.layout.positions_m
    assert np.abs(lengths - np.linalg.norm(xyz[vis.antenna1] - xyz[vis.antenna2], axis=-1)).max() < 1e-6
