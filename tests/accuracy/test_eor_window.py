"""The 21-cm signal, the EoR window, and the cross-polarization ratio: tables, closed forms, what is refused."""

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable

from instrument import Analyzer, InputError, Signal21cm, StokesCube, ixr, mueller
from instrument.analyze.power.bins import Frame
from instrument.analyze.power.cells import Cells
from instrument.analyze.power.cylinders import Cylindrical
from instrument.analyze.power.window import eor_window
from instrument.errors import InstrumentWarning, UnitError

PIXEL = 2 * u.arcmin
FREQ = (150e6 + 0.4e6 * np.arange(32)) * u.Hz
FLAT = Signal21cm("flat", 8.5, np.array([1e-4, 1e3]), np.array([10.0, 10.0]))  # 10 mK² at every k


def white(sigma_k, seed=0, pixels=48):
    data = np.zeros((32, 4, pixels, pixels))
    data[:, 0] = sigma_k * np.random.default_rng(seed).normal(size=(32, pixels, pixels))
    return StokesCube(data, FREQ, PIXEL, "K")


# The signal -------------------------------------------------------------------------------------------------------


def test_the_tables_are_those_of_their_source():
    """notes: 15.5 mK² at 0.068, 24.6 at 0.10, 27.5 at 0.23, 24.4 at 0.77, 73 at 2.2 / Mpc."""
    signal = Signal21cm.table()
    assert signal.name == "21cmFAST_2011_z9.50" and signal.redshift == 9.5
    assert signal.neutral_fraction == pytest.approx(0.521, abs=1e-3)
    k, want = [0.06765439, 0.1014223, 0.2292262, 0.7745761, 2.192064], [15.5, 24.65, 27.55, 24.44, 73.33]
    np.testing.assert_allclose(signal.delta2(k), want, rtol=2e-3)
    assert set(Signal21cm.names()) == {"21cmFAST_2011_z9.50", "EOS2016_faint_z9.04", "EOS2016_bright_z9.04"}
    # the spread between models near 0.1 / Mpc is larger than any other uncertainty
    assert Signal21cm.table("EOS2016_faint_z9.04").delta2(0.0947) == pytest.approx(0.9, abs=0.1)
    assert Signal21cm.table("EOS2016_bright_z9.04").delta2(0.0947) == pytest.approx(46, abs=3)


def test_between_the_points_the_logarithm_is_linear_and_outside_there_is_no_answer():
    signal = Signal21cm("two", 9, np.array([0.1, 1.0]), np.array([4.0, 400.0]))
    assert signal.delta2(10**-0.5) == pytest.approx(40, rel=1e-12)
    assert signal.delta2(0.1 * (1 / u.Mpc)) == pytest.approx(4, rel=1e-12)
    assert signal.power(0.5) == pytest.approx(2e-6 * np.pi**2 * signal.delta2(0.5) / 0.125, rel=1e-12)
    for k in (0.0999, 1.01, np.array([0.2, 3.0]), np.nan, 0.0):
        with pytest.raises(InputError, match=r"is not within the 0.1 to 1 /Mpc of 'two'"):
            signal.delta2(k)
    assert np.isnan(signal.power_or_nan(np.array([0.01, 0.2]))).tolist() == [True, False]


def test_little_h_is_refused():
    from astropy.cosmology import units as cu

    with pytest.raises(UnitError, match="k needs a unit convertible to 1/Mpc"):
        Signal21cm.table().delta2(0.1 * cu.littleh / u.Mpc)


def test_an_unknown_model_and_a_table_that_is_none_are_refused():
    with pytest.raises(InputError, match=r"is called 'EOS2016_fain': did you mean 'EOS2016_faint_z9.04'"):
        Signal21cm.table("EOS2016_fain")
    for k, delta2 in (([1, 0.5], [1, 1]), ([1], [1]), ([0, 1], [1, 1]), ([1, 2], [0, 1]), ([1, 2], [np.nan, 1])):
        with pytest.raises(InputError, match="signal 'mine' needs growing k"):
            Signal21cm("mine", 9, np.array(k), np.array(delta2))


