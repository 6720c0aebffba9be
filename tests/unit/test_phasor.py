"""Compiled phasors against their definitions: `array_factor` and `station_phases`, small, odd and huge."""

import numpy as np
import pytest

from instrument.phasor import CHUNK, array_factor, array_factor_reference, station_phases, station_phases_reference

# cycles of size c in float64 are off by c eps / 2 for each rounding on the way, the phase by 2 pi times that; the sine
# and the cosine themselves (1.2e-16) vanish beside it
PHASE_ROUNDING = np.pi * np.finfo(float).eps


def exact(cycles):
    """exp(2 pi i cycles) in extended precision, as (cosine, sine); where there is none, to 1.5e-16."""
    angle = 8 * np.arctan(np.longdouble(1)) * (np.asarray(cycles, np.longdouble) - np.rint(cycles))
    return np.cos(angle), np.sin(angle)


def waves_and_offsets(count, parts=24, units=3, rows=2, reach=30.0):
    rng = np.random.default_rng(count)
    return rng.uniform(-0.7, 0.7, (rows, 3, count)), rng.uniform(-reach, reach, (units, parts, 3))


@pytest.mark.parametrize("count", [1, 2, CHUNK - 1, CHUNK, CHUNK + 1, 3 * CHUNK + 17])
def test_array_factor_is_its_definition_whatever_the_number_of_directions(count):
    waves, offsets = waves_and_offsets(count)
    found = array_factor(waves, offsets)
    assert found.shape == (2, 3, count)
    # up to 63 cycles, of which each of two sums of three products rounds 3 times
    np.testing.assert_allclose(found, array_factor_reference(waves, offsets), rtol=0, atol=6 * 63 * PHASE_ROUNDING)


def test_array_factor_of_a_station_is_right_to_1e_14():
    # LOFAR: 15 m at 0.7 waves per m, 11 cycles
    waves, offsets = waves_and_offsets(1000, reach=5.0)
    np.testing.assert_allclose(
        array_factor(waves, offsets), array_factor_reference(waves, offsets), rtol=0, atol=6 * 11 * PHASE_ROUNDING
    )
    assert 6 * 11 * PHASE_ROUNDING < 1e-13


def test_array_factor_is_1_towards_the_pointing():
    _, offsets = waves_and_offsets(1)
    np.testing.assert_array_equal(array_factor(np.zeros((1, 3, 5)), offsets), 1.0)


def test_one_part_away_from_the_origin_has_a_factor_of_modulus_1():
    waves, offsets = waves_and_offsets(300, parts=1)
    np.testing.assert_allclose(np.abs(array_factor(waves, offsets)), 1.0, rtol=0, atol=5e-16)


def test_parts_in_antiphase_cancel():
    offsets = np.array([[[0.0, 0, 0], [0.5, 0, 0]]])
    waves = np.array([[[1.0], [0.0], [0.0]]])
    assert abs(array_factor(waves, offsets)[0, 0, 0]) < 1e-16


@pytest.mark.parametrize("cycles", [0.0, 0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 1.0, -0.25, -3.5, 1e6 + 0.25])
def test_eighths_of_a_turn_are_exact_to_rounding(cycles):
    found = array_factor(np.array([[[cycles], [0.0], [0.0]]]), np.array([[[1.0, 0, 0]]]))[0, 0, 0]
    cosine, sine = exact(cycles)
    assert max(abs(found.real - cosine), abs(found.imag - sine)) < 1.2e-16


def test_every_phase_of_a_turn_is_right_to_2e_16():
    # the series is claimed to be below 1.2e-16; its last rounding adds 1.1e-16
    cycles = np.concatenate([np.linspace(-1, 1, 100_001), np.nextafter(np.arange(-8, 9) / 8, 9)])
    found = array_factor(np.stack([cycles, 0 * cycles, 0 * cycles])[None], np.array([[[1.0, 0, 0]]]))[0, 0]
    cosine, sine = exact(cycles)
    assert np.abs(found.real - cosine).max() < 2.3e-16
    assert np.abs(found.imag - sine).max() < 2.3e-16


@pytest.mark.parametrize("count", [1, 2, CHUNK + 1])
@pytest.mark.parametrize("stations", [1, 5])
def test_station_phases_are_their_definition(count, stations):
    rng = np.random.default_rng(count)
    uvw = rng.uniform(-1e3, 1e3, (2, stations, 3))
    lmn = rng.uniform(-0.3, 0.3, (count, 3))
    found = station_phases(uvw, lmn)
    assert found.shape == (2, stations, count)
    # up to 900 cycles in three products: each of the two sums rounds 3 times
    np.testing.assert_allclose(found, station_phases_reference(uvw, lmn), rtol=0, atol=6 * 900 * PHASE_ROUNDING)


@pytest.mark.parametrize("turns", [1e3, 1e6, 1e9, 1e12])
def test_phases_of_many_turns_lose_nothing_in_the_sine(turns):
    # cycles of a power of two and 10 more bits are exact, so that only the reduction and the sine are at stake
    part = np.round(np.random.default_rng(3).uniform(-1, 1, 400) * 1024) / 1024
    uvw = np.zeros((1, len(part), 3))
    uvw[0, :, 0] = 2.0 ** np.round(np.log2(turns)) + part
    found = station_phases(uvw, np.array([[1.0, 0.0, 0.0]]))[0, :, 0]
    cosine, sine = exact(-part)
    assert max(np.abs(found.real - cosine).max(), np.abs(found.imag - sine).max()) < 2.3e-16


def test_phases_of_one_direction_and_one_station_by_hand():
    found = station_phases(np.array([[[3.0, 5.0, 7.0]]]), np.array([[0.01, -0.02, -0.00025]]))
    assert found[0, 0, 0] == pytest.approx(np.exp(-2j * np.pi * (0.03 - 0.1 - 0.00175)), abs=1e-15)


def test_strided_input_gives_the_same():
    waves, offsets = waves_and_offsets(40)
    np.testing.assert_array_equal(
        array_factor(np.asfortranarray(waves), offsets[:, ::-1][:, ::-1]), array_factor(waves, offsets)
    )
    rng = np.random.default_rng(0)
    uvw, lmn = rng.uniform(-9, 9, (2, 4, 3)), rng.uniform(-0.1, 0.1, (9, 3))
    np.testing.assert_array_equal(
        station_phases(np.asfortranarray(uvw), lmn[::-1])[..., ::-1], station_phases(uvw, lmn)
    )


def test_repeated_calls_give_the_same_bits():
    waves, offsets = waves_and_offsets(500)
    assert array_factor(waves, offsets).tobytes() == array_factor(waves, offsets).tobytes()


def test_a_part_of_the_directions_gives_the_same_bits():
    waves, offsets = waves_and_offsets(700)
    whole = array_factor(waves, offsets)
    np.testing.assert_array_equal(array_factor(waves[..., 300:420], offsets), whole[..., 300:420])


def test_no_direction_gives_an_empty_answer():
    assert array_factor(np.zeros((2, 3, 0)), np.zeros((1, 4, 3))).shape == (2, 1, 0)
    assert station_phases(np.zeros((2, 4, 3)), np.zeros((0, 3))).shape == (2, 4, 0)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_phase_that_is_not_finite_gives_nan(bad):
    found = station_phases(np.array([[[bad, 0.0, 0.0], [1.0, 0.0, 0.0]]]), np.array([[0.5, 0.0, 0.0]]))
    assert np.isnan(found[0, 0, 0])
    assert found[0, 1, 0] == pytest.approx(-1.0)
