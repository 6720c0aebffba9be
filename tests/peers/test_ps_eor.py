"""Power spectra beside ps_eor, powerbox and tools21cm: the same cells and bins give the same power, and where one of
them goes wrong (ps_eor 1.2, powerbox 1.0, tools21cm 2.4.3) ours does not.

Cubes of white noise and of a steep Gaussian field in K, 64 x 64 pixels of 2', 32 channels of 0.4 MHz at 150 MHz.
"""

import warnings

import numpy as np
import pytest
from astropy import units as u
from astropy.cosmology import Planck15

from instrument import Analyzer, InputError, StokesCube

pytestmark = pytest.mark.peer

PIXEL = 2 * u.arcmin
RAD = PIXEL.to_value(u.rad)
STEP = 0.4e6
SHAPE = (32, 64, 64)
NAMES = {None: "boxcar", "hann": "hann", "blackman-harris": "blackmanharris"}  # ours: theirs


def band(n):
    return 150e6 + STEP * (np.arange(n) - (n - 1) / 2)


def analyzer(**planes):
    """Of fields (F, Ny, Nx) by the name of their Stokes parameter."""
    shape = np.shape(next(iter(planes.values())))
    data = np.zeros((shape[0], 4, *shape[1:]))
    for name, field in planes.items():
        data[:, "IQUV".index(name)] = field
    return Analyzer(StokesCube(data, band(shape[0]) * u.Hz, PIXEL, "K"))


def white(seed=0, shape=SHAPE):
    return np.random.default_rng(seed).normal(size=shape)


def steep(seed=0, shape=SHAPE):
    """Periodic, P ~ k^-3 in cells: 1e4 between the largest scales and the smallest."""
    k = np.sqrt(sum(np.square(x) for x in np.meshgrid(*(np.fft.fftfreq(n) for n in shape), indexing="ij")))
    return np.fft.ifftn(np.fft.fftn(white(seed, shape)) * np.maximum(k, 1 / 64) ** -1.5).real


def box_of(frame, shape):
    """Lengths in Mpc (frequency, y, x)."""
    depth = shape[0] * STEP * frame.depth_mpc_per_hz
    return [depth, *(n * RAD * frame.distance_mpc for n in shape[1:])]


def voxel(frame):
    return np.prod(box_of(frame, (1, 1, 1)))


# ps_eor -----------------------------------------------------------------------------------------------------------

U_CENTRES = np.array([50, 100, 150, 200, 250, 300, 350.0])  # wavelengths
U_EDGES = np.r_[U_CENTRES[0] - 0.5 / np.pi, (U_CENTRES[1:] + U_CENTRES[:-1]) / 2, U_CENTRES[-1] + 0.5 / np.pi]
K_EDGES = np.array([0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4])  # 1/Mpc; below Nyquist, which it leaves out
CUT = (30, 400)


def by_ps_eor(field, taper, delays):
    """Its cylindrical P (u, delay), its spherical Delta² and mean k, and k_par, in K and Mpc without h.

    The bandwidth of N channels is (N - 1) dnu there, so its power is N / (N - 1) too high; and unless told otherwise
    it takes N - 1 delays, 1 / ((N - 1) dnu) apart.
    """
    datacube, pspec = (pytest.importorskip(f"ps_eor.{name}") for name in ("datacube", "pspec"))
    n, freq = len(field), band(len(field))
    about = datacube.ImageMetaData.from_res(RAD, field.shape[1:])
    about.wcs.wcs.cdelt[2] = STEP
    visibilities = datacube.CartImageCube(field, freq, about).ft(*CUT)
    settings = pspec.PowerSpectraConfig(el=2 * np.pi * U_CENTRES, window_fct=NAMES[taper])
    settings.umin, settings.umax = CUT
    made = pspec.PowerSpectraCart(pspec.EorBin(0, freq, freq, M=delays), settings, datacube.NoPrimaryBeam())
    h = Planck15.h
    flat, ball = made.get_ps2d(visibilities), made.get_ps3d(K_EDGES / h, visibilities)
    return flat.data.T / h**3 * (n - 1) / n, ball.data * (n - 1) / n, ball.k_mean * h, made.k_par * h