def test_the_cylindrical_form_has_the_same_ratio_as_the_power():
    """Delta²_21 k_perp² k_par / 2 k³ over the paper's k_perp² k_par P / (2 pi)² is P_21 / P, in every bin."""
    found = Analyzer(white(1e-3)).cylindrical(bins=6, bins_par=5)
    signal = Signal21cm.table()
    k = np.hypot(found.k_perp[:, None], found.k_par)
    here = 1e-6 * signal.cylindrical(found.k_perp, found.k_par) / found.delta2
    np.testing.assert_allclose(here, signal.power(k) / found.power, rtol=1e-12)


@pytest.mark.parametrize("periodic", [True, False])
def test_a_cube_of_the_signal_has_its_spectrum(periodic):
    """6 cubes: the mean of each bin within 4.5 sigma of the signal averaged over its cells."""
    signal = Signal21cm.table()
    tapers = {"taper": None} if periodic else {"taper": "blackman-harris", "taper_space": "hann"}
    with pytest.warns(InstrumentWarning, match="outside the 0.0197 to 2.19 /Mpc of '21cmFAST_2011_z9.50' and get no"):
        cubes = [signal.cube((72, 73), PIXEL, FREQ, seed=s, periodic=periodic) for s in range(6)]
    edges = np.geomspace(0.1, 0.5, 5) / u.Mpc
    found = [Analyzer(c).spherical(bins=edges, **tapers) for c in cubes]
    mean, want = np.mean([s.power for s in found], axis=0), found[0].average(signal.power_or_nan)
    # few modes, and P is steep within a bin: their effective number is lower than the count says by up to 1.5
    assert np.all(abs(mean / want - 1) < 4.5 * 1.3 * found[0].sigma / found[0].power / np.sqrt(6) + 0.02)
    assert cubes[0].unit == "K" and cubes[0].data.shape == (32, 4, 72, 73) and not cubes[0].data[:, 1:].any()


def test_a_seed_gives_the_same_cube_and_another_another():
    def make(seed):
        return FLAT.cube(24, PIXEL, FREQ, seed=seed).data

    np.testing.assert_array_equal(make(1), make(1))
    assert abs(np.corrcoef(make(1)[:, 0].ravel(), make(2)[:, 0].ravel())[0, 1]) < 0.05
    with pytest.raises(InputError, match="must be two or more that grow evenly"):
        FLAT.cube(24, PIXEL, [150] * u.MHz, seed=1)


# The window -------------------------------------------------------------------------------------------------------


def made(ratio, par_edges=(0.05, 0.1, 0.2, 0.4, 0.8, 1.6), noise=None, **settings):
    """A window whose leakage has this power over that of FLAT at the centre of each bin, by hand: 3 x 5 bins."""
    ratio = np.asarray(ratio, float)
    par = np.array(par_edges)
    perp = np.array([0.03, 0.06, 0.12, 0.24])
    k_perp, k_par = (np.sqrt(e[1:] * e[:-1]) for e in (perp, par))

    class Plain(Cylindrical):
        def average(self, model):
            return model(np.hypot(self.k_perp[:, None], self.k_par))

    frame = Frame("K", "I", 150e6, 8.47, 9276.0, 1.72e-5, None, None, None, 0.0, 0, False)
    power = ratio * FLAT.power(np.hypot(k_perp[:, None], k_par))
    count = np.full(power.shape, 10)
    spectrum = Plain(k_perp, k_par, power, power / 3, count, perp, par, frame, {}, Cells.__new__(Cells))
    other = None
    if noise is not None:
        other = Plain(k_perp, k_par, noise * power / ratio, power, count, perp, par, frame, {}, Cells.__new__(Cells))
    return eor_window(spectrum, FLAT, noise=other, **settings)


RATIO = np.array([[0.1, 0.2, 0.5, 2.0, 9.0], [0.1, 0.3, 0.9, 4.0, 3.0], [0.2, 0.3, 0.4, 0.8, 8.0]])


