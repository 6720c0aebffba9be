"""Programs of others beside what is made of cubes: ducc0 alone, radiomesh, RM-Tools, rm-lite, ps_eor, as installed.

Each is called in this process as its users call it, its messages left out. What is asked of them is theirs, so that a
promise they break is no fault of this package.
"""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np

from instrument.errors import RefusedError
from instrument.image.cube import StokesCube
from instrument.mat2 import herm
from instrument.observe.directions import LIGHT
from instrument.precision.contest import RIGHT, UNSET, Entry
from instrument.units import Float
from instrument.visibilities import Visibilities

IMAGERS, FARADAY, SPECTRA = ("ducc0", "radiomesh"), ("rm-tools", "rm-lite"), ("ps_eor",)
DIGITS = tuple(10.0**-k for k in (2, 4, 6, 8, 10, 12))  # asked of radiomesh
MOST_BYTES = 1e9  # of its grids
MOST = 100_000  # iterations of RM-CLEAN
WINDOWS = {None: "boxcar", "hann": "hann", "blackman-harris": "blackmanharris"}  # ours: those of ps_eor


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Without what they print, log and warn of."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        before = logging.root.manager.disable
        logging.disable(logging.ERROR)
        try:
            yield
        finally:
            logging.disable(before)


def _entry(name: str, answer: Callable[[float], Any], values: Sequence[float] = ()) -> Entry:
    def silent(asked: float) -> Any:
        with quiet():
            return answer(asked)

    return Entry(name, silent, tuple(values), peer=True)


# Images -----------------------------------------------------------------------------------------------------------


def imager_peers(data: Visibilities, pixels: int, pixel: float, values: Sequence[float]) -> list[Entry]:
    """ducc0 alone: one call for each Stokes parameter that is not zero, with natural weights; and radiomesh."""
    from ducc0.wgridder.experimental import vis2dirty

    def answer(asked: float) -> Float:
        freq = data.freq_hz[:1]
        uvw = np.ascontiguousarray(data.uvw_m.reshape(-1, 3))
        weight = np.ascontiguousarray(np.broadcast_to(data.whole_weight, data.data.shape[:3])[:, 0].reshape(-1, 1))
        planes = np.zeros((4, pixels, pixels))
        for plane, values in zip(planes, np.moveaxis(data.stokes()[:, 0], -1, 0), strict=True):
            vis = np.ascontiguousarray(values.reshape(-1, 1))
            if vis.any():
                plane[:] = vis2dirty(
                    uvw=uvw, freq=freq, vis=vis, wgt=weight, npix_x=pixels, npix_y=pixels, pixsize_x=pixel,
                    pixsize_y=pixel, epsilon=asked, do_wgridding=True, divide_by_n=False, flip_u=True, flip_w=True,
                    nthreads=0,
                ).T  # fmt: skip
        return np.asarray(planes / weight.sum())

    found = [_entry("ducc0 alone (epsilon)", answer, [v for v in values if v >= 1e-12])]
    if find_spec("radiomesh") and find_spec("sympy"):
        found.append(_entry("radiomesh (digits of its kernel)", _radiomesh(data, pixels, pixel), DIGITS))
    return found