def by_us(field, taper):
    """The same of ours: delays 1 to N/2 - 1, without k_par = 0."""
    cells = analyzer(I=field).cells(taper=taper, uv_range=CUT)
    step = cells.k_par[1]
    flat = cells.cylindrical(
        bins=2 * np.pi * U_EDGES / cells.frame.distance_mpc / u.Mpc,
        bins_par=step * (np.arange(len(cells.k_par) - 1) + 0.5) / u.Mpc,
    )
    ball = cells.spherical(bins=K_EDGES / u.Mpc, k_par_min=0.5 * step / u.Mpc)
    return flat.power, ball.delta2, ball.k, flat.k_par


@pytest.mark.parametrize("taper", NAMES)
@pytest.mark.parametrize("field", [white, steep])
def test_spectra_are_those_of_ps_eor_on_the_same_delays(field, taper):
    """4e-8 of its 1420.4057 MHz; and it takes off the mean of all visibilities, seen within the lobe of a taper."""
    flat, ball, k, k_par = by_us(field(), taper)
    their_flat, their_ball, their_k, their_k_par = by_ps_eor(field(), taper, SHAPE[0])
    np.testing.assert_allclose(k_par, their_k_par, rtol=1e-6)
    np.testing.assert_allclose(k, their_k, rtol=1e-6)
    lobe = {None: 0, "hann": 1, "blackman-harris": 3}[taper]
    np.testing.assert_allclose(flat[:, lobe:], their_flat[:, lobe:], rtol=1e-6)
    np.testing.assert_allclose(flat, their_flat, rtol=1e-2)
    np.testing.assert_allclose(ball, their_ball, rtol=1e-2)


@pytest.mark.parametrize("taper", NAMES)
def test_white_noise_has_the_power_of_ps_eor_on_the_delays_it_takes_by_itself(taper):
    """Other delays of the same noise, so other cells in the bins: P to 1 %, 8 cubes scatter by 0.3 %."""
    ours, theirs = [], []
    for seed in range(8):
        for found, (flat, ball, k, _) in (
            (ours, by_us(white(seed), taper)),
            (theirs, by_ps_eor(white(seed), taper, None)),
        ):
            found.append([flat.mean(), *(ball / k**3).reshape(2, 3).mean(axis=1)])
    np.testing.assert_allclose(np.mean(ours, axis=0) / np.mean(theirs, axis=0), 1, atol=0.01)


@pytest.mark.parametrize("shape", [(8, 31, 31), (9, 33, 31), (8, 32, 32)])
def test_a_tone_at_5_cells_is_at_5_cells_of_an_odd_image_too(shape):
    """ps_eor labels u and v of odd images one cell off: at (-1, 4) of 31 pixels."""
    tone = np.cos(2 * np.pi * 5 * np.arange(shape[2]) / shape[2]) * np.ones((*shape[:2], 1))
    found = analyzer(I=tone).cells(taper=None)
    bright = found.power[0] > 1e-20 * found.power[0].max()
    assert bright.sum() == 1
    uv = found.k_perp[bright] * found.frame.distance_mpc / (2 * np.pi)
    assert uv == pytest.approx(5 / (shape[2] * RAD), rel=1e-12)


# powerbox and tools21cm -------------------------------------------------------------------------------------------


def by_powerbox(field, box, edges):
    powerbox = pytest.importorskip("powerbox")
    return powerbox.get_power(field, box, bins=edges, dimensionless=False).power


def by_tools21cm(field, box, edges):
    tools21cm = pytest.importorskip("tools21cm")
    return tools21cm.power_spectrum_1d(field, kbins=edges, box_dims=box)[0]


