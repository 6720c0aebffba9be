"""Line E1: no data is not zero: channels and voxels of one value, in files and in arrays."""

import warnings

import numpy as np
import pytest
from astropy import units as u

from instrument import Analyzer, InputError, Psf, Signal21cm, StokesCube, leaked, polarized_screens, read_cube
from instrument.errors import InstrumentWarning, UnusedWarning, unused_ledger

MHZ = np.linspace(134, 166, 32) * u.MHz
SKY = polarized_screens(32, 3 * u.arcmin, MHZ, seed=1)
RNG = np.random.default_rng(0)


def cube(data, constants="no data", psf=None, unit="K"):
    return StokesCube(data, MHZ, 3 * u.arcmin, unit, psf=psf, constants=constants)


def quiet(data):
    with pytest.warns(UnusedWarning, match="the cube: not used: .*one value: no data"):
        return cube(data)


def zeroed(data, channel=11, value=0):
    out = np.array(data)
    out[channel] = value
    return out


@pytest.mark.parametrize("value", [0, -999, 1e20])
def test_e1_a_channel_of_one_value_is_no_data_and_the_spectrum_is_that_of_the_whole(value):
    """Power of P at the highest delays: 1.8e-5 whole and filled in, 1e3 with a channel of zeros taken at its word."""
    holed = quiet(zeroed(SKY.data, value=value))
    assert np.isnan(holed.data[11, 1:3]).all()
    settings = {"taper_space": "hann", "bins": 4}
    whole = Analyzer(SKY).cylindrical("P", **settings).power[:, -8:].mean()
    filled = Analyzer(holed).cylindrical("P", **settings, infill=300 * u.ns).power[:, -8:].mean()
    taken = Analyzer(cube(zeroed(SKY.data), "data")).cylindrical("P", **settings).power[:, -8:].mean()
    assert filled == pytest.approx(whole, rel=0.02)
    assert taken > 1e6 * whole
    with pytest.raises(InputError, match=r"1 channels are all NaN \(11\): fill them in with infill=300"):
        Analyzer(holed).cylindrical("P")


def test_e1_the_window_of_a_cube_with_an_empty_channel_is_that_of_the_whole():
    seen = leaked(SKY, 10.0)
    holed = quiet(zeroed(seen.data))

    def share(one, **more):
        found = Analyzer(one).eor_window(Signal21cm.table(), wedge=10 * u.deg, **more)
        return found.mask().sum() / found.counts.sum()

    whole = share(seen)
    assert 0.3 < whole < 0.9
    assert share(holed, infill=300 * u.ns) == pytest.approx(whole, abs=0.02)
    assert share(cube(zeroed(seen.data), "data")) == 0


def source(rm=3.0, pixels=8):
    """P of modulus 1 everywhere, at one Faraday depth; I and V are zero."""
    lambda2 = (299792458.0 / MHZ.to_value("Hz")) ** 2
    p = np.exp(2j * rm * lambda2)[:, None, None] * np.ones((pixels, pixels))
    p = p * np.exp(2j * np.pi * RNG.uniform(size=(pixels, pixels)))
    data = np.zeros((32, 4, pixels, pixels))
    data[:, 1], data[:, 2] = p.real, p.imag
    return data


def test_e1_a_source_behind_empty_channels_has_its_whole_depth():
    data = source()
    for empty in (zeroed(data), zeroed(data, slice(0, 32, 12))):
        assert np.abs(Analyzer(quiet(empty)).rm_synthesis([3.0]).data) == pytest.approx(np.ones((1, 8, 8)), rel=1e-12)
        assert np.abs(Analyzer(cube(empty, "data")).rm_synthesis([3.0]).data).max() < 0.98