def _radiomesh(data: Visibilities, pixels: int, pixel: float) -> Callable[[float], Float]:
    """All Stokes parameters in one call, with a kernel of two cells more than digits; it wants w >= 0.

    Where w < 0 it conjugates correlations and then makes V of them, of the wrong sign (0.1.2): baselines are turned
    before. It compiles its Stokes expressions at every call, half a minute; they are kept from one to the next here.
    """
    from radiomesh import core

    turned = data.uvw_m[..., 2:] > 0  # w counts the other way there
    uvw = np.where(turned, -data.uvw_m, data.uvw_m) * (-1, 1, -1)
    v = np.where(turned[..., None], herm(data.data[:, 0]), data.data[:, 0])
    shape = (*v.shape[:2], 1, 4)
    weight = np.broadcast_to(data.whole_weight, data.data.shape[:3])[:, 0]
    weights = np.ascontiguousarray(np.broadcast_to(weight[..., None, None], shape))
    jones = np.ones((len(v), len(data.layout), 1, 1, 2), complex)
    make, made = core.stokes_funcs, list[Any]()

    def kept(*given: Any) -> Any:
        if not made:
            made.append(make(*given))
        return made[0]

    def answer(asked: float) -> Float:
        deep = np.ptp(np.abs(uvw[..., 2])) * data.freq_hz[0] / LIGHT * 2 * (pixels * pixel) ** 2 / 2  # planes in w
        if (size := 16 * 4 * 4.0 * pixels**2 * (deep + 12)) > MOST_BYTES:
            raise RefusedError(f"its planes in w take {size / 1e9:.1f} GB at once, and as much again")
        core.stokes_funcs = kept
        try:
            planes = core.vis2im_wgrid(
                uvw, data.freq_hz[:1], v.reshape(shape), weights, np.zeros(shape, bool), jones, data.antenna1,
                data.antenna2, pixels, pixels, pixel, pixel, "linear", "IQUV", 4, alpha=2 + round(-np.log10(asked)),
            )  # fmt: skip
        finally:
            core.stokes_funcs = make
        return np.asarray(np.swapaxes(planes, 1, 2) / (2 * weight.sum()))

    return answer


# Faraday depth ----------------------------------------------------------------------------------------------------


def synthesis_peers(cube: StokesCube, depths: Float) -> list[Entry]:
    """RM-Tools by the accuracy of its transforms, in the precision that has it; rm-lite the same."""
    q, v = (np.ascontiguousarray(cube.data[:, k]) for k in (1, 2))
    lambda2 = (LIGHT / cube.freq_hz) ** 2
    found, accuracies = [], tuple(10.0**-k for k in (3, 5, 6, 8, 10, 12))
    if find_spec("RMutils"):
        from RMutils.util_RM import do_rmsynth_planes

        def tools(asked: float) -> Any:
            bits = 32 if asked >= 1e-7 else 64
            return do_rmsynth_planes(q, v, lambda2, depths, nBits=bits, eps=asked, log=_nothing).FDFcube

        found.append(_entry("RM-Tools (eps)", tools, accuracies))
    if find_spec("rm_lite"):
        found.append(_entry("rm-lite (eps)", _rm_lite_synthesis(q, v, lambda2, depths), accuracies))
    return found


def _rm_lite_synthesis(q: Float, v: Float, lambda2: Float, depths: Float) -> Callable[[float], Any]:
    from rm_lite.utils.synthesis import rmsynth_nufft

    def answer(asked: float) -> Any:
        p = (q + 1j * v).astype(np.complex64 if asked >= 1e-7 else np.complex128, copy=False)
        return rmsynth_nufft(p, lambda2, depths, np.ones(len(lambda2)), float(lambda2.mean()), eps=asked, nthreads=1)

    return answer


def clean_peers(dirty: Any, gain: float) -> list[Entry]:
    """RM-Tools and rm-lite by the cutoff, on the same dirty spectra."""
    found, cutoffs = [], tuple(10.0**-k for k in (1, 2, 3, 4))
    many, shape = len(dirty.depths), dirty.data.shape[1:]
    wide = (dirty.depths[1] - dirty.depths[0]) * np.arange(-many, many + 1)
    rmsf = np.repeat(dirty.rmsf_at(wide)[:, None], np.prod(shape), axis=1).reshape(len(wide), *shape)
    fwhm = np.full(shape, dirty.fwhm)
    if find_spec("RMutils"):
        from RMutils.util_RM import do_rmclean_hogbom

        def tools(asked: float) -> Any:
            given = dirty.data, dirty.depths, rmsf, wide, fwhm, asked, MOST, gain
            return do_rmclean_hogbom(*given, nBits=64, window=asked, log=_nothing).ccArr, RIGHT

        found.append(_entry("RM-Tools (cutoff)", tools, cutoffs))
    if find_spec("rm_lite"):
        from rm_lite.utils.clean import RMCleanOptions, RMSynthArrays, rmclean

        def lite(asked: float) -> Any:
            arrays = RMSynthArrays(dirty.data, dirty.depths, wide, rmsf, np.array(dirty.fwhm))
            options = RMCleanOptions(mask=asked, threshold=asked, max_iter=MOST, gain=gain)
            return rmclean(arrays, options).model_fdf_arr, RIGHT

        found.append(_entry("rm-lite (cutoff)", lite, cutoffs))
    return found