def test_the_window_is_open_where_leakage_is_below_the_signal():
    window = made(RATIO)
    np.testing.assert_allclose(window.ratio(), RATIO, rtol=1e-12)
    np.testing.assert_array_equal(window.mask(), RATIO < 1)
    # bins are ln 2 by ln 2, 10 of 15 open
    assert window.area() == pytest.approx((10 * np.log(2) ** 2, 10 / 15), rel=1e-12)
    assert window.reach() == pytest.approx((0.05, 0.4))  # all k_perp
    assert window.reach(share=0.3) == pytest.approx((0.05, 0.8))


def test_removing_70_percent_of_the_leakage_leaves_9_percent_of_its_power():
    window = made(RATIO)
    np.testing.assert_allclose(window.ratio(0.7), 0.09 * RATIO, rtol=1e-12)
    assert window.mask(0.7).all() and window.reach(0.7) == pytest.approx((0.05, 1.6))


def test_the_removal_that_opens_it_is_1_less_the_root_of_the_largest_ratio():
    window = made(RATIO)
    assert window.removal_needed(0.6) == pytest.approx(1 - 1 / 2, rel=1e-12)  # ratio 4 below 0.6 / Mpc
    assert window.removal_needed(1.5) == pytest.approx(1 - 1 / 3, rel=1e-12)  # 9
    assert window.removal_needed(0.3) == 0
    needed = window.removal_needed(1.5)
    assert window.mask(needed + 1e-9).all() and not window.mask(needed - 1e-3).all()


def test_noise_adds_to_the_leakage_and_no_removal_helps_against_it():
    window = made(np.full((3, 5), 2.0), noise=0.5)
    np.testing.assert_allclose(window.ratio(), 2.5, rtol=1e-12)
    assert window.removal_needed(1.5) == pytest.approx(1 - np.sqrt(0.5 / 2), rel=1e-12)
    hopeless = made(np.full((3, 5), 2.0), noise=1.5)
    assert np.isnan(hopeless.removal_needed(1.5)) and not hopeless.mask(1.0).any()
    assert "cannot be done: noise is above the signal" in str(hopeless)


def test_bins_in_the_wedge_do_not_count():
    window = made(RATIO, wedge=90 * u.deg)
    line = 3.59 * window.leakage.k_perp[:, None]
    np.testing.assert_array_equal(window.counts, window.leakage.k_par >= line)
    assert not window.mask()[~window.counts].any()
    assert made(RATIO, k_par_min=0.3).counts.sum() == 6
    with pytest.raises(InputError, match=r"no bin counts up to k_par = 0.01 /Mpc"):
        window.removal_needed(0.01)


def test_an_interrupted_window_reaches_from_its_longest_run():
    ratio = np.ones((3, 5)) * [0.5, 2, 0.5, 0.5, 2]
    assert made(ratio).reach() == pytest.approx((0.2, 0.8))
    assert np.isnan(made(np.full((3, 5), 2.0)).reach()).all()


def test_bins_outside_the_model_or_without_cells_are_unknown_and_said():
    signal = Signal21cm("narrow", 9, np.array([0.1, 0.5]), np.array([10.0, 10.0]))
    window = Analyzer(white(1e-6)).eor_window(signal, bins=8, bins_par=20)
    assert (window.leakage.count == 0).any()
    outside = np.hypot(window.leakage.k_perp[:, None], window.leakage.k_par) > 0.5
    assert window.unknown[outside].all() and window.unknown[window.leakage.count == 0].all()
    assert window.mask()[~window.unknown].all() and not window.mask()[window.unknown].any()
    assert f"{window.unknown.sum()} unknown" in str(window)


