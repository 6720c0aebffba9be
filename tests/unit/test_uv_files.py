"""UVFITS and UVH5, in and out: what comes back to the last bit, what to which rounding, the traps between programs."""

import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits

import instrument
from instrument import Direction, Imager, InputError, Observation, PointSky, Scene, UVFile, write_uv
from instrument.beam_state import BeamState
from instrument.errors import FileError, InstrumentWarning
from instrument.files import by_rows, uv_data
from instrument.files.ms_frame import TO_CIRCULAR

pyuvdata = pytest.importorskip("pyuvdata", reason="the extra 'uv'")
STATIONS = ["CS001HBA0", "CS002HBA1", "CS017HBA0", "RS106HBA"]
CENTRE = Direction(2.15, 0.84)
OFF = (2.15 + 0.012, 0.84 + 0.006)  # 28 arcmin east, 21 north
SKY = PointSky(names=("a",), ra_rad=[OFF[0]], dec_rad=[OFF[1]], stokes_jy=np.array([[4.0, 1.0, -0.5, 0.25]]))


def predicted(stations):
    lofar = instrument.load("telescopes", "lofar-hba", stations=stations, beam=None)
    night = Observation(
        phase_centre=CENTRE, start="2014-03-01T20:00:03.7", duration=50 * u.s, interval=10 * u.s,
        frequencies=[150, 150.1, 150.2] * u.MHz, channel_width=0.1 * u.MHz,
    )  # fmt: skip
    return Scene(instrument=lofar, sky=SKY, observation=night).plan().run()


@pytest.fixture(scope="module")
def made():
    """Visibilities of one source off the centre, polarized, with weights and flags of correlations."""
    vis = predicted(STATIONS)
    rng = np.random.default_rng(2)
    weight = rng.integers(1, 99, vis.data.shape) / 8  # single precision exactly
    return vis.weighted(weight).flagged(rng.random(vis.data.shape) < 0.1)


def whole(path, **settings):
    (block,) = UVFile(path, **settings).blocks()
    return block


def opened(path):
    uv = pyuvdata.UVData()
    (uv.read_uvh5 if path.suffix == ".uvh5" else uv.read_uvfits)(str(path))
    return uv


def same_but_for_rounding(found, vis):
    """Bit for bit, but for times (a Julian day has 40 us), UVW (stations are solved for), and positions."""
    assert found.layout.names == vis.layout.names
    assert np.abs(found.layout.positions_m - vis.layout.positions_m).max() < 1e-8
    assert np.abs(found.at.slots_s - vis.at.slots_s).max() < 2.1e-5
    assert np.abs(found.uvw_m - vis.uvw_m).max() < 1e-8 and found.at.own_uvw_m is not None
    assert np.array_equal(found.flag, vis.flag) and np.array_equal(found.weight, vis.weight)
    assert np.allclose(found.freq_hz, vis.freq_hz, rtol=1e-15, atol=0) and np.allclose(found.width_hz, vis.width_hz)
    assert np.allclose(found.interval_s, vis.interval_s) and np.allclose(found.phase_centre, vis.phase_centre, 1e-15)


@pytest.mark.parametrize("name", ["a.uvh5", "a.uvfits"])
@pytest.mark.parametrize("precision", ["single", "double"])
def test_data_come_back_to_the_last_bit_of_their_precision(tmp_path, made, name, precision):
    write_uv(tmp_path / name, made, precision=precision)
    found = whole(tmp_path / name)
    want = made.data if precision == "double" else made.data.astype(np.complex64)
    assert np.array_equal(found.data, want) and np.abs(want - made.data).max() <= 6e-8 * np.abs(made.data).max()
    same_but_for_rounding(found, made)
    write_uv(tmp_path / f"again-{name}", found, precision=precision)
    assert np.array_equal(whole(tmp_path / f"again-{name}").data, found.data)


def test_precision_is_double_in_uvh5_and_single_in_uvfits(tmp_path, made):
    for name in ("a.uvh5", "a.uvfits"):
        write_uv(tmp_path / name, made)
    assert opened(tmp_path / "a.uvh5").data_array.dtype == complex
    assert fits.getheader(tmp_path / "a.uvfits")["BITPIX"] == -32


