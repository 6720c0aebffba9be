"""The contract of foreground removers: one claim per function, its name the sentence."""

from __future__ import annotations

import numpy as np

from instrument.conformance.bench import demand, demand_repeatable, demand_same
from instrument.errors import Outcome
from instrument.foreground.base import ForegroundRemover
from instrument.foreground.maps import Usable
from instrument.image.cube import StokesCube
from instrument.units import Float

CLOSE = 1e-6  # of the brightest foreground: an iteration may end elsewhere by the rounding of another order of sums


def foreground_cube() -> tuple[StokesCube, Float]:
    """Four smooth foregrounds of 1 to 0.2 K, 1 mK noise, 40 channels of 24 x 26 pixels; their sum (F, Ny, Nx).

    Of different maps and spectra (Legendre polynomials of degree 0 to 3): all four stand far above the noise, so that
    what a remover finds is determined.
    """
    from astropy import units as u

    rng = np.random.default_rng(0)
    x = np.linspace(-1, 1, 40)
    y_pixel, x_pixel = np.meshgrid(np.arange(24), np.arange(26), indexing="ij")
    foreground = np.zeros((40, 24, 26))
    for degree, bright in enumerate((1.0, 0.5, 0.3, 0.2)):
        image = np.zeros(y_pixel.shape)
        for y0, x0, peak in rng.uniform((0, 0, -1), (24, 26, 1), (20, 3)):
            image += peak * np.exp(-((y_pixel - y0) ** 2 + (x_pixel - x0) ** 2) / 18)
        foreground += bright * np.multiply.outer(np.polynomial.legendre.legval(x, np.eye(4)[degree]), image)
    data = rng.normal(scale=1e-3, size=(40, 4, 24, 26))
    data[:] += foreground[:, None]
    return StokesCube(data, (147.8 + 7.8 * x) * u.MHz, 8 * u.arcmin, "K"), foreground


def its_separation_is_of_known_words_and_shapes(remover: ForegroundRemover) -> str:
    """Outcome, a remark in one line, mixing (C, n), components (n, Ny, Nx), an operator or a foreground, all finite."""
    cube, _ = foreground_cube()
    given = Usable.of(cube, remover.stokes, remover.planes).maps
    maps, found = given.plane, remover.separate(given)
    demand(isinstance(found.outcome, Outcome), f"outcome = {found.outcome!r}")
    demand(bool(found.remark) and "\n" not in found.remark, f"remark = {found.remark!r}")
    n = found.mixing.shape[1]
    demand(found.mixing.shape == (len(maps), n), f"mixing has shape {found.mixing.shape}")
    demand(np.shape(found.components) == (n, *maps.shape[1:]), f"components have shape {np.shape(found.components)}")
    demand((found.operator is None) != (found.foreground is None), "it needs either an operator or a foreground")
    demand(found.of(maps).shape == maps.shape, f"the foreground has shape {found.of(maps).shape}")
    demand(all(np.isfinite(a).all() for a in (found.mixing, found.components, found.of(maps))), "not finite")
    return f"{n} components; {found.remark}"


def foreground_and_residual_make_up_the_cube(remover: ForegroundRemover) -> str:
    """foreground + residual = cube, and the Stokes parameters not asked for stay as they were."""
    cube, _ = foreground_cube()
    split, others = remover.split(cube), [s for s in range(4) if "IQUV"[s] != remover.stokes]
    demand(np.array_equal(split.residual.data[:, others], cube.data[:, others]), "another Stokes parameter changed")
    return demand_same(split.foreground.data + split.residual.data, cube.data, "foreground + residual")


def it_does_not_make_a_bright_smooth_foreground_worse(remover: ForegroundRemover) -> str:
    """The score against the truth is 1 or less on four smooth foregrounds 200 to 1000 times above the noise."""
    cube, foreground = foreground_cube()
    score = remover.split(cube).score(foreground=foreground)
    demand(score.value <= 1 + 1e-9, f"score {score.value:.3g}: it leaves more than there was")
    return f"score {score.value:.2g}"


