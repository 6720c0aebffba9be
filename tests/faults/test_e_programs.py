"""FITS cubes with the features that the field's programs give them: read right, value by value, or refused by name."""

import warnings

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits

from instrument import Psf, read_cube
from instrument.errors import FileError, InstrumentWarning, UnusedWarning

F, N = 5, 12
TRUTH = np.random.default_rng(8).normal(size=(F, 4, N, N)).astype(np.float32)  # x to the west, y to the north
MHZ = 120 + 0.1953125 * np.arange(F)
SKY = (
    {"CTYPE": "RA---SIN", "CRVAL": 123.4, "CDELT": -0.01, "CRPIX": N // 2 + 1.0, "CUNIT": "deg"},
    {"CTYPE": "DEC--SIN", "CRVAL": 48.2, "CDELT": 0.01, "CRPIX": N // 2 + 1.0, "CUNIT": "deg"},
)
FREQ = {"CTYPE": "FREQ", "CRVAL": MHZ[0] * 1e6, "CDELT": 195312.5, "CRPIX": 1.0, "CUNIT": "Hz"}
STOKES = {"CTYPE": "STOKES", "CRVAL": 1.0, "CDELT": 1.0, "CRPIX": 1.0, "CUNIT": ""}
# the beam is 3' x 2.4': K per Jy/beam at 120 MHz is 1.222e6 / (GHz² arcsec²)
KELVIN = 1.222e6 / 0.12**2 / (180 * 144)


def write(path, array, axes, tables=(), history=(), **cards):
    hdu = fits.PrimaryHDU(array)
    for k, axis in enumerate(axes, 1):
        hdu.header.update({f"{key}{k}": value for key, value in axis.items() if value != ""})
    hdu.header.update({"BUNIT": "Jy/beam", **cards})
    for line in history:
        hdu.header.add_history(line)
    fits.HDUList([hdu, *tables]).writeto(path)
    return path


def read(*paths, **given):
    """Without a word."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return read_cube(*paths, **given)


def right(cube, stokes="IQUV", atol=0.0):
    index = ["IQUV".index(s) for s in stokes]
    assert cube.data[:, index] == pytest.approx(TRUTH[:, index], abs=atol)
    assert cube.freq_hz / 1e6 == pytest.approx(MHZ, rel=1e-12)
    assert np.rad2deg(cube.centre) == pytest.approx([123.4, 48.2], abs=1e-9)
    assert np.rad2deg(cube.pixel_rad) == pytest.approx(0.01)
    if cube.psf is not None:
        assert (cube.to_kelvin().data / cube.data)[0, index[0], 3, 3] == pytest.approx(KELVIN, rel=1e-4)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "cube.fits"


def test_wsclean_one_file_a_channel_and_stokes_parameter_beside_their_means(tmp_path):
    beam = {"BMAJ": 0.05, "BMIN": 0.04, "BPA": 0.0, "SPECSYS": "TOPOCENT", "BTYPE": "Intensity"}
    for k, s in enumerate("QU", 1):
        for f in range(F):
            axes = (*SKY, FREQ | {"CRVAL": MHZ[f] * 1e6}, STOKES | {"CRVAL": k + 1.0})
            write(tmp_path / f"w-{f:04d}-{s}-image.fits", TRUTH[f, k][None, None], axes, **beam)
        axes = (*SKY, FREQ | {"CRVAL": MHZ.mean() * 1e6, "CDELT": F * 195312.5}, STOKES | {"CRVAL": k + 1.0})
        write(tmp_path / f"w-MFS-{s}-image.fits", TRUTH[:, k].mean(axis=0)[None, None], axes, **beam)
    with pytest.warns(UnusedWarning, match="w-MFS-Q-image.fits: not used"):
        found = read_cube(*sorted(tmp_path.glob("w-*.fits")))
    right(found, "QU")
    assert np.isnan(found.data[:, [0, 3]]).all()


@pytest.mark.parametrize("stokes_first", [True, False])
def test_casa_with_a_table_of_beams_and_degenerate_axes_in_either_order(path, stokes_first):
    widths = (("BMAJ", "arcsec", 180.0), ("BMIN", "arcsec", 144.0), ("BPA", "deg", 0.0))
    columns = [fits.Column(n, "E", w, array=[v] * F) for n, w, v in widths]
    columns += [fits.Column(n, "J", array=v) for n, v in (("CHAN", np.arange(F)), ("POL", np.zeros(F, int)))]
    table = fits.BinTableHDU.from_columns(columns, name="BEAMS")
    table.header.update({"NCHAN": F, "NPOL": 1})
    axes = (*SKY, STOKES, FREQ) if stokes_first else (*SKY, FREQ, STOKES)
    data = TRUTH[:, 0][:, None] if stokes_first else TRUTH[:, 0][None]
    cards = {"CASAMBM": True, "SPECSYS": "LSRK", "PC01_01": 1.0, "PC02_02": 1.0, "BTYPE": "Intensity", "VELREF": 257}
    write(path, data, axes, [table], **cards)
    with pytest.warns(UnusedWarning, match=r"SPECSYS = 'LSRK' .frequencies are taken as they stand"):
        right(read_cube(path), "I")


def test_casa_with_a_radio_velocity_is_refused_by_its_name(path):
    write(path, TRUTH[:, 0][None], (*SKY, FREQ | {"CTYPE": "VRAD", "CUNIT": "m/s"}, STOKES))
    with pytest.raises(
        FileError, match="axis 3 is VRAD, a radio velocity, not FREQ: regrid to frequency, or give freq"
    ):
        read_cube(path)
    right(read(path, frequencies=MHZ * u.MHz), "I")


def test_miriad_with_epoch_without_units_and_stokes_last(path):
    """EPOCH without EQUINOX, no CUNIT, CROTA of 0, BUNIT in capitals."""
    axes = [axis | {"CUNIT": "", "CROTA": 0.0} for axis in (*SKY, FREQ, STOKES)]
    write(path, np.moveaxis(TRUTH, 1, 0), axes, EPOCH=2000.0, BUNIT="JY/BEAM", BMAJ=0.05, BMIN=0.04, BPA=0.0)
    right_fk5 = read(path)
    assert np.rad2deg(right_fk5.centre) == pytest.approx([123.4, 48.2], abs=1e-5)  # FK5 of 2000 is ICRS to 0.02"
    assert np.array_equal(right_fk5.data, TRUTH)


def test_aips_with_whole_numbers_a_history_and_freq_lsr_turned_by_180_deg(path):
    scale, zero = 1e-4, 0.5
    whole = np.rint((TRUTH[:, 0][:, ::-1, ::-1] - zero) / scale).astype(np.int32)
    whole[2, 3, 3] = -(2**31)
    axes = [dict(axis) for axis in (*SKY, FREQ, STOKES)]
    for axis in axes[:2]:  # turned about the reference pixel, which is then N // 2 from the other side
        axis["CRPIX"] = N - N // 2 + 0.0
    axes[1]["CROTA"] = 180.0
    axes[2] |= {"CTYPE": "FREQ-LSR", "CUNIT": ""}
    history = "AIPS   CLEAN BMAJ=  5.0000E-02 BMIN=  4.0000E-02 BPA=   0.00"
    cards = {"BSCALE": scale, "BZERO": zero, "BLANK": -(2**31), "BUNIT": "JY/BEAM", "EPOCH": 0.0}
    raw = fits.PrimaryHDU(whole[None])
    for k, axis in enumerate(axes, 1):
        raw.header.update({f"{key}{k}": value for key, value in axis.items() if value != ""})
    raw.header.update(cards)
    raw.header.add_history(history)
    # by hand: astropy would scale the numbers
    path.write_bytes(raw.header.tostring().encode("ascii") + _padded(whole[None].astype(">i4").tobytes()))
    with pytest.warns(InstrumentWarning, match="AIPS CLEAN BMAJ|SPECSYS = 'LSR'"):
        found = read_cube(path)
    assert np.isnan(found.data[2, 0, N - 1 - 3, N - 1 - 3])
    data = np.where(np.isnan(found.data), TRUTH, found.data)
    assert data[:, 0] == pytest.approx(TRUTH[:, 0], abs=scale)
    assert found.freq_hz / 1e6 == pytest.approx(MHZ, rel=1e-12)
    assert np.rad2deg(found.centre) == pytest.approx([123.4, 48.2], abs=1e-9)
    assert (found.to_kelvin().data / found.data)[0, 0, 5, 5] == pytest.approx(KELVIN, rel=1e-4)


def _padded(raw):
    return raw + bytes(-len(raw) % 2880)


def test_possum_and_cirada_q_and_u_with_empty_channels_and_beams_in_a_log_elsewhere(tmp_path):
    """ASKAP: degenerate STOKES before FREQ, one BMAJ for all, flagged channels of NaN or 0."""
    data = TRUTH.copy()
    data[1], data[3] = np.nan, 0
    cards = {"BMAJ": 0.05, "BMIN": 0.04, "BPA": 0.0, "CASAMBM": True, "SPECSYS": "TOPOCENT", "RADESYS": "FK5"}
    files = [
        write(tmp_path / f"{s}.fits", data[:, k][:, None], (*SKY, STOKES | {"CRVAL": k + 1.0}, FREQ), EQUINOX=2000.0,
              **cards)
        for k, s in ((1, "q"), (2, "u"))
    ]  # fmt: skip
    with pytest.warns(UnusedWarning) as said:
        found = read_cube(*files)
    text = "\n".join(str(w.message) for w in said)
    assert "CASAMBM = T (a beam a channel) (there is no table BEAMS: BMAJ is taken for every channel)" in text
    assert "q.fits and 1 more: not used: channel 3 of Q, U (one value" in text
    assert np.isnan(found.data[[1, 3]]).all()
    assert np.array_equal(found.data[[0, 2, 4], 1:3], TRUTH[[0, 2, 4], 1:3])
    assert (found.to_kelvin().data / found.data)[0, 1, 3, 3] == pytest.approx(KELVIN, rel=1e-4)


def test_uneven_channels_in_many_files_need_no_table(tmp_path):
    mhz = np.array([120.0, 120.2, 131.7, 150.0, 149.0])
    for f in range(F):
        write(tmp_path / f"{f}.fits", TRUTH[f][:, None], (*SKY, FREQ | {"CRVAL": mhz[f] * 1e6}, STOKES), BUNIT="K")
    found = read(*sorted(tmp_path.glob("*.fits")))
    assert found.freq_hz / 1e6 == pytest.approx(mhz, rel=1e-12)
    assert np.array_equal(found.data, TRUTH)


def test_three_axes_and_no_names_of_stokes_or_unit_are_asked_for_one_by_one(path):
    write(path, TRUTH[:, 0], (*SKY, FREQ), BUNIT="")
    for given, said in (({}, "no axis is STOKES"), ({"stokes": "I"}, "BUNIT is missing")):
        with pytest.raises(FileError, match=said):
            read_cube(path, **given)
    found = read(path, stokes="I", unit="Jy/beam", psf=Psf.gaussian(3 * u.arcmin, 2.4 * u.arcmin))
    right(found, "I")
