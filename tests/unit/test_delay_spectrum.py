"""Delay spectra: noise of known variance, a flat 21-cm spectrum through a beam, the wedge, flags, blocks."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.cosmology import Planck15

from instrument import Analyzer, Composed, Direction, InputError, Layout, Observation, PointSky, Scene
from instrument.errors import InstrumentWarning

C, K, F21 = 299792458.0, 1.380649e-23, 1420405751.768
FREQ = 150e6 + 1e5 * np.arange(-32, 32)
CENTRE, FWHM = Direction(2.15, 0.84), np.deg2rad(8.0)
OMEGA = np.pi * FWHM**2 / (8 * np.log(2))
Z = F21 / ((FREQ[0] + FREQ[-1]) / 2) - 1
DISTANCE = Planck15.comoving_transverse_distance(Z).to_value("Mpc")
DEPTH = C * (1 + Z) ** 2 / (Planck15.H(Z).to_value("m/(s Mpc)") * F21)


@pytest.fixture(scope="module")
def empty():
    """Visibilities of nothing: 24 antennas within 120 m, 4 times, 64 channels."""
    rng = np.random.default_rng(1)
    enu = np.c_[rng.uniform(-60, 60, (24, 2)), np.zeros(24)] * u.m
    layout = Layout.from_enu([f"s{k}" for k in range(24)], enu, 6.9 * u.deg, 48 * u.deg, 10 * u.m)
    night = Observation(
        phase_centre=CENTRE, transit="2014-01-01", duration=40 * u.s, interval=10 * u.s,
        frequencies=FREQ * u.Hz, channel_width=0.1 * u.MHz,
    )  # fmt: skip
    sky = PointSky(names=("a",), ra_rad=[2.15], dec_rad=[0.84], stokes_jy=np.array([[1.0, 0, 0, 0]]))
    vis = Scene(instrument=Composed(stations=layout), sky=sky, observation=night).plan().run()
    return vis.with_data(0 * vis.data)


def noise(vis, sigma, seed=2):
    rng = np.random.default_rng(seed)
    return vis.with_data(sigma * (rng.standard_normal((*vis.data.shape, 2)) @ [1, 1j]))


def per_jy2():
    """K² Mpc³ of a variance of 1 Jy² a channel."""
    kelvin = 1e-26 * C**2 / (2 * K * FREQ**2)
    return (kelvin**2).mean() * DISTANCE**2 * DEPTH * 1e5 / OMEGA


@pytest.mark.parametrize("taper", [None, "blackman-harris"])
@pytest.mark.parametrize("stokes", ["I", "V", "P"])
def test_noise_has_the_power_of_its_variance_whatever_the_taper(empty, taper, stokes):
    """I = (pp + qq) / 2: both parts of a variance 2 sigma² each make 2 sigma² / 2; Q + iU twice that."""
    found = Analyzer(visibilities=noise(empty, 3.0)).delay_spectrum(OMEGA * u.sr, stokes, taper, bins=1)
    want = per_jy2() * 9.0 * (2 if stokes == "P" else 1)
    count = found.count.sum()
    alike = 1.0 if taper is None else 2.0  # neighbouring delays of the taper
    assert abs(found.power.ravel() @ found.count.ravel() / count / want - 1) < 4 * np.sqrt(alike / count)
    worth = np.abs(found.power[0] / want - 1) / (found.sigma[0] / found.power[0])
    assert found.unit == "K" and np.sqrt((worth**2).mean()) == pytest.approx(1, abs=0.35)  # sigma is the scatter


def test_across_times_noise_has_no_bias_and_a_steady_sky_keeps_its_power(empty):
    noisy = noise(empty, 3.0)
    found = Analyzer(visibilities=noisy).delay_spectrum(OMEGA * u.sr, across_times=True, bins=1)
    auto = Analyzer(visibilities=noisy).delay_spectrum(OMEGA * u.sr, bins=1)
    mean = np.average(found.power[0], weights=found.count[0])
    assert abs(mean) < 4 * per_jy2() * 9 * np.sqrt(2.0 / found.count.sum()) < 0.1 * auto.power.min()
    one_by_one = [noisy.block(slice(t, t + 1), slice(None)) for t in range(4)]
    again = Analyzer(visibilities=one_by_one).delay_spectrum(OMEGA * u.sr, across_times=True, bins=1)
    assert np.allclose(again.power, found.power, rtol=1e-9, atol=1e-12 * auto.power.max())
    steady = empty.with_data(np.broadcast_to(noisy.data[:1], noisy.data.shape).copy())
    one, two = (
        Analyzer(visibilities=steady).delay_spectrum(OMEGA * u.sr, across_times=a, bins=1).power for a in (False, True)
    )
    assert np.allclose(one, two, rtol=1e-2)  # bins by u, which turns a little


def test_a_flat_spectrum_of_21_cm_comes_back_through_a_gaussian_beam(empty):
    """White noise of rms T in voxels of volume v has P = T² v; summed over pixels here, source by source."""
    rng, side, pixel = np.random.default_rng(7), 96, np.deg2rad(0.25)
    l, m = (x.ravel() * pixel for x in np.meshgrid(*[np.arange(side) - side / 2 + 0.5] * 2))
    beam = np.exp(-4 * np.log(2) * (l**2 + m**2) / FWHM**2)
    assert np.sum(beam**2) * pixel**2 == pytest.approx(OMEGA, rel=1e-3)
    temperature = 0.01 * rng.standard_normal((len(FREQ), side**2))
    flux = temperature * beam * pixel**2 * 2 * K * FREQ[:, None] ** 2 / C**2 * 1e26
    uvw = empty.uvw_m[0]
    stokes_i = np.stack([
        np.exp(-2j * np.pi * f / C * (np.outer(uvw[:, 0], l) + np.outer(uvw[:, 1], m))) @ s
        for f, s in zip(FREQ, flux, strict=True)
    ])  # fmt: skip
    data = np.zeros(empty.data.shape, complex)
    data[..., 0, 0] = data[..., 1, 1] = stokes_i[None]
    one = empty.with_data(data).block(slice(0, 1), slice(None))
    want = 0.01**2 * (DISTANCE * pixel) ** 2 * DEPTH * 1e5
    for taper in (None, "blackman-harris"):
        found = Analyzer(visibilities=one).delay_spectrum(OMEGA * u.sr, taper=taper, bins=1)
        mean = np.average(found.power[0], weights=found.count[0])
        # 276 baselines of 0 to 60 wavelengths, of cells 1 / FWHM = 7 wavelengths wide: 60 of them, by 64 delays
        assert mean / want == pytest.approx(1, abs=4 / np.sqrt(60 * 64 / 2))
    whole = found.cells.spherical(bins=3)
    assert np.average(whole.power, weights=whole.count) / want == pytest.approx(1, abs=0.1)
    assert found.k_perp[0] == pytest.approx(
        np.mean(np.hypot(*uvw.T[:2])) * FREQ.mean() / C * 2 * np.pi / DISTANCE, 1e-6
    )


def test_a_source_lies_on_the_line_of_its_angle_in_the_wedge(empty):
    """Flat of spectrum, 30 deg off: its power is at k_par = wedge(30 deg) where the baseline points to it."""
    layout = Layout.from_enu(["a", "b"], [[0, 0, 0], [290, 0, 0]] * u.m, 6.9 * u.deg, 48 * u.deg, 10 * u.m)
    night = Observation(
        phase_centre=CENTRE, transit="2014-01-01", duration=10 * u.s, interval=10 * u.s, frequencies=FREQ * u.Hz
    )
    west = PointSky(names=("a",), ra_rad=[2.15 - 0.7], dec_rad=[0.84], stokes_jy=np.array([[5.0, 0, 0, 0]]))
    plan = Scene(instrument=Composed(stations=layout), sky=west, observation=night).plan()
    vis = plan.run()
    found = Analyzer(visibilities=vis).delay_spectrum(OMEGA * u.sr, bins=[0.001, 1] / u.Mpc)
    l, m, less = vis.at.towards(np.array([2.15 - 0.7]), np.array([0.84])).lmn[0]
    step, peak = found.k_par[0], found.k_par[np.argmax(found.power[0])]
    assert abs(peak - 2 * np.pi * abs(vis.uvw_m[0, 0] @ [l, m, less]) / C / DEPTH) < 0.51 * step
    assert abs(l) > 0.25 and abs(peak - found.wedge(np.arcsin(abs(l)) * u.rad)[0]) < 0.6 * step  # east-west, at transit
    beyond = found.k_par > found.wedge(90 * u.deg)[0] + 4 * step
    assert beyond.sum() > 10 and found.power[0, beyond].max() < 1e-8 * found.power.max()
    blocks = replace(plan, block_shape=(1, 10))  # blocks of ten channels are one band
    again = Analyzer(visibilities=blocks).delay_spectrum(OMEGA * u.sr, bins=[0.001, 1] / u.Mpc)
    assert np.allclose(again.power, found.power, rtol=1e-12, atol=0)


def test_what_is_not_there_in_all_channels_is_left_out_and_counted(empty):
    noisy = noise(empty, 3.0)
    flag = np.zeros(noisy.data.shape[:3], bool)
    flag[1, 5, 3], flag[2, 9, :10] = True, True
    with pytest.warns(InstrumentWarning, match="1 % of the integrations of baselines are not there in all channels"):
        found = Analyzer(visibilities=noisy.flagged(flag)).delay_spectrum(OMEGA * u.sr, bins=1)
    assert found.left_out["integrations of baselines without all channels"] == 11 * 64
    assert len(found.cells.k_perp) == 4 * 276 - 11
    every = np.zeros((1, 64, 1), bool)
    every[0, 30] = True
    with pytest.raises(InputError, match="there in all channels at one time: fill in or leave out"):
        Analyzer(visibilities=noisy.flagged(every)).delay_spectrum(OMEGA * u.sr)


def test_what_has_no_delay_spectrum_is_refused_in_one_line(empty):
    with pytest.raises(InputError, match="made of visibilities"):
        Analyzer().delay_spectrum(OMEGA * u.sr)
    with pytest.raises(InputError, match="solid_angle needs a unit"):
        Analyzer(visibilities=empty).delay_spectrum(0.1)
    with pytest.raises(InputError, match="one channel has no delays"):
        Analyzer(visibilities=empty.block(slice(None), slice(0, 1))).delay_spectrum(OMEGA * u.sr)
    odd = replace(empty, at=replace(empty.at, freq_hz=np.append(FREQ[:-1], FREQ[-1] + 3e4)))
    with pytest.raises(InputError, match="not evenly spaced"):
        Analyzer(visibilities=odd).delay_spectrum(OMEGA * u.sr)
    parts = [empty.block(slice(0, 1), slice(0, 9)), empty.block(slice(1, 2), slice(9, 18))]
    with pytest.raises(InputError, match="other channels than one another"):
        Analyzer(visibilities=parts).delay_spectrum(OMEGA * u.sr)
