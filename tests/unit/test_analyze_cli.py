"""`instrument analyze`: cubes from elsewhere in, a folder out; what cannot be done is one line and leaves nothing."""

import json

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable

from instrument import InputError, StokesCube
from instrument.analyze.cube_checks import check_cells, check_faraday
from instrument.analyze.faraday.synthesis import Synthesis, rm_synthesis
from instrument.analyze.power.transform import Transform, cells_of
from instrument.cli import main
from instrument.image.psf import Psf
from instrument.pipeline.stages.cube import CubeAnalysis

FREQ = (140e6 + 1e6 * np.arange(24)) * u.Hz


def screens(unit="K", psf=None):
    """Q + iU of one depth, 2 rad/m², a little of it in I, noise; V is 0."""
    rng = np.random.default_rng(0)
    lambda2 = (299792458.0 / FREQ.value) ** 2
    data = 1e-3 * rng.normal(size=(24, 4, 40, 42))
    p = np.exp(2j * 2 * lambda2)[:, None, None] * (1 + 0.3 * rng.normal(size=(40, 42)))
    data[:, 1] += p.real
    data[:, 2] += p.imag
    data[:, 0] += 3e-3 * p.real
    data[:, 3] = 0
    return StokesCube(data.astype(np.float32), FREQ, 3 * u.arcmin, unit, psf=psf)


@pytest.fixture
def cube_file(tmp_path):
    screens().write(tmp_path / "cube.fits")
    return tmp_path / "cube.fits"


def run(*words):
    return main(["analyze", *map(str, words)])


def test_a_cube_gives_everything_it_allows(cube_file, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(cube_file, "--out", out, "--depths", "-20,20,0.5", "--remove", "pca", "--remover", "components=2",
               "--wedge", "2 deg", "--cubes") == 0  # fmt: skip
    said = capsys.readouterr().out
    assert "Stokes V: no data, or zero everywhere" in said and "EoR window" in said and "after removal" in said
    names = {path.name for path in out.iterdir()}
    assert {"report.html", "run.json", "window.ecsv", "window_after_removal.ecsv", "faraday_peaks.fits"} <= names
    assert {"spectrum_cylindrical_P.ecsv", "spectrum_spherical_I.ecsv", "spectrum_2d_I_after_removal.ecsv"} <= names
    assert {"faraday.fits", "residual.fits", "cylindrical_I.png", "spherical.png", "faraday_slices.png"} <= names
    record = json.loads((out / "run.json").read_text())
    assert record["checks"]["Faraday depth"]["passed"] and record["checks"]["power spectrum of P"]["passed"]
    assert record["faraday"]["fwhm_nominal"] == pytest.approx(
        2 * np.sqrt(3) / (299792458.0**2 * (140e6**-2 - 163e6**-2)), rel=1e-6
    )
    with fits.open(out / "faraday_peaks.fits") as hdus:
        depth = hdus["DEPTH"].data
    assert np.nanmedian(depth) == pytest.approx(2, abs=0.02)
    assert record["command"].startswith("instrument ")


def test_only_the_products_asked_for_are_made(cube_file, tmp_path):
    out = tmp_path / "out"
    assert run(cube_file, "--out", out, "--products", "spherical", "--taper", "none", "--taper-space", "none") == 0
    names = {path.name for path in out.iterdir()}
    assert "spectrum_spherical_I.ecsv" in names
    assert not [name for name in names if name.startswith(("spectrum_2d", "window", "faraday", "cylindrical"))]
    assert QTable.read(out / "spectrum_spherical_I.ecsv").meta["taper"] is None


def test_a_cube_in_jy_needs_its_beam_for_a_window(tmp_path, capsys):
    screens("Jy/beam").write(tmp_path / "jy.fits")
    out = tmp_path / "out"
    assert run(tmp_path / "jy.fits", "--out", out, "--products", "spherical,window") == 2
    assert "its beam is not known: give the beam (--beam), or the cube in K" in capsys.readouterr().err
    assert not out.exists()
    assert run(tmp_path / "jy.fits", "--out", out, "--products", "spherical,window", "--beam", "6 arcmin") == 0
    assert QTable.read(out / "spectrum_spherical_I.ecsv")["power"].unit == u.K**2 * u.Mpc**3
    screens("Jy/beam", Psf.gaussian(6 * u.arcmin).of(24)).write(tmp_path / "beam.fits")
    assert run(tmp_path / "beam.fits", "--out", tmp_path / "b", "--products", "spherical", "--beam", "5 arcmin") == 2
    assert "the files name their beams" in capsys.readouterr().err


def test_without_a_beam_the_window_is_left_out_and_said(tmp_path, capsys):
    screens("Jy/beam").write(tmp_path / "jy.fits")
    assert run(tmp_path / "jy.fits", "--out", tmp_path / "out", "--depths", "-7,7,0.5") == 0
    assert "window: the cube is in Jy/beam and its beam is not known" in capsys.readouterr().out
    assert QTable.read(tmp_path / "out" / "spectrum_spherical_I.ecsv")["power"].unit == (u.Jy / u.beam) ** 2 * u.Mpc**3


def test_one_channel_has_a_2d_spectrum_and_nothing_more(tmp_path, capsys):
    whole = screens()
    one = StokesCube(whole.data[:1], FREQ[:1], 3 * u.arcmin, "K")
    one.write(tmp_path / "one.fits")
    assert run(tmp_path / "one.fits", "--out", tmp_path / "out") == 0
    said = capsys.readouterr().out
    for name in ("faraday", "cylindrical", "spherical", "window"):
        assert f"{name}: one channel" in said
    assert (tmp_path / "out" / "spectrum_2d_I.ecsv").is_file()
    assert run(tmp_path / "one.fits", "--out", tmp_path / "b", "--products", "cylindrical") == 2
    assert "products = 'cylindrical': one channel" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--products", "sphrical"], "products.0 = 'sphrical'"),
        (["--depths", "-5"], "depths"),
        (["--depths", "5,-5,1"], "give the first, the last and a step above 0"),
        (["--depths", "0,1e9,0.1"], "at most 20001"),
        (["--depths", "a,b,c"], "--depths a,b,c: numbers with commas between"),
        (
            ["--uv-range", "800,30", "--products", "spherical"],
            "uv_range = (800.0, 30.0) must be two increasing finite numbers",
        ),
        (["--taper", "hamming"], "taper = 'hamming'"),
        (["--signal", "EOS"], "no 21-cm model is called 'EOS'"),
        (["--remove", "gmka"], "did you mean 'gmca'"),
        (["--remove", "gmca", "--remover", "component=4"], "component"),
        (["--remover", "components=4"], "but none is named"),
        (["--wedge", "2"], "wedge"),
        (["--infill", "3 MHz"], "infill needs a unit convertible to s"),
        (["--noise", "nowhere.fits"], "nowhere.fits"),
    ],
)
def test_wrong_input_is_one_line_that_names_it_and_leaves_nothing(cube_file, tmp_path, capsys, words, said):
    out = tmp_path / "deep" / "out"
    assert run(cube_file, "--out", out, *words) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert not out.parent.exists()