def test_e1_voxels_of_zero_in_half_of_the_channels_are_no_data():
    data = source()
    data[:16, :, :, :3] = 0
    found = np.abs(Analyzer(quiet(data)).rm_synthesis([3.0]).data)
    assert found == pytest.approx(np.ones((1, 8, 8)), rel=1e-12)
    assert np.abs(Analyzer(cube(data, "data")).rm_synthesis([3.0]).data)[0, :, :3] == pytest.approx(0.5, abs=1e-12)
    # one source on nothing: half of its channels
    alone = np.zeros_like(data)
    alone[16:, 1:3, 4, 4] = data[16:, 1:3, 4, 4]
    assert np.abs(Analyzer(quiet(alone)).rm_synthesis([3.0]).data)[0, 4, 4] == pytest.approx(1, rel=1e-12)


@pytest.mark.parametrize("value", [0.0, -999.0])
def test_e1_a_rim_of_one_value_is_no_data_and_the_power_is_that_of_what_is_there(value):
    field = RNG.normal(size=(32, 4, 24, 24))
    wide = np.full((32, 4, 48, 48), value)
    wide[:, :, 12:36, 12:36] = field
    edges = [0.2, 0.4, 0.6] / u.Mpc
    plain = Analyzer(cube(field)).spherical(taper=None, bins=edges).power
    with pytest.warns(InstrumentWarning, match="75 % of the voxels of I, 75 % of the voxels of Q, U"):
        rimmed = cube(wide)
    with pytest.warns(InstrumentWarning, match="hold NaN"):
        padded = Analyzer(rimmed).spherical(taper=None, bins=edges).power
    assert padded / plain == pytest.approx(1, abs=0.1)


def test_e1_what_is_a_value_stays_one():
    """Sources on nothing, uniform skies, U of a source of depth 0, leakage at the centre, one channel, one pixel."""
    lone = np.zeros((32, 4, 8, 8))
    lone[7, 0, 3, 5] = 1e12
    uniform = np.ones((32, 4, 8, 8)) * np.linspace(2, 1, 32)[:, None, None, None]
    flat = np.zeros((32, 4, 8, 8))
    flat[:, 1] = RNG.normal(size=(8, 8))  # a source of depth 0: U is 0, Q one image in every channel
    no_u = source()
    no_u[:, 2, 3] = 0
    pixel = RNG.normal(size=(32, 4, 1, 1))
    pixel[4] = 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for data in (
            leaked(SKY).data,
            lone,
            uniform,
            flat,
            no_u,
            pixel,
            np.zeros((32, 4, 8, 8)),
            RNG.normal(size=(32, 4, 8, 8)),
        ):
            assert cube(data).data is data
        one = RNG.normal(size=(1, 4, 8, 8))
        one[0, 0] = 0
        assert StokesCube(one, MHZ[:1], 3 * u.arcmin, "K").data is one


def test_e1_what_was_given_is_not_changed_and_whole_numbers_can_have_holes():
    data = zeroed(RNG.integers(1, 9, size=(32, 4, 8, 8)))
    before = data.copy()
    found = quiet(data)
    assert np.array_equal(data, before)
    assert np.isnan(found.data[11]).all()
    assert np.array_equal(np.delete(found.data, 11, 0), np.delete(before, 11, 0))
    with pytest.raises(InputError, match="constants = 'zero' is not"):
        cube(data, "zero")


def test_e1_a_channel_without_data_and_without_a_beam_does_not_stop_the_rest(tmp_path):
    widths = np.full(32, 9.0)
    widths[11] = 0.0  # as WSClean and CASA write it
    data = zeroed(RNG.normal(size=(32, 4, 16, 16)).astype(np.float32))
    cube(data, "data", Psf.gaussian(widths * u.arcmin), "Jy/beam").write(tmp_path / "a.fits")
    with unused_ledger() as ledger, pytest.warns(UnusedWarning, match=r"a.fits: not used: channel 11 of I, .*of Q, U"):
        found = read_cube(tmp_path / "a.fits")
    assert ledger["a.fits"] == ["channel 11 of I", "channel 11 of Q, U", "channel 11 of V"]
    kelvin = found.to_kelvin().data
    assert np.isnan(kelvin[11]).all()
    assert np.isfinite(np.delete(kelvin, 11, 0)).all()
