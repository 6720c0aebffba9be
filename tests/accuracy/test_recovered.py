"""A 21-cm signal and foregrounds in one scene, and what of the power injected is there at the end of the way."""

import copy
import warnings
from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable

import instrument
from instrument import (
    GainTerm,
    Imager,
    InputError,
    InstrumentError,
    Observation,
    Scene,
    SelfCal,
    Signal21cm,
    StokesCube,
    SumSky,
    recovered_power,
)
from instrument.analyze.power.signal_sky import SignalSky
from instrument.analyze.power.transform import Transform
from instrument.observe.sampling import Sampling
from instrument.pipeline.run import run
from instrument.pipeline.scene_file import parse
from instrument.sky.synchrotron import Synchrotron
from instrument.units import Direction

pytestmark = pytest.mark.filterwarnings("ignore::instrument.errors.InstrumentWarning")
AT = Direction(2.15, 0.84)
MHZ = np.linspace(140, 146, 16)


def white(seed, rms=1.0, shape=(12, 16, 16)):
    data = np.zeros((shape[0], 4, *shape[1:]))
    data[:, 0] = rms * np.random.default_rng(seed).normal(size=shape)
    return StokesCube(data, np.linspace(140, 143, shape[0]) * u.MHz, 4 * u.arcmin, "K")


# The ratio -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", ["spherical", "cylindrical"])
def test_what_came_through_whole_has_ratio_and_transfer_of_one_and_half_of_it_a_quarter(shape):
    signal = white(1)
    whole = recovered_power(signal, signal, shape=shape, bins=5)
    there = np.isfinite(whole.ratio)
    assert there.sum() >= 4
    np.testing.assert_allclose(whole.ratio[there], 1, rtol=1e-12)
    np.testing.assert_allclose(whole.transfer[there], 1, rtol=1e-12)
    assert np.nanmax(whole.ratio_sigma) < 1e-6
    half = recovered_power(signal.with_data(0.5 * signal.data), signal, shape=shape, bins=5)
    np.testing.assert_allclose(half.ratio[there], 0.25, rtol=1e-12)
    np.testing.assert_allclose(half.transfer[there], 0.5, rtol=1e-12)
    upside = recovered_power(signal.with_data(-signal.data), signal, shape=shape, bins=5)
    np.testing.assert_allclose(upside.transfer[there], -1, rtol=1e-12)  # the right power, and none of the signal


@pytest.mark.long
def test_the_scatter_that_is_said_is_that_over_many_foregrounds_and_noises():
    """0.8 of a signal under something of three times its power, 40 draws of both that and noise."""
    signal = white(1)
    ratios, transfers, said, unit = [], [], [], []
    for seed in range(40):
        noise, same = white(500 + seed, 0.6).data, white(900 + seed, 0.6)
        total = signal.with_data(0.8 * signal.data + white(100 + seed, np.sqrt(3)).data + noise)
        found = recovered_power(total, signal, noise=same, bins=4)
        ratios.append(found.ratio), transfers.append(found.transfer)
        said.append((found.ratio_sigma, found.transfer_sigma))
        unit.append(found.noise.power / 0.36 / found.injected.power)  # of rms 1, over the power of this one signal
    sigma = np.sqrt(np.mean(np.square(said), axis=0))
    for values, due, expected in zip((ratios, transfers), (0.64 + 3 * np.mean(unit, axis=0), 0.8), sigma, strict=True):
        pull = (np.mean(values, axis=0) - due) / (expected / np.sqrt(40))
        assert np.abs(pull).max() < 4
        assert np.std(values, axis=0, ddof=1) / expected == pytest.approx(np.ones(4), abs=0.35)


def seen(cube, coverage):
    """A cube of which an array sees each cell (u, v) with some weight."""
    plane = np.fft.ifft2(np.fft.fft2(cube.data, axes=(2, 3)) * coverage, axes=(2, 3)).real
    return cube.with_data(plane)