def _nothing(*text: Any, **more: Any) -> None:
    """RM-Tools prints by default."""


# Power spectra ----------------------------------------------------------------------------------------------------


def _ps_eor(field: Float, freq: Float, pixel: float, taper: Any, space: Any = None) -> tuple[Any, Any]:
    """Its cube of (u, v) cells of a field (F, Ny, Nx), and its maker of spectra, as many delays as channels."""
    from ps_eor import datacube, pspec

    about = datacube.ImageMetaData.from_res(pixel, field.shape[1:])
    about.wcs.wcs.cdelt[2] = freq[1] - freq[0]
    images = datacube.CartImageCube(field, freq, about)
    if space:
        images.apply_window_function(datacube.WindowFunction(WINDOWS[space], circular=False))
    longest = 0.5 / pixel
    cells = images.ft(0, longest)
    settings = pspec.PowerSpectraConfig(el=2 * np.pi * np.geomspace(1 / (pixel * field.shape[1]), longest, 12))
    settings.window_fct, settings.umin, settings.umax = WINDOWS[taper], 0, longest
    band = pspec.EorBin(0, freq, freq, M=len(freq))
    return cells, pspec.PowerSpectraCart(band, settings, datacube.NoPrimaryBeam())


def floor_peers(cube: StokesCube) -> list[Entry]:
    """ps_eor by its tapers: the mean power of every delay that it gives."""
    if not find_spec("ps_eor"):
        return []
    return [_entry(f"ps_eor {WINDOWS[name]}", _levels(cube, name)) for name in WINDOWS]


def _levels(cube: StokesCube, taper: Any) -> Callable[[float], Any]:
    from astropy.cosmology import Planck15

    h = Planck15.h

    def answer(asked: float) -> Any:
        cells, made = _ps_eor(np.array(cube.data[:, 0]), cube.freq_hz, cube.pixel_rad, taper)
        return made.k_par * h, np.nanmean(made.get_ps2d(cells).data, axis=1) / h**3

    return answer


def known_peers(cubes: Sequence[StokesCube], edges: Float, law: Callable[[Float], Float]) -> list[Entry]:
    """ps_eor with the tapers of ours that it has; its bandwidth (N - 1) dnu is taken as it is."""
    if not find_spec("ps_eor"):
        return []
    pairs = ((None, None), ("hann", None), ("blackman-harris", None), ("blackman-harris", "hann"), ("hann", "hann"))
    return [
        _entry(f"ps_eor {WINDOWS[a]}, images {b or 'none'}", _known(cubes, edges, law, a, b), (UNSET,))
        for a, b in pairs
    ]


def _known(cubes: Sequence[StokesCube], edges: Float, law: Any, taper: Any, space: Any) -> Callable[[float], Float]:
    from astropy.cosmology import Planck15
    from ps_eor import psutil

    h = Planck15.h

    def answer(asked: float) -> Float:
        out = []
        for cube in cubes:
            cells, made = _ps_eor(np.array(cube.data[:, 0]), cube.freq_hz, cube.pixel_rad, taper, space)
            ball = made.get_ps3d(edges / h, cells)
            perp, par = psutil.l_to_k(2 * np.pi * cells.ru, made.z) * h, made.k_par * h
            k = np.hypot(perp, par[:, None])
            index = np.digitize(k, edges) - 1
            due = np.array([law(k[index == i]).mean() for i in range(len(edges) - 1)])
            out.append(ball.data * 2 * np.pi**2 / (ball.k_mean * h) ** 3 / due)
        return np.array(out)

    return answer