@pytest.mark.parametrize("name", ["a.uvh5", "a.uvfits"])
def test_pyuvdata_itself_finds_antenna_2_minus_1_and_the_phase_of_the_source(tmp_path, made, name):
    """ant1 < ant2, uvw = pos2 - pos1, V = exp(2 pi i (u l + v m + w (n - 1))) with it, whatever order ours has."""
    turned = replace(
        made, antenna1=made.antenna2, antenna2=made.antenna1, data=np.conj(np.swapaxes(made.data, -1, -2)),
        weight=np.swapaxes(made.weight, -1, -2), flag=np.swapaxes(made.flag, -1, -2),
    )  # fmt: skip
    for vis in (made, turned):
        write_uv(tmp_path / name, vis, overwrite=True, precision="double")
        uv = opened(tmp_path / name)
        assert np.all(uv.ant_1_array < uv.ant_2_array)
        theirs = uv.uvw_array.copy()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            uv.set_uvws_from_antenna_positions(update_vis=False)
        # their north is 3.5 arcsec from ours, by differences over a degree; w is the same to 2e-8
        assert np.abs(theirs - uv.uvw_array).max() < 2e-5 * np.linalg.norm(theirs, axis=1).max()
        assert np.abs(theirs - uv.uvw_array)[:, 2].max() < 1e-3
        l, m, less = made.at.towards(*np.atleast_2d(OFF).T).lmn[0]
        waves = np.einsum("nc,c,f->nf", theirs, [l, m, less], uv.freq_array) / 299792458.0
        i = (uv.data_array[..., 0] + uv.data_array[..., 1]) / 2
        assert np.abs(i - 4.0 * np.exp(2j * np.pi * waves)).max() < 1e-9
        assert np.array_equal(whole(tmp_path / name).data, made.data)


