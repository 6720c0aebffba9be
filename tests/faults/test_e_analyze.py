"""`instrument analyze`: what its refusals advise can be given; what was not used or not checked is said."""

import json

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable

from instrument import Analyzer, CubeAnalysis, Psf, StokesCube
from instrument.cli import main
from instrument.errors import InstrumentWarning

FREQ = 140e6 + 1e6 * np.arange(24)


def cube(freq=FREQ, depth=2.0, noise=0.03, unit="K", pixels=24, psf=None, seed=0):
    rng = np.random.default_rng(seed)
    data = noise * rng.normal(size=(len(freq), 4, pixels, pixels))
    p = np.exp(2j * depth * (299792458.0 / freq) ** 2)[:, None, None]
    data[:, 1] += p.real
    data[:, 2] += p.imag
    return StokesCube(data.astype(np.float32), freq * u.Hz, 3 * u.arcmin, unit, psf=psf)


@pytest.fixture
def run(tmp_path, capsys, monkeypatch):
    """Runs `analyze` on a cube, without figures; run.json, what was said, the folder."""
    monkeypatch.setattr("instrument.pipeline.stages.cube_page.cube_sections", lambda result, folder: [])

    def call(given, *words, status=0, more=()):
        path = tmp_path / "cube.fits"
        if not isinstance(given, str):
            path.unlink(missing_ok=True)
            given.write(path)
        out = tmp_path / f"out{len(list(tmp_path.iterdir()))}"
        found = main(["analyze", str(path), *map(str, more), "--out", str(out), *map(str, words)])
        said = capsys.readouterr()
        assert found == status, said.err
        record = json.loads((out / "run.json").read_text()) if found in (0, 3) else None
        return record, said.out, said.err, out

    return call


def column(path, values):
    path.write_text("# one a line\n" + "\n".join(f"{v!r}" for v in values) + "\n")
    return path


def test_e13_frequencies_come_from_a_file(run, tmp_path):
    cube().write(tmp_path / "cube.fits")
    with fits.open(tmp_path / "cube.fits", mode="update") as hdus:
        hdus[0].header["CTYPE4"], hdus[0].header["CUNIT4"] = "VRAD", "m/s"
    *_, error, _ = run("there", "--products", "faraday", status=2)
    assert "--frequencies FILE" in error and error.count("\n") == 1
    listed = column(tmp_path / "freq.txt", [float(f) for f in FREQ])
    *_, out = run("there", "--products", "faraday", "--frequencies", listed)
    with fits.open(out / "faraday_peaks.fits") as hdus:
        assert np.nanmedian(hdus["DEPTH"].data) == pytest.approx(2, abs=0.01)
    short = column(tmp_path / "short.txt", [1.4e8, 1.5e8])
    assert "24" in run("there", "--frequencies", short, status=2)[2]


def test_e13_channels_are_flagged_and_a_band_is_taken(run):
    given = cube()
    data = given.data.copy()
    data[[3, 7, 8, 9], 1:3] = 50.0  # interference
    record, said, error, out = run(given.with_data(data), "--products", "faraday", "--flag-channels", "3,7-9",
                                   "--band", "141 MHz,160 MHz")  # fmt: skip
    assert "20 channels 141 to 160 MHz" in said
    assert "outside of --band 141 MHz,160 MHz" in error and "channel 0" in record["unused"]["analyze"]
    with fits.open(out / "faraday_peaks.fits") as hdus:
        assert np.nanmedian(hdus["PEAK"].data) == pytest.approx(1, abs=0.01)
        assert np.nanmedian(hdus["NOISE"].data) == pytest.approx(0.03 / 4, rel=0.05)  # 16 channels
    for words in (["--flag-channels", "24"], ["--flag-channels", "a"], ["--band", "1 MHz,2 MHz"], ["--band", "140"]):
        assert words[0].strip("-").split("-")[0] in run(given, *words, status=2)[2]