@pytest.mark.parametrize("taper_space", [None, "hann"])
@pytest.mark.parametrize("filled", [0.08, 0.3])
def test_the_scatter_is_that_of_the_cells_that_few_baselines_leave(filled, taper_space):
    """60 foregrounds and noises through 8 and 30 % of the cells; by the number of cells it is 1.4 to 4.5 times less.

    The two upper bins: the lower ones have one or two modes, of which the transfer that is found takes half a mode.
    """
    rng = np.random.default_rng(3)
    shape = (12, 32, 32)
    coverage = np.where(rng.random(shape[1:]) < filled / 2, rng.uniform(0.3, 3, shape[1:]), 0.0)
    coverage = coverage + np.roll(coverage[::-1, ::-1], (1, 1), (0, 1))  # both signs
    signal = seen(white(1, shape=shape), coverage)
    ratios, transfers, said, plain = [], [], [], []
    how = Transform(taper_space=taper_space)
    for seed in range(60):
        noise, same = (seen(white(k + seed, 0.6, shape), coverage).data for k in (500, 900))
        total = signal.with_data(0.8 * signal.data + seen(white(100 + seed, 1.7, shape), coverage).data + noise)
        found = recovered_power(total, signal, noise=signal.with_data(same), how=how, bins=4)
        ratios.append(found.ratio), transfers.append(found.transfer)
        said.append((found.ratio_sigma, found.transfer_sigma))
        modes = (found.injected.power / found.injected.sigma) ** 2
        plain.append(np.sqrt((found.foreign**2 + 2 * found.transfer**2 * found.foreign) / modes))
    sigma = np.sqrt(np.mean(np.square(said), axis=0))
    pulls = (np.array([np.std(x, axis=0, ddof=1) for x in (ratios, transfers)]) / sigma)[:, 2:]
    np.testing.assert_allclose(pulls, 1, atol=0.3)  # 60 draws tell each to 9 %
    assert np.all(np.std(ratios, axis=0, ddof=1)[2:] > 1.3 * np.mean(plain, axis=0)[2:])


def test_cells_are_compared_where_the_signal_has_them_in_whatever_order_and_number():
    """Cells that a PSF is too weak for are in one cube and not in another: there is no power of it."""
    signal, rng = white(1), np.random.default_rng(2)
    found = recovered_power(signal.with_data(signal.data + white(2).data), signal, bins=4)
    cells = found.recovered.cells
    order = rng.permutation(len(cells.k_perp))
    for kept, due in (
        (order, cells.power),
        (np.arange(1, len(order)), np.where(np.arange(len(order)), cells.power, 0)),
    ):
        taken = {name: getattr(cells, name)[kept] for name in ("k_perp", "times", "v_index", "u_index")}
        other = replace(found.recovered, cells=replace(cells, power=cells.power[:, kept], **taken))
        np.testing.assert_array_equal(replace(found, recovered=other)._placed(other), due)


@pytest.mark.filterwarnings("error")
def test_where_nothing_was_injected_there_is_no_scatter_and_no_noise_of_numpy():
    signal = white(1)
    for how, more in ((Transform(stokes="P"), {"bins": 4}), (Transform(), {"bins": np.array([50, 60, 70]) / u.Mpc})):
        found = recovered_power(signal, signal, how=how, **more)
        assert np.isnan(found.ratio_sigma).all() and np.isnan(found.transfer_sigma).all()