@pytest.mark.parametrize("theirs", [by_powerbox, by_tools21cm])
@pytest.mark.parametrize("shape", [SHAPE, (33, 63, 48), (32, 45, 64)])
@pytest.mark.parametrize("field", [white, steep])
def test_spherical_spectra_are_those_of_powerbox_and_tools21cm_to_rounding(field, shape, theirs):
    """V / N² |DFT|² over the same cells, all in double precision; no cell lies on an edge, k = 0 is in no bin."""
    made = analyzer(I=field(1, shape)).cells(taper=None)
    edges = np.geomspace(0.0311, 0.55, 9)
    found = made.spherical(bins=edges / u.Mpc)
    assert (found.count > 0).all()
    np.testing.assert_allclose(found.power, theirs(field(1, shape), box_of(found.frame, shape), edges), rtol=1e-10)


def test_cylindrical_spectra_are_those_of_tools21cm_to_rounding():
    tools21cm = pytest.importorskip("tools21cm")
    field = white(2)
    cells = analyzer(I=field).cells(taper=None)
    perp, par = np.geomspace(0.031, 0.5, 6), np.geomspace(0.021, 0.44, 5)
    found = cells.cylindrical(bins=perp / u.Mpc, bins_par=par / u.Mpc)
    # edges are taken from a list only, and frequency is the last axis
    box = box_of(found.frame, SHAPE)
    there = tools21cm.power_spectrum_2d(
        np.moveaxis(field, 0, 2).copy(), kbins=[perp, par], box_dims=[*box[1:], box[0]], nu_axis=2
    )
    np.testing.assert_allclose(found.power, there[0], rtol=1e-10)


def test_q_and_u_both_count_as_with_powerbox():
    """tools21cm loses U: its power is half."""
    q, w = white(3), white(4)
    edges = np.geomspace(0.0311, 0.55, 7)
    found = analyzer(Q=q, U=w).cells("P", taper=None).spherical(bins=edges / u.Mpc)
    np.testing.assert_allclose(found.power, by_powerbox(q + 1j * w, box_of(found.frame, SHAPE), edges), rtol=1e-10)
    assert np.average(found.power, weights=found.count) / voxel(found.frame) == pytest.approx(2, rel=0.02)


def test_a_window_keeps_the_level_of_white_noise_and_the_array():
    """tools21cm leaves mean w² in (0.26 for Blackman-Harris) and writes the window into the caller's array."""
    level = []
    for seed in range(8):
        given = analyzer(I=white(seed))
        before = given.cube.data.copy()
        found = given.spherical(taper="blackman-harris", bins=[0.1, 0.5] / u.Mpc)
        np.testing.assert_array_equal(given.cube.data, before)
        level.append(found.power[0] / voxel(found.frame))
    assert np.mean(level) == pytest.approx(1, abs=0.015)  # 4e5 modes, half of them alike behind the taper: 0.003


def test_empty_bins_are_nan_where_tools21cm_fills_in_their_neighbours():
    """40 log bins of 32³ cells; those that have cells are as powerbox has them."""
    shape = (32, 32, 32)
    made = analyzer(I=white(5, shape)).cells(taper=None)
    edges = np.geomspace(0.028, 0.6, 41)
    found = made.spherical(bins=edges / u.Mpc)
    empty = found.count == 0
    assert empty.sum() > 3 and np.array_equal(np.isnan(found.power), empty)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of powerbox, about the empty bins
        there = by_powerbox(white(5, shape), box_of(found.frame, shape), edges)
    np.testing.assert_allclose(found.power[~empty], there[~empty], rtol=1e-10)


def test_a_channel_of_nan_is_one_clear_line_or_filled_in():
    """With powerbox and tools21cm every bin is NaN."""
    field = white(6)
    field[7] = np.nan
    with pytest.raises(InputError, match=r"1 channels are all NaN \(7\): fill them in with infill") as caught:
        analyzer(I=field).spherical()
    assert "\n" not in str(caught.value)
    assert np.isfinite(analyzer(I=field).spherical(bins=4, infill=300 * u.ns).power).all()
