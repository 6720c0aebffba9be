"""ImageGrid: the pixels of images are where the projection, astropy and every part of the package say they are."""

import numpy as np
import pytest
from astropy import units as u

from instrument import Direction, ImageGrid, Imager, InputError, StokesCube
from instrument.observe.directions import lmn
from instrument.units import unit_vectors

CENTRE = Direction(2.15, 0.84)


@pytest.mark.parametrize("pixels", [(5, 8), (8, 5), 6, (1, 1)])
def test_lists_of_pixels_run_as_the_image_does_and_x_to_the_west(pixels):
    grid = ImageGrid(pixels=pixels, pixel=0.5 * u.deg, centre=CENTRE)
    ny, nx = grid.pixels
    l, m = (a.reshape(ny, nx) for a in grid.lmn[:, :2].T)
    assert l[ny // 2, nx // 2] == m[ny // 2, nx // 2] == 0
    assert np.all(np.diff(l, axis=1) < 0)
    assert np.all(np.diff(m, axis=0) > 0)
    ra, dec = grid.directions()
    # two ways to n - 1; a direction is good to some roundings
    np.testing.assert_allclose(lmn(unit_vectors(ra, dec), CENTRE), grid.lmn, atol=1e-15)
    some = np.arange(len(grid))[::-3]
    np.testing.assert_array_equal(grid.directions(some), np.array([ra, dec])[:, some])


def test_world_coordinates_are_those_of_astropy():
    grid = ImageGrid(pixels=(7, 10), pixel=0.3 * u.deg, centre=CENTRE)
    y, x = (a.ravel() for a in np.indices(grid.pixels))
    sky = grid.wcs.pixel_to_world(x, y)
    np.testing.assert_allclose([sky.ra.rad, sky.dec.rad], grid.directions(), atol=1e-13)
    cube = StokesCube(np.ones((2, 4, 7, 10)), [150, 151] * u.MHz, 0.3 * u.deg, "K", CENTRE, constants="data")
    assert cube.grid == grid
    np.testing.assert_array_equal(cube.wcs.celestial.wcs.crpix, grid.wcs.wcs.crpix)
    np.testing.assert_array_equal(cube.wcs.celestial.wcs.cdelt, grid.wcs.wcs.cdelt)


def test_a_grid_comes_back_from_json_and_says_what_is_wrong():
    grid = ImageGrid(pixels=6, pixel=1 * u.arcmin, centre="08h13m36.0s +48d13m03s")
    assert ImageGrid.from_json(grid.to_json()) == grid
    assert ImageGrid.from_json(ImageGrid(pixels=6, pixel="1 arcmin").to_json()).centre is None
    with pytest.raises(InputError, match="an image of 6 x 6 pixels without a centre has no directions: give centre"):
        ImageGrid(pixels=6, pixel=1 * u.arcmin).directions()
    with pytest.raises(InputError, match=r"200 x 100 pixels of 1 deg are 200 x 100 deg: beyond the sky"):
        ImageGrid(pixels=(200, 100), pixel=1 * u.deg, centre=CENTRE).directions()
    with pytest.raises(InputError, match="200 pixels of 1 deg are 200 deg: beyond the sky"):
        Imager(pixels=200, pixel=1 * u.deg)
    with pytest.raises(InputError, match="pixel needs a unit"):
        ImageGrid(pixels=6, pixel=0.1)
