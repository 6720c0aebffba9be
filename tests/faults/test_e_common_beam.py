"""Line E14: images of unequal resolution are said, and made equal on request."""

import numpy as np
import pytest
from astropy import units as u

from instrument import Analyzer, CubeAnalysis, InputError, Psf, StokesCube
from instrument.cli import main
from instrument.errors import InstrumentWarning
from instrument.image.common_beam import beam_ratio, common_beam, say_unequal_beams, shapes

MHZ = [134, 150, 166] * u.MHz
run = CubeAnalysis.run
N, PIXEL = 64, 0.5


def ellipse(major, minor, angle, y0=0.0, x0=0.0):
    """A Gaussian of widths in arcmin and position angle in deg, peak 1, at an offset in pixels (N, N)."""
    (c,) = np.linalg.inv(shapes(*(np.array([float(v)]) for v in (major, minor, np.deg2rad(angle)))))
    y, x = (np.mgrid[:N, :N] - N // 2) * PIXEL
    north, east = y - y0 * PIXEL, -(x - x0 * PIXEL)
    return np.exp(-0.5 * (c[0, 0] * north**2 + 2 * c[0, 1] * north * east + c[1, 1] * east**2))


BEAMS = ((4.0, 3.0, 20.0), (3.5, 2.8, 30.0), (3.0, 2.5, 10.0))
PSF = Psf.gaussian(*([b[k] for b in BEAMS] * unit for k, unit in enumerate((u.arcmin, u.arcmin, u.deg))))


def cube(unit="Jy/beam", psf=PSF):
    data = np.zeros((3, 4, N, N))
    data[:] = np.array([ellipse(*b) for b in BEAMS])[:, None]
    if unit == "K":
        data /= np.array([b[0] * b[1] for b in BEAMS])[:, None, None, None]
    return StokesCube(data, MHZ, PIXEL * u.arcmin, unit, psf=psf)


def test_e14_unequal_beams_are_said_with_their_ratio():
    assert beam_ratio(PSF) == pytest.approx(np.sqrt(12 / 7.5))
    with pytest.warns(InstrumentWarning, match="beams of the channels differ by a factor of 1.26 in width"):
        say_unequal_beams(cube().psf)
    with pytest.warns(InstrumentWarning, match="differ by a factor of 1.26 in width"):
        Analyzer(cube()).rm_synthesis([0.0, 1.0])


def test_e14_a_point_of_1_jy_stays_1_jy_and_has_the_common_beam_in_every_channel():
    for size in (None, "5 arcmin", "6 arcmin, 4 arcmin, 50 deg"):
        found = cube().at_common_beam(size)
        major, minor, angle = (float(x[0]) for x in (found.psf.major_rad, found.psf.minor_rad, found.psf.angle_rad))
        want = ellipse(np.rad2deg(major) * 60, np.rad2deg(minor) * 60, np.rad2deg(angle))
        assert np.abs(found.data - want).max() < 2e-5  # of the far wings, behind the rim
        assert beam_ratio(found.psf) == pytest.approx(1, rel=1e-12)
    assert np.rad2deg([major, minor]) * 60 == pytest.approx([6, 4])
    assert np.rad2deg(angle) == pytest.approx(50)


def test_e14_kelvin_keep_their_integral():
    given = cube("K")
    found = given.at_common_beam("5 arcmin")
    assert found.data.sum(axis=(2, 3)) == pytest.approx(given.data.sum(axis=(2, 3)), rel=1e-4)
    assert found.data[0] == pytest.approx(found.data[2], rel=2e-3, abs=1e-6)


def test_e14_the_beam_that_holds_all_is_taken_or_a_circle_around_them():
    assert common_beam(Psf.gaussian([4, 3] * u.arcmin))[0, 0] == pytest.approx(
        np.deg2rad(4 / 60) ** 2 / (8 * np.log(2))
    )
    crossed = Psf.gaussian([4, 4] * u.arcmin, [3, 3] * u.arcmin, [0, 90] * u.deg)
    assert common_beam(crossed) == pytest.approx(np.eye(2) * np.deg2rad(4 / 60) ** 2 / (8 * np.log(2)))


def test_e14_holes_stay_holes_and_what_is_uniform_stays_so():
    data = np.ones((3, 4, N, N)) * np.array([1.0, 2.0, 3.0])[:, None, None, None]
    data[:, :, 20:24, 20:30] = np.nan
    data[1] = np.nan
    psf = Psf.gaussian([4, np.nan, 3] * u.arcmin)
    found = StokesCube(data, MHZ, PIXEL * u.arcmin, "K", psf=psf).at_common_beam("6 arcmin").data
    assert np.array_equal(np.isnan(found), np.isnan(data))
    assert found[[0, 2]] == pytest.approx(data[[0, 2]], rel=1e-9, nan_ok=True)


@pytest.mark.parametrize(
    ("size", "said"),
    [
        ("3 arcmin", "smaller than the beam 4' x 3' of channel 0"),
        ("5 arcmin, 6 arcmin", "is not one beam"),
        ("5", "needs a unit|unit convertible"),
        (5, "needs a unit"),
        ("nan arcmin", "not one beam|not finite"),
        ("0 arcmin", "is not one beam"),
        ([5, 6] * u.arcmin, "is not one beam"),
        ("5 arcmin,4 arcmin,3 deg,2 deg", "size|takes"),
    ],
)
def test_e14_sizes_that_cannot_be_are_one_line(size, said):
    with pytest.raises(InputError, match=said) as caught:
        cube().at_common_beam(size)
    assert "\n" not in str(caught.value)


def test_e14_channels_without_a_beam_are_named():
    with pytest.raises(InputError, match=r"channel 1 has data and no beam: flag it, cube.flagged\(\[1\]\)"):
        cube(psf=Psf.gaussian([4, np.nan, 3] * u.arcmin)).at_common_beam()
    with pytest.raises(InputError, match="a common beam needs the beams of the cube"):
        cube(psf=None).at_common_beam()


@pytest.mark.parametrize(("words", "want"), [([], [4, 3]), (["5 arcmin"], [5, 5])])
def test_e14_the_command_makes_them_equal(tmp_path, monkeypatch, words, want):
    monkeypatch.chdir(tmp_path)
    cube().write("a.fits")
    given = []
    monkeypatch.setattr(CubeAnalysis, "run", lambda self, one, *rest: given.append(one) or run(self, one, *rest))
    settings = ["--products", "spectrum-2d", "--out", "out", "--common-beam", *words]
    assert main(["analyze", "a.fits", *settings]) == 0
    (found,) = given
    assert np.rad2deg(found.psf.major_rad) * 60 == pytest.approx([want[0]] * 3)
    assert np.rad2deg(found.psf.minor_rad) * 60 == pytest.approx([want[1]] * 3)