def test_e13_weights_of_the_channels_come_from_a_file(run, tmp_path):
    given = cube()
    data = given.data.copy()
    data[5] *= 1000.0
    weights = np.ones(24)
    weights[5] = 0.0
    listed = column(tmp_path / "weights.txt", weights.tolist())
    *_, out = run(given.with_data(data), "--products", "faraday", "--weights", listed)
    with fits.open(out / "faraday_peaks.fits") as hdus:
        assert np.nanmedian(hdus["PEAK"].data) == pytest.approx(1, abs=0.01)
    for wrong in ([1.0] * 23, [-1.0] * 24):
        assert "--weights" in run(given, "--weights", column(tmp_path / "w.txt", wrong), status=2)[2]


def test_e13_images_of_a_psf_make_kelvin_of_jy(run, tmp_path):
    given = cube(unit="Jy/beam")
    y, x = np.indices((24, 24)) - 12
    plane = np.exp(-4 * np.log(2) * (x**2 + y**2) / 4.0**2)  # 4 pixels of 3 arcmin
    images = np.zeros((24, 4, 24, 24))
    images[:, 0] = plane
    StokesCube(images, FREQ * u.Hz, 3 * u.arcmin, "Jy/beam").write(tmp_path / "psf.fits")
    _, _, _, out = run(given, "--products", "spherical", "--psf", tmp_path / "psf.fits")
    got = QTable.read(out / "spectrum_spherical_I.ecsv")["power"]
    beam = StokesCube(given.data, FREQ * u.Hz, 3 * u.arcmin, "Jy/beam", psf=Psf.gaussian(12 * u.arcmin))
    wanted = Analyzer(beam.to_kelvin()).spherical(taper_space="hann", bins=12)
    assert got.unit == u.K**2 * u.Mpc**3 and np.allclose(got.value, wanted.power, rtol=1e-3, equal_nan=True)


def test_e13_rm_clean_on_the_command_line(run):
    """Two screens 5 rad/m² apart: in the dirty spectrum the fainter one pulls the depth, in the clean one less."""
    given = cube()
    given = given.with_data(given.data + 0.6 * cube(depth=7.0, noise=0.0).data)
    record, said, _, out = run(given, "--products", "faraday", "--clean", "--cubes", "--depths", "-40,40")
    assert "RM-CLEAN" in said and record["checks"]["RM-CLEAN"]["passed"]
    assert (out / "faraday_cleaned.fits").is_file()
    dirty = run(given, "--products", "faraday", "--depths", "-40,40")[3]
    off = []
    for folder in (dirty, out):
        with fits.open(folder / "faraday_peaks.fits") as hdus:
            off.append(abs(np.nanmedian(hdus["DEPTH"].data) - 2))
    assert off[1] < off[0] and off[1] < 0.1


def test_e2_depths_by_default_are_those_of_the_band(run):
    """800 to 1088 MHz: sources at 20 rad/m² found, in steps of FWHM / 8, out to the largest depth."""
    freq = 800e6 + 9e6 * np.arange(33)
    record, _, _, out = run(cube(freq, 20.0), "--products", "faraday")
    found = record["faraday"]
    assert found["significant"] == 24 * 24 and found["step"] == pytest.approx(found["fwhm"] / 8)
    assert found["depths"][1] >= found["phi_max"] and found["noise"] == pytest.approx(0.03 / np.sqrt(33), rel=0.05)
    with fits.open(out / "faraday_peaks.fits") as hdus:
        assert np.nanmedian(hdus["DEPTH"].data) == pytest.approx(20.0, abs=0.1)


def test_e3_depths_in_steps_wider_than_a_quarter_of_the_rmsf_are_refused(run):
    freq = 800e6 + 9e6 * np.arange(33)
    *_, error, out = run(cube(freq, 20.0), "--depths=-600,600,60", status=2)
    assert "in steps of 60 rad/m2 peaks are missed" in error and "give a step of 7.27" in error and not out.exists()
    record, *_ = run(cube(freq, 20.0), "--products", "faraday", "--depths=-600,600")  # the step is the band's
    assert record["faraday"]["step"] == pytest.approx(record["faraday"]["fwhm"] / 8, rel=0.01)