def test_natural_weights_make_the_scatter_of_a_spectrum_larger_than_even_ones():
    """What docs/spectra.md says: 59 LOFAR stations, 8 h, 480 pixels of 0.5 arcmin, bins of a third in uv."""
    layout = instrument.load("telescopes", "lofar-hba").layout()
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=8 * u.hour, interval=60 * u.s,
        frequencies=[150.0] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    centre = night.phase_centre
    at = Sampling.build(layout, night.times(layout), night.freq_hz, centre.ra_rad, centre.dec_rad, centre)
    one, two = layout.baselines
    uv = (at.uvw_m[:, one] - at.uvw_m[:, two])[..., :2].reshape(-1, 2) * 150e6 / 299792458.0
    cell, side = 1 / np.deg2rad(480 * 0.5 / 60), 125
    weight = np.histogram2d(*uv.T, bins=side, range=[[-side / 2 * cell, side / 2 * cell]] * 2)[0]
    place = (np.arange(side) - side // 2) * cell
    distance, weight = np.hypot(place[:, None], place), weight + weight[::-1, ::-1]
    larger = {1: [], 2: []}
    for low in np.geomspace(30, 800, 13)[:-1]:
        there = weight[(distance >= low) & (distance < low * 1.315)]
        for power, found in larger.items():  # noise goes by the weights, the sky by their squares
            found.append(np.sqrt(len(there) * (there ** (2 * power)).sum()) / (there**power).sum())
    assert max(larger[2]) == pytest.approx(1.35, abs=0.03) and max(larger[1]) == pytest.approx(1.1, abs=0.03)


def test_tables_are_written_and_cubes_that_do_not_fit_are_refused(tmp_path):
    signal = white(1)
    found = recovered_power(signal, signal, bins=4)
    found.write(tmp_path / "recovered.ecsv")
    table = found.table()
    assert {"k", "injected", "ratio", "ratio_sigma", "transfer", "transfer_sigma", "foreign"} <= set(table.colnames)
    assert (tmp_path / "recovered.ecsv").read_text().count("\n") > len(table)
    jansky = StokesCube(signal.data, signal.freq_hz * u.Hz, 4 * u.arcmin, "Jy/pixel")
    for other, said in (
        (jansky, "cubes are in K and Jy/pixel"),
        (white(1, shape=(12, 20, 16)), "pixels|shape"),
        (signal.with_data(0 * signal.data), "nothing was injected in Stokes I"),
    ):
        with pytest.raises(InputError, match=said):
            recovered_power(signal, other)
    holes = np.array(signal.data)
    holes[:, :, 3:6, 3:6] = np.nan
    np.testing.assert_allclose(recovered_power(signal.with_data(holes), signal, bins=4).ratio, 1, rtol=1e-12)


# The skies -------------------------------------------------------------------------------------------------------

BAND = {"band": (140 * u.MHz, 146 * u.MHz), "channels": 16}
SMALL = {"pixels": 24, "pixel": 20 * u.arcmin}


def test_the_signal_as_a_sky_is_the_cube_of_its_table_and_has_no_other_channels():
    sky = SignalSky(**SMALL, **BAND, seed=5).about(AT)
    cube = Signal21cm.table().cube(24, 20 * u.arcmin, MHZ * u.MHz, seed=5)
    np.testing.assert_allclose(sky.planes(MHZ[3:5] * 1e6), cube.sky().stokes[3:5], rtol=1e-6)
    with pytest.raises(InputError, match=r"no channel at 141 MHz .16 from 140 to 146 MHz.: observe some of these"):
        sky.planes(np.array([141e6]))
    for wrong, said in (({"model": "none"}, "no 21-cm model"), ({"band": (2 * u.MHz, 1 * u.MHz)}, "the first channel")):
        with pytest.raises(InstrumentError, match=said):
            SignalSky(**{**SMALL, **wrong})


def test_total_intensity_has_its_rms_its_slope_and_a_power_law_in_every_pixel():
    sky = Synchrotron(pixels=128, pixel=4 * u.arcmin, rms=3 * u.K, seed=2)
    t = np.stack([sky.kelvin(f)[0] for f in (120e6, 150e6, 187.5e6)]).astype(float)
    assert t[1].std() == pytest.approx(3, rel=1e-5) and abs(t[1].mean()) < 1e-3
    index = np.log(t[2] / t[0]) / np.log(187.5 / 120)
    assert index.mean() == pytest.approx(-2.55, abs=1e-3) and index.std() == pytest.approx(0.1, rel=1e-2)
    np.testing.assert_allclose(t[1] ** 2, t[0] * t[2], rtol=1e-4)
    uv = np.hypot(*np.meshgrid(*[np.fft.fftfreq(128, sky.pixel)] * 2))
    power, edges = np.abs(np.fft.fft2(t[1])) ** 2, np.geomspace(20, 300, 7)
    rings = np.digitize(uv, edges)
    rings = [(uv[rings == k].mean(), power[rings == k].mean()) for k in range(1, 7)]
    assert np.polyfit(*np.log(rings).T, 1)[0] == pytest.approx(-2.2, abs=0.25)
    with pytest.raises(InputError, match="no cell within uv_range"):
        Synchrotron(pixels=8, pixel=1 * u.arcmin, uv_range=(10, 200))


# The whole way ---------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_signal_is_recovered_after_beam_calibration_and_removal():
    """Stars, Galaxy, synchrotron and a strong signal through LOFAR's beams and gains of 1 %; 10 stations, 16 channels.

    Without foregrounds and errors all of it comes back; what is left under the foregrounds is foreign until they are
    removed; the signal that a remover takes with them is in the transfer, where foreign power cannot hide it.
    """
    names = [f"CS{n:03d}HBA{e}" for n in (1, 2, 3, 4, 5) for e in (0, 1)]
    lofar = instrument.load("telescopes", "lofar-hba", stations=names, gain=GainTerm(rms=1e-2, seed=3))
    night = Observation(
        phase_centre=AT, transit="2012-12-07", duration=8 * u.hour, interval=2 * u.hour, frequencies=MHZ * u.MHz
    )
    skies = {
        "signal": SignalSky(**SMALL, **BAND),
        "stars": instrument.load("skies", "grid", shape=(3, 3), spacing=1.5 * u.deg, flux=20 * u.Jy),
        "galaxy": instrument.load("skies", "galaxy", **SMALL, screens={"uv_range": (10, 800)}),
        "synchrotron": Synchrotron(**SMALL, rms=1 * u.K, uv_range=(7, 85)),
    }
    imager = Imager(pixels=32, pixel=20 * u.arcmin, uv_range=(10, 80), weighting="natural")

    def visibilities(array, *members):
        return Scene(instrument=array, sky=SumSky(skies={k: skies[k] for k in members}), observation=night).plan().run()

    alone = visibilities(lofar.perfect(), "signal")
    loud = alone.with_data(1e3 * alone.data)  # mK against K: 10 stations have too few cells for the real one
    rest = visibilities(lofar.perfect(), "stars", "galaxy", "synchrotron")
    gains = lofar.with_fields(beam=None).chain()
    total = rest.with_data(rest.data + loud.data).corrupted(gains)
    solution = SelfCal(tolerance=1e-8).solve(total, rest)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        injected, dirty = (imager.image(v) for v in (loud, total.corrected(solution.term)))
    clean = recovered_power(injected, injected, bins=4)
    np.testing.assert_allclose(clean.ratio, 1, rtol=1e-9)
    before = recovered_power(dirty, injected, bins=4)
    assert np.all(before.ratio[:3] > 300) and np.all(np.abs(before.transfer - 1) < 5 * before.transfer_sigma)
    for name, settings in (("pca", {"components": 3}), ("polynomial", {"terms": 3})):
        remover = instrument.load("foregrounds", name, **settings)
        after = recovered_power(remover.split(dirty).residual, injected, bins=4)
        assert np.all(after.ratio[:3] < before.ratio[:3] / 300) and after.ratio[3] < before.ratio[3]
        assert 0.5 < after.transfer[3] < 1 and after.transfer[1] < 0.2  # slow variation goes with the foreground
    # a linear remover takes of the signal what it takes of the signal alone
    due = recovered_power(remover.split(injected).residual, injected, bins=4)
    assert np.all(np.abs(after.transfer - due.transfer) < 4 * after.transfer_sigma)
    np.testing.assert_allclose(due.ratio, due.transfer**2 + due.foreign, rtol=1e-9)


# As a product of a run -------------------------------------------------------------------------------------------

TABLES = {
    "name": "way",
    "seed": 3,
    "instrument": {
        "telescope": "lofar-hba", "beam": "none", "gain": {"rms": 0.1},
        "stations": ["CS001HBA0", "CS001HBA1", "CS002HBA0", "CS003HBA0", "CS004HBA1", "CS005HBA0"],
    },
    "observation": {
        "phase_centre": "08h13m36.0s +48d13m03s", "transit": "2012-12-07", "duration": "8 h", "interval": "2 h",
        "frequency": {"centre": "146 MHz", "channel_width": "1 MHz", "channels": 8},
    },
    "sky": {
        "kind": "sum",
        "dust": {"kind": "synchrotron", "pixels": 32, "pixel": "20 arcmin", "rms": "2 mK", "uv_range": [7, 85]},
        "hydrogen": {
            "kind": "signal-21cm", "pixels": 32, "pixel": "20 arcmin", "band": ["142.5 MHz", "149.5 MHz"],
            "channels": 8,
        },
    },
    "image": {"pixels": 32, "pixel": "20 arcmin", "uv_range": [10, 80]},
    "analyze": {"products": ["recovered"], "cube": {"products": [], "bins": 3, "uv_range": [10, 80]}},
}  # fmt: skip


def ran(tmp_path, **changes):
    tables = {k: v for k, v in (copy.deepcopy(TABLES) | changes).items() if v is not None}
    made = run(parse(tables), tables, out=str(tmp_path), force=True)
    return made, QTable.read(tmp_path / "recovered.ecsv")


def test_a_run_compares_its_cube_with_the_signal_of_the_perfect_instrument(tmp_path):
    """To rounding what `recovered_power` has of the two cubes, which are made here by hand, gains of 10 % and all."""
    made, table = ran(tmp_path)
    scene = parse(copy.deepcopy(TABLES)).scene()
    alone = scene.with_fields(instrument=scene.instrument.perfect(), sky=scene.sky.skies["hydrogen"])
    imager = Imager(pixels=32, pixel=20 * u.arcmin, uv_range=(10, 80))
    cubes = [imager.image(one.plan().run()) for one in (scene, alone)]
    due = recovered_power(*cubes, how=Transform(taper_space="hann", uv_range=(10, 80)), bins=3).table()
    for name in ("injected", "ratio", "transfer"):
        np.testing.assert_allclose(table[name].value, due[name].value, rtol=1e-6)
    assert abs(table["transfer"][-1] - 1) > 1e-3  # gains of 10 % are in it
    assert set(made.stages["analyze"].record()["recovered"]) == {"with foregrounds"}
    page = (tmp_path / "report.html").read_text()
    assert ">Signal recovered<" in page and (tmp_path / "recovered.png").is_file()


def test_calibration_brings_the_signal_back_and_noise_is_taken_off(tmp_path):
    """All of it to 1e-6 without noise and foreground, solved block by block in channels; noise is no power of it."""
    sky = {"kind": "sum", "hydrogen": TABLES["sky"]["hydrogen"]}
    _, table = ran(tmp_path / "a", sky=sky, calibrate={"kind": "selfcal", "tolerance": 1e-10}, tolerance=1e-6)
    np.testing.assert_allclose(table["ratio"], 1, rtol=1e-6)
    np.testing.assert_allclose(table["transfer"], 1, rtol=1e-6)
    bare = TABLES["instrument"] | {"gain": {"rms": 0.0}}
    _, noisy = ran(tmp_path / "b", sky=sky, instrument=bare, noise={"sefd": "2820 Jy", "nights": 1})
    assert np.all(noisy["foreign"] > 10)  # to which the ratio would be equal; few baselines are few modes
    assert np.all(np.abs(noisy["ratio"] - 1) < 0.4 * noisy["foreign"])


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"sky": TABLES["sky"]["dust"]}, "needs a sky that is a sum with one 21-cm signal.*no such member"),
        ({"analyze": {"products": ["recovered"]}}, "takes its bins and tapers from a table .analyze.cube."),
        ({"image": TABLES["image"] | {"kind": "clean"}}, "a CLEAN of the signal alone is not that of the signal"),
    ],
)
def test_a_run_that_cannot_tell_is_refused_before_it_begins(tmp_path, changes, said):
    with pytest.raises(InputError, match=said) as error:
        ran(tmp_path / "out", **changes)
    assert "\n" not in str(error.value) and not (tmp_path / "out").exists()


def test_solutions_of_blocks_of_channels_are_those_of_the_whole():
    scene = parse(copy.deepcopy(TABLES)).scene()
    scene = scene.with_fields(sky=instrument.load("skies", "grid", shape=(2, 2), spacing=2 * u.deg, flux=5 * u.Jy))
    model = scene.with_fields(instrument=scene.instrument.perfect()).plan().run()
    data, solver = scene.plan().run(), SelfCal(tolerance=1e-10)
    cuts = [(slice(t, t + 2), slice(f, min(f + 3, 8))) for t in (0, 2) for f in (0, 3, 6)]
    parts = [solver.solve(data.block(*cut), model.block(*cut)) for cut in cuts]
    whole, joined = solver.solve(data, model), instrument.Solution.joined(parts)
    for name in ("slots_s", "freq_hz"):
        np.testing.assert_array_equal(getattr(joined.term, name), getattr(whole.term, name))
    np.testing.assert_allclose(joined.jones, whole.jones, rtol=1e-8)
    assert (joined.outcome == whole.outcome).all() and joined.error.shape == whole.error.shape
    np.testing.assert_allclose(joined.residual, whole.residual, atol=1e-9)