def test_a_cube_opens_its_window_at_the_removal_that_is_said(tmp_path):
    """White leakage of 5 mK: P is flat, so its ratio to the signal grows with k and the window closes above."""
    analyzer = Analyzer(white(5e-3))
    cut = (20, 200)  # k_perp up to 0.14 / Mpc
    window = analyzer.eor_window(FLAT, uv_range=cut)
    low, high = window.reach()
    assert low < 0.1 and high < 0.9
    needed = window.removal_needed(0.4)
    assert 0 < needed < 1
    assert window.mask(needed + 1e-6)[window.counts & (window.leakage.k_par <= 0.4)].all()
    half = StokesCube(analyzer.cube.data / 2, FREQ, PIXEL, "K")
    np.testing.assert_allclose(Analyzer(half).eor_window(FLAT, uv_range=cut).ratio(), window.ratio(0.5), rtol=1e-9)
    with_noise = analyzer.eor_window(FLAT, noise=white(5e-3, seed=1), uv_range=cut)
    assert with_noise.area()[0] < window.area()[0]
    window.write(tmp_path / "window.ecsv")
    back = QTable.read(tmp_path / "window.ecsv", format="ascii.ecsv")
    np.testing.assert_array_equal(back["open"].reshape(window.mask().shape), window.mask())
    assert back.meta["model"] == "flat"


def test_a_cube_that_is_not_in_kelvin_is_refused():
    cube = white(1.0)
    with pytest.raises(InputError, match=r"the spectrum is in Jy/beam, the signal in K: take .* cube.to_kelvin\(\)"):
        Analyzer(StokesCube(cube.data, FREQ, PIXEL, "Jy/beam")).eor_window(FLAT)
    with pytest.raises(InputError, match="eor_window needs a cube"):
        Analyzer().eor_window(FLAT)
    with pytest.raises(InputError, match=r"removed = 1.2 must be a finite number of at least 0 and of at most 1"):
        made(RATIO).mask(1.2)


# The cross-polarization ratio -------------------------------------------------------------------------------------


@pytest.mark.parametrize("condition", [1.0001, 1.05, 1.5, 10.0, 1e4])
def test_the_ratios_of_a_leakage_are_those_of_a_station_that_leaks_it(condition):
    jones = np.diag([condition, 1.0]).astype(complex)
    m = mueller.mueller(jones, jones).real
    leakage = m[1, 0] / m[0, 0]
    assert ixr.ixr_of_leakage(leakage) == pytest.approx(10 * np.log10(mueller.ixr_mueller(jones)), rel=1e-9)
    assert ixr.ixr_of_leakage(leakage, "jones") == pytest.approx(10 * np.log10(mueller.ixr_jones(jones)), rel=1e-6)
    for kind in ("mueller", "jones"):
        assert ixr.leakage_of_ixr(ixr.ixr_of_leakage(leakage, kind), kind) == pytest.approx(leakage, rel=1e-9)


def test_a_leakage_of_1e_12_keeps_its_digits():
    assert ixr.ixr_of_leakage(1e-12) == pytest.approx(120, rel=1e-12)
    assert ixr.ixr_of_leakage(1e-12, "jones") == pytest.approx(240 + 10 * np.log10(4), rel=1e-12)


def test_70_percent_removed_from_25_db_is_30_2_db():
    rows = ixr.removal_table(25.0)
    (row,) = (r for r in rows if r["removed_percent"] == 70)
    assert row["ixr_m_db"] == pytest.approx(25 + 10 * np.log10(1 / 0.3), rel=1e-9)
    assert row["ixr_m_db"] == pytest.approx(30.2, abs=0.05)
    assert row["leakage_percent"] == pytest.approx(0.3 * 100 * 10**-2.5, rel=1e-12)
    assert row["power_left"] == pytest.approx(0.09)


def test_leakages_and_ratios_that_are_none_are_refused():
    for bad in (0, -0.1, 1.5, np.nan):
        with pytest.raises(InputError, match=r"must be a fraction above 0 and at most 1: 0.3 % is 0.003"):
            ixr.ixr_of_leakage(bad)
    with pytest.raises(InputError, match="must be 0 dB or more"):
        ixr.leakage_of_ixr(-1)
    with pytest.raises(InputError, match="must be shares from 0 to below 1"):
        ixr.removal_table(25, removed=[1.0])