def test_e4_aliases_are_listed(run):
    freq = np.concatenate([140e6 + 0.2e6 * np.arange(5), 160e6 + 0.2e6 * np.arange(5)])
    record, said, *_ = run(cube(freq, 7.0, 0.1), "--products", "faraday", "--depths", "-60,60")
    assert "pixels are ambiguous" in said and "aliases       so many rad/m2 apart" in said
    assert record["faraday"]["ambiguous"] > 570 and record["faraday"]["significant"] == 0
    assert record["faraday"]["aliases"][0][0] == pytest.approx(2.94, abs=0.01)


def test_f14_a_score_that_is_not_known_is_not_a_check_that_held(run):
    """Six channels: no delay beyond 0.3 /Mpc is left to tell the noise, so there is no score."""
    record, said, _, out = run(cube(FREQ[:6]), "--products", "spherical", "--remove", "pca", "--remover",
                               "components=1")  # fmt: skip
    assert "score       not known" in said and "removal: not made" in said
    assert record["checks"]["removal"]["passed"] is None
    page = (out / "report.html").read_text()
    assert "not checked: removal" in page and "every check held" not in page


def test_f14_a_removal_with_as_many_components_as_channels_falls_short(run):
    record, *_ = run(
        cube(FREQ[:12]), "--products", "spherical", "--remove", "pca", "--remover", "components=12", status=3
    )
    assert record["checks"]["removal"]["passed"] is False


def test_f14_a_check_that_cannot_be_made_is_said():
    given = cube()
    data = given.data.copy()
    data[11] = np.nan
    result = CubeAnalysis(products=["spherical"], infill=300 * u.ns, bins=4).run(given.with_data(data))
    assert result.passed and result.verdicts["power spectrum of I"] is None
    assert "check         power spectrum of I: not made" in result.lines()


def test_g9_a_redshift_of_another_band_is_warned_of():
    with pytest.warns(
        InstrumentWarning, match=r"redshift = 3 has its 21-cm line at 355.1 MHz, the cube is at 140 to 163"
    ):
        Analyzer(cube()).spherical(redshift=3)
    with pytest.warns(InstrumentWarning, match=r"redshift = 3 has its 21-cm line .* the cube is at 140 MHz, z = 9.15"):
        Analyzer(cube()).spectrum_2d(redshift=3)


def test_options_that_nothing_uses_are_named(run):
    record, _, error, _ = run(cube(), "--products", "spectrum-2d", "--depths", "-5,5,0.5", "--wedge", "2 deg")
    assert "not used: depths, wedge" in error and record["unused"] == {"analyze": ["depths", "wedge"]}
    record, *_ = run(cube(), "--products", "faraday")
    assert record["unused"] == {}


def test_e13_a_common_beam_is_that_of_the_widest_channel(run):
    """Beams of 9 to 12 arcmin: 1 Jy in 1 Jy/beam stays that, and the spectra are in K of the widest beam."""
    width = np.linspace(12, 9, 24)
    given = cube(unit="Jy/beam", psf=Psf.gaussian(width * u.arcmin))
    for words, wide in ((["--common-beam"], 12.0), (["--common-beam", "15 arcmin"], 15.0)):
        *_, out = run(given, "--products", "spherical", *words)
        got = QTable.read(out / "spectrum_spherical_V.ecsv")["power"]
        wanted = Analyzer(given.at_common_beam(wide * u.arcmin).to_kelvin()).spherical("V", taper_space="hann", bins=12)
        assert np.allclose(got.value, wanted.power, rtol=1e-3, equal_nan=True)
    assert "--common-beam" in run(given, "--common-beam", "3 arcmin", status=2)[2]


def test_b7_shares_of_a_window_are_shares():
    from instrument import InputError, Signal21cm

    window = Analyzer(cube()).eor_window(Signal21cm.table())
    for wrong in (float("nan"), -0.1, 1.5, "2", True):
        with pytest.raises(InputError, match="share = "):
            window.reach(share=wrong)
        with pytest.raises(InputError, match="removed = "):
            window.area(removed=wrong)