@pytest.mark.parametrize("name", ["a.uvh5", "a.uvfits"])
def test_a_source_off_the_centre_is_imaged_at_its_place(tmp_path, name):
    core = [n for n in instrument.load("telescopes", "lofar-hba").layout().names if n.startswith("CS")][:24]
    vis = predicted(core)
    write_uv(tmp_path / name, vis)
    pixel, size = 30 * u.arcsec, 160
    cube = Imager(pixels=size, pixel=pixel).image(UVFile(tmp_path / name))
    y, x = np.unravel_index(np.nanargmax(cube.data[0, 0]), (size, size))
    l, m, _ = vis.at.towards(*np.atleast_2d(OFF).T).lmn[0] / pixel.to_value("rad")
    assert np.hypot(x - size // 2 + l, y - size // 2 - m) < 1.0  # x runs to the west
    assert 3.8 < cube.data[0, 0, y, x] <= 4.0


def test_uvfits_says_where_its_antennas_are_and_numbers_them_from_one(tmp_path, made):
    write_uv(tmp_path / "a.uvfits", made, telescope="LOFAR")
    with fits.open(tmp_path / "a.uvfits") as hdus:
        antennas = hdus["AIPS AN"]
        assert antennas.header["TIMSYS"] == antennas.header["TIMESYS"] == "UTC"  # of CASA; of AIPS
        assert antennas.header["FRAME"] == "ITRF" and antennas.header["ARRNAM"] == "LOFAR"
        array = np.array([antennas.header[f"ARRAY{axis}"] for axis in "XYZ"])
        longitude = np.arctan2(array[1], array[0])
        (c, s), local = (np.cos(longitude), np.sin(longitude)), antennas.data["STABXYZ"]
        places = array + local @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        assert np.abs(places - made.layout.positions_m).max() < 1e-8
        assert [str(n).strip() for n in antennas.data["ANNAME"]] == STATIONS  # longer than the 8 letters of AIPS
        assert antennas.data["NOSTA"].tolist() == [1, 2, 3, 4]
        assert set(hdus[0].data.par("ANTENNA1")) | set(hdus[0].data.par("ANTENNA2")) == {1, 2, 3, 4}


def test_times_of_uvfits_are_two_parameters_and_good_to_20_microseconds(tmp_path, made):
    write_uv(tmp_path / "a.uvfits", made)
    with fits.open(tmp_path / "a.uvfits") as hdus:
        data, header = hdus[0].data, hdus[0].header
        places = [k + 1 for k, name in enumerate(data.parnames) if name.upper().startswith("DATE")]
        assert len(places) == 2
        first, second = (data.field(k - 1).astype(float) for k in places)  # of single precision each
        midnight = sum(header[f"PZERO{k}"] for k in places)
        assert midnight % 1 == 0.5
        parts = first - midnight if first.max() > 1e6 else first
    seconds = (midnight - 2400000.5) * 86400 + (parts + second) * 86400
    assert np.abs(np.unique(np.round(seconds, 4)) - made.at.slots_s).max() < 1e-3
    assert np.abs(whole(tmp_path / "a.uvfits").at.slots_s - made.at.slots_s).max() < 2.1e-5


def changed(tmp_path, made, change, name="b.uvh5"):
    """The file of others: ours, changed through pyuvdata."""
    write_uv(tmp_path / "a.uvh5", made, overwrite=True)
    uv = opened(tmp_path / "a.uvh5")
    uv = change(uv) or uv
    uv.write_uvh5(str(tmp_path / name), clobber=True, run_check=False)
    return tmp_path / name


def test_rows_in_any_order_turned_with_gaps_in_the_numbers_and_autocorrelations(tmp_path, made):
    def change(uv):
        uv.telescope.antenna_numbers = np.array([41, 7, 300, 12])  # in no order
        uv.ant_1_array, uv.ant_2_array = (uv.telescope.antenna_numbers[x - 1] for x in (uv.ant_1_array, uv.ant_2_array))
        uv.baseline_array = uv.antnums_to_baseline(uv.ant_1_array, uv.ant_2_array)
        uv.conjugate_bls("u<0")
        rng = np.random.default_rng(3)
        order = rng.permutation(uv.Nblts)
        for key in ("ant_1_array", "ant_2_array", "time_array", "lst_array", "integration_time", "uvw_array",
                    "baseline_array", "phase_center_id_array", "data_array", "flag_array", "nsample_array",
                    "phase_center_app_ra", "phase_center_app_dec", "phase_center_frame_pa"):  # fmt: skip
            setattr(uv, key, getattr(uv, key)[order])
        uv.ant_2_array[-2:] = uv.ant_1_array[-2:]
        uv.blts_are_rectangular, uv.time_axis_faster_than_bls, uv.blt_order = False, False, None
        uv.baseline_array = uv.antnums_to_baseline(uv.ant_1_array, uv.ant_2_array)

    path = changed(tmp_path, made, change)
    with pytest.warns(InstrumentWarning, match="2 rows are autocorrelations: left out"):
        found = whole(path)
    assert found.layout.names == tuple(STATIONS)
    lost = np.all(found.flag, axis=(1, 3, 4)) & ~np.all(made.flag, axis=(1, 3, 4))
    assert lost.sum() == 2
    kept = ~lost
    assert np.array_equal(np.moveaxis(found.data, 1, 2)[kept], np.moveaxis(made.data, 1, 2)[kept])
    assert np.array_equal(np.moveaxis(found.weight, 1, 2)[kept], np.moveaxis(made.weight, 1, 2)[kept])
    assert np.abs(found.uvw_m - made.uvw_m).max() < 1e-8


def test_a_drift_scan_is_phased_to_what_is_given_and_else_refused(tmp_path, made):
    """Unprojected by pyuvdata and phased again by us: sources at the same place, to the accuracy of its Earth."""

    def drift(uv):
        uv.unproject_phase()

    path = changed(tmp_path, made, drift)
    with pytest.raises(InputError, match="drift scan without a phase centre: give centre="):
        UVFile(path)
    found = whole(path, centre=CENTRE)
    assert found.at.own_uvw_m is None and found.phase_centre == CENTRE
    short = (found.antenna1 == 0) & (found.antenna2 == 1)  # 300 m; 0.5 arcsec of w is 8e-4 m
    assert np.abs(found.data - made.data)[:, :, short].max() < 0.02
    with pytest.raises(InputError, match="has a phase centre: centre= is for drift scans"):
        UVFile(tmp_path / "a.uvh5", centre=CENTRE)


def test_a_drift_scan_of_our_own_fringes_comes_back_to_rounding(tmp_path, made):
    def drift(uv):
        w = -made.uvw_m[:, :, 2].reshape(-1, 1)  # antenna 2 minus 1
        uv.data_array = uv.data_array * np.exp(2j * np.pi * w * uv.freq_array / 299792458.0)[..., None]
        uv.phase_center_catalog[0] = {"cat_name": "zenith", "cat_type": "unprojected", "cat_frame": "altaz",
                                      "cat_lon": 0.0, "cat_lat": np.pi / 2, "cat_epoch": None}  # fmt: skip

    found = whole(changed(tmp_path, made, drift), centre=CENTRE)
    # 20 us of a Julian day are 1.5e-9 rad: 1e-4 m of w at 70 km
    assert np.abs(found.data - made.data).max() < 2e-3 and np.abs(found.uvw_m - made.uvw_m).max() < 2e-4


def test_circular_feeds_two_correlations_and_sums_as_stokes_i(tmp_path, made):
    plain = replace(made, flag=np.zeros((1, 1, 1), bool), weight=np.ones((1, 1, 1)))

    def circular(uv):
        matrices = TO_CIRCULAR @ np.moveaxis(plain.data, 1, 2).reshape(-1, 3, 2, 2) @ TO_CIRCULAR.conj().T
        uv.data_array = matrices.reshape(-1, 3, 4)[..., [0, 3, 1, 2]]
        uv.polarization_array = np.array([-1, -2, -3, -4])
        uv.telescope.feed_array = np.array([["r", "l"]] * 4)

    found = whole(changed(tmp_path, plain, circular))
    assert np.abs(found.data - plain.data).max() < 1e-12
    found = whole(changed(tmp_path, plain, lambda uv: uv.select(polarizations=[-5, -6], inplace=False)))
    assert np.array_equal(found.data[..., 1, 1], plain.data[..., 1, 1]) and found.flag[..., 0, 1].all()
    path = changed(tmp_path, plain, lambda uv: setattr(uv, "pol_convention", "sum"))
    assert np.array_equal(whole(path).data, 2 * plain.data)
    path = changed(tmp_path, plain, lambda uv: uv.select(polarizations=[-5], inplace=False))
    with pytest.raises(InputError, match="has correlations XX: this takes XX, YY"):
        UVFile(path)


def test_channels_backwards_and_blocks_smaller_than_the_file_are_the_same(tmp_path, made, monkeypatch):
    path = changed(tmp_path, made, lambda uv: uv.reorder_freqs(channel_order="-freq"))
    assert np.array_equal(whole(path).data, made.data) and np.array_equal(whole(path).freq_hz, made.freq_hz)
    monkeypatch.setattr(by_rows, "BLOCK_BYTES", 2 * 64 * 6 * 3)
    for name in (path, tmp_path / "a.uvfits"):
        write_uv(tmp_path / "a.uvfits", made, overwrite=True, precision="double")
        blocks = list(UVFile(name).blocks())
        assert [len(b.at.slots_s) for b in blocks] == [2, 2, 1]
        assert np.array_equal(np.concatenate([b.data for b in blocks]), made.data)
        write_uv(tmp_path / "c.uvh5", UVFile(name), overwrite=True)
        assert np.array_equal(np.concatenate([b.data for b in UVFile(tmp_path / "c.uvh5").blocks()]), made.data)


def test_the_observation_of_a_file_is_predicted_with_its_uvw(tmp_path, made):
    write_uv(tmp_path / "a.uvh5", made)
    lofar = instrument.load("telescopes", "lofar-hba", stations=STATIONS, beam=None)
    again = Scene(instrument=lofar, sky=SKY, observation=UVFile(tmp_path / "a.uvh5").observation()).plan().run()
    assert np.abs(again.data - made.data).max() < 1e-7


@pytest.mark.parametrize("name", ["a.uvh5", "a.uvfits"])
def test_the_beam_that_has_been_taken_out_is_kept(tmp_path, made, name):
    write_uv(tmp_path / name, replace(made, beam_state=BeamState("centre", CENTRE)))
    found = UVFile(tmp_path / name).beam_state
    assert found.removed == "centre" and np.allclose(found.towards, CENTRE, rtol=1e-15)


def test_what_is_no_such_file_or_is_of_another_kind_is_one_line(tmp_path, made):
    (tmp_path / "text.uvfits").write_text("SIMPLE file of mine")
    with pytest.raises(FileError, match="neither UVFITS nor UVH5"):
        UVFile(tmp_path / "text.uvfits")
    made.save(tmp_path / "ours.h5")
    with pytest.raises(FileError, match="without the group Header of UVH5"):
        UVFile(tmp_path / "ours.h5")
    fits.PrimaryHDU(np.zeros((2, 2))).writeto(tmp_path / "image.fits")
    write_uv(tmp_path / "a.uvh5", made)
    cut = (tmp_path / "a.uvh5").read_bytes()
    (tmp_path / "cut.uvh5").write_bytes(cut[: len(cut) // 2])
    for name in ("image.fits", "cut.uvh5"):
        with pytest.raises(FileError) as error:
            UVFile(tmp_path / name)
        assert "\n" not in str(error.value) and name in str(error.value)
    for change, said in (
        (lambda uv: setattr(uv, "vis_units", "K str"), "has 'K str': visibilities are to be in Jy"),
        (lambda uv: setattr(uv, "timesys", "IAT"), "has 'IAT': times are to be UTC"),
        (lambda uv: uv.phase_center_catalog[0].update(cat_frame="galactic"), "is in galactic"),
        (lambda uv: uv.phase_center_catalog[0].update(cat_type="ephem"), "is of kind 'ephem'"),
    ):
        path = changed(tmp_path, made, change)
        with pytest.raises(InputError, match=said):
            UVFile(path)
    path = changed(tmp_path, made, lambda uv: setattr(uv, "vis_units", "uncalib"))
    with pytest.warns(InstrumentWarning, match="not calibrated"):
        UVFile(path)


def test_what_cannot_be_written_leaves_nothing_and_nothing_is_overwritten_unasked(tmp_path, made):
    with pytest.raises(InputError, match=r"is to end in one of \.uvfits, \.uvh5"):
        write_uv(tmp_path / "a.fits", made)
    with pytest.raises(InputError, match="channels need a width"):
        write_uv(tmp_path / "a.uvh5", replace(made, width_hz=None))
    uneven = made.block(slice(None), slice(None))
    uneven = replace(uneven, at=replace(uneven.at, freq_hz=np.array([150e6, 150.1e6, 150.3e6])))
    with pytest.raises(FileError, match=r"a\.uvfits.*spaced"):
        write_uv(tmp_path / "a.uvfits", uneven)
    assert not list(tmp_path.iterdir())
    write_uv(tmp_path / "a.uvh5", uneven)
    with pytest.raises(InputError, match="exists: give overwrite=True"):
        write_uv(tmp_path / "a.uvh5", made)
    assert np.array_equal(UVFile(tmp_path / "a.uvh5").freq_hz, uneven.freq_hz)


def test_without_pyuvdata_one_line_says_how_to_get_it(tmp_path, made, monkeypatch):
    write_uv(tmp_path / "a.uvh5", made)
    monkeypatch.setitem(sys.modules, "pyuvdata", None)
    for call in (lambda: UVFile(tmp_path / "a.uvh5"), lambda: write_uv(tmp_path / "b.uvh5", made)):
        with pytest.raises(InputError) as error:
            call()
        assert str(error.value) == uv_data.MISSING and "pip install 'instrument[uv]'" in uv_data.MISSING


def test_pyuvdata_lives_beside_arcae_and_casacore(tmp_path, made):
    """In both orders, in processes of their own: a set is read, and a file written and read, in one process."""
    pytest.importorskip("arcae", reason="the extra 'ms'")
    write_uv(tmp_path / "a.uvh5", made)
    folder = Path(__file__).parent
    write = (
        f"import sys; sys.path.insert(0, {str(folder)!r}); import numpy as np, small_set, instrument\n"
        f"names = {STATIONS!r}; layout = instrument.load('telescopes', 'lofar-hba', stations=names).layout()\n"
        "one, two = np.triu_indices(4, 1); n = len(one)\n"
        "rows = (np.full(n, 4861566000.0), one, two, np.zeros((n, 3)), np.zeros(n, int), np.zeros(n, int))\n"
        f"def ms():\n    path = {str(tmp_path)!r} + '/' + sys.argv[1]\n"
        "    small_set.write(path, layout, rows, np.array([150e6]), np.ones((n, 1, 4), complex))\n"
        "    print(next(instrument.MeasurementSet(path).blocks()).data.sum())\n"
        f"def uv():\n    print(next(instrument.UVFile({str(tmp_path / 'a.uvh5')!r}).blocks()).data.shape)\n"
        "def casacore():\n    try:\n        import casacore.tables\n    except ImportError: pass\n"
    )
    for order in ("ms(); uv(); casacore(); ms2 = 1", "uv(); casacore(); ms()", "casacore(); uv(); ms(); uv()"):
        name = f"{abs(hash(order))}.MS"
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", write + order, name], capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0, done.stderr[-2000:]
        assert "(24+0j)" in done.stdout and "(5, 3, 6, 2, 2)" in done.stdout