def test_a_folder_with_something_in_it_is_not_written_to(cube_file, tmp_path, capsys):
    assert run(cube_file, "--out", tmp_path) == 2
    assert "it exists and is not an empty folder" in capsys.readouterr().err


def test_a_removal_that_makes_it_worse_ends_with_status_3(tmp_path, capsys):
    """Noise alone: whatever is taken away was not foreground."""
    data = np.zeros((64, 4, 48, 48), np.float32)
    data[:, 0] = np.random.default_rng(0).normal(size=(64, 48, 48))
    StokesCube(data, (134e6 + 0.25e6 * np.arange(64)) * u.Hz, 3 * u.arcmin, "K").write(tmp_path / "noise.fits")
    status = run(
        tmp_path / "noise.fits", "--out", tmp_path / "out", "--products", "spherical", "--remove", "polynomial"
    )
    assert status == 3
    assert "worse than not cleaning: do not use" in capsys.readouterr().out


# The checks -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("settings", [{}, {"taper": None}, {"taper_space": "hann", "uv_range": (20, 200)}])
@pytest.mark.parametrize("stokes", ["I", "P"])
def test_a_check_of_cells_finds_a_cell_that_is_wrong(stokes, settings):
    cube = screens()
    cells = cells_of(cube, Transform(stokes, **settings))
    assert check_cells(cube, cells).passed
    cells.power[...] *= 1 + 1e-8
    assert not check_cells(cube, cells).passed


def test_a_check_of_cells_takes_holes_and_unsorted_channels():
    whole = screens()
    data = whole.data.copy()
    data[3, 0, 5:8, 7] = np.nan
    turn = np.random.default_rng(0).permutation(24)
    cube = StokesCube(data[turn], FREQ[turn], 3 * u.arcmin, "K")
    with pytest.warns(UserWarning, match="hold NaN"):
        cells = cells_of(cube, Transform())
    assert check_cells(cube, cells).passed


def test_a_check_of_faraday_spectra_finds_one_that_is_wrong():
    cube = screens()
    data = cube.data.copy()
    data[4, 1, :20] = np.nan
    cube = StokesCube(data, FREQ, 3 * u.arcmin, "K")
    found = rm_synthesis(cube, Synthesis(np.linspace(-20, 20, 41)))
    assert check_faraday(cube, found).passed
    found.data[7] += 1e-4 * np.abs(found.data).max()
    assert not check_faraday(cube, found).passed


def test_settings_come_back_from_json():
    settings = CubeAnalysis(products=("faraday",), wedge=2 * u.deg, remove="pca", remover={"components": 3})
    assert CubeAnalysis.from_json(settings.to_json()) == settings
    with pytest.raises(InputError, match="remove = 'pca': one channel has no foreground"):
        settings.refusals(StokesCube(screens().data[:1], FREQ[:1], 3 * u.arcmin, "K"))