def what_has_no_data_comes_back_as_nan_and_changes_nothing_else(remover: ForegroundRemover) -> str:
    """A channel that is NaN: the rest as without it. A pixel that is NaN in one channel: NaN in all of them."""
    cube, _ = foreground_cube()
    s = "IQUV".index(remover.stokes)
    data = cube.data.copy()
    data[7, s] = np.nan
    rest = np.delete(np.arange(len(data)), 7)
    short = StokesCube(cube.data[rest], _hertz(cube.freq_hz[rest]), _radians(cube.pixel_rad), cube.unit)
    found = remover.split(cube.with_data(data)).residual.data[:, s]
    demand(np.isnan(found[7]).all(), "a channel without data comes back with numbers")
    _close(found[rest], remover.split(short).residual.data[:, s], "channels beside one without data")
    data = cube.data.copy()
    data[3, s, 5, 6] = np.nan
    data[4, s, 9, 9] = np.inf
    split = remover.split(cube.with_data(data))
    for name, maps in (("foreground", split.foreground.data[:, s]), ("residual", split.residual.data[:, s])):
        holes = np.isnan(maps)
        demand(holes[:, [5, 9], [6, 9]].all(), f"a pixel without data comes back in the {name} with numbers")
        demand(holes.sum() == 2 * len(maps), f"{holes.sum()} voxels of the {name} are NaN, {2 * len(maps)} were due")
    for plane in remover.planes:
        data = cube.data.copy()
        data[3, "IQUV".index(plane), 5, 6] = np.nan
        holes = np.isnan(remover.split(cube.with_data(data)).residual.data[:, s])
        demand(holes[:, 5, 6].all() and holes.sum() == len(holes), f"a pixel without {plane} comes back with numbers")
    return ""


def it_scales_with_the_cube(remover: ForegroundRemover) -> str:
    """A cube 2^20 times as bright leaves 2^20 times as much, sign and all."""
    cube, _ = foreground_cube()
    before = remover.split(cube).residual.data
    return demand_same(remover.split(cube.with_data(-cube.data * 2.0**20)).residual.data, -before * 2.0**20, "scaled")


def the_order_of_channels_does_not_matter(remover: ForegroundRemover) -> str:
    """Channels shuffled: the same residual of each, to 1e-6 of the brightest."""
    cube, _ = foreground_cube()
    order = np.random.default_rng(1).permutation(len(cube.data))
    shuffled = StokesCube(cube.data[order], _hertz(cube.freq_hz[order]), _radians(cube.pixel_rad), cube.unit)
    return _close(remover.split(shuffled).residual.data, remover.split(cube).residual.data[order], "shuffled channels")


def a_cube_of_zeros_stays_zero(remover: ForegroundRemover) -> str:
    """No NaN, no error; channels that do not vary are left as they are."""
    cube, _ = foreground_cube()
    data = np.zeros_like(cube.data)
    left = remover.split(cube.with_data(data)).residual.data
    demand(np.array_equal(left, data), "something other than 0 is left")
    return ""


def a_call_of_split_has_no_side_effects(remover: ForegroundRemover) -> str:
    """The same call twice gives the same, and nothing that was given has changed."""
    cube, _ = foreground_cube()
    return demand_repeatable(lambda: remover.split(cube).residual.data, remover, cube)


CLAIMS = (
    its_separation_is_of_known_words_and_shapes,
    foreground_and_residual_make_up_the_cube,
    it_does_not_make_a_bright_smooth_foreground_worse,
    what_has_no_data_comes_back_as_nan_and_changes_nothing_else,
    it_scales_with_the_cube,
    the_order_of_channels_does_not_matter,
    a_cube_of_zeros_stays_zero,
    a_call_of_split_has_no_side_effects,
)


def _close(found: Float, due: Float, what: str) -> str:
    apart = float(np.abs(found - due).max())
    demand(apart <= CLOSE, f"{what}: apart by {apart:.1e} K where the foreground is 1 K")
    return f"apart by {apart:.0e}"


def _hertz(values: Float) -> object:
    from astropy import units as u

    return u.Quantity(values, "Hz")


def _radians(value: float) -> object:
    from astropy import units as u

    return u.Quantity(value, "rad")
