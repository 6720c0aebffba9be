"""Minor cycles of CLEAN: Hogbom's, on the pixels that can matter, and on several scales; models and residuals."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from instrument.image.components import take, take_whole
from instrument.units import Bool, Complex, Float

BIAS = 0.6  # how much less a scale twice as large counts (Offringa & Smirnov 2017)
WHOLE = 0.1  # of the pixels: where more are above the floor, all are gone through row by row
AT_ONCE = 0.2  # of its peak, by which one scale is cleaned before the scales are looked at again


def scale_kernel(width: float, shape: tuple[int, int]) -> Float:
    """Tapered quadratic of full size `width` pixels and sum 1, (Ny, Nx), its middle at (Ny // 2, Nx // 2)."""
    y, x = (np.arange(n) - n // 2 for n in shape)
    r = np.hypot(y[:, None], x) / (width / 2)
    kernel = np.where(r < 1, (1 - r**2) * (0.5 + 0.5 * np.cos(np.pi * r)), 0.0)
    return np.asarray(kernel / kernel.sum())


class Folding:
    """Linear foldings of images (..., Ny, Nx) with kernels (..., Ny, Nx) centred at (Ny // 2, Nx // 2)."""

    def __init__(self, shape: tuple[int, int]) -> None:
        from ducc0 import fft

        self.shape = shape
        self.padded = tuple(fft.good_size(2 * n, True) for n in shape)

    def transform(self, images: Float) -> Complex:
        """Of images with their first pixel at the origin."""
        from ducc0 import fft

        wide = np.zeros((*images.shape[:-2], *self.padded))
        wide[..., : self.shape[0], : self.shape[1]] = images
        return np.asarray(fft.r2c(wide, axes=(-2, -1), nthreads=0))

    def kernel(self, images: Float) -> Complex:
        """Of kernels with their middle at the origin."""
        from ducc0 import fft

        wide = np.zeros((*images.shape[:-2], *self.padded))
        wide[..., : self.shape[0], : self.shape[1]] = images
        return np.asarray(fft.r2c(np.roll(wide, [-(n // 2) for n in self.shape], axis=(-2, -1)), axes=(-2, -1)))

    def back(self, cells: Complex) -> Float:
        """The images of transforms, (..., Ny, Nx)."""
        from ducc0 import fft

        wide = fft.c2r(cells, axes=(-2, -1), lastsize=self.padded[1], forward=False, inorm=2, nthreads=0)
        return np.asarray(wide[..., : self.shape[0], : self.shape[1]])

    def centred(self, cells: Complex) -> Float:
        """The same of kernels: with their middle at (Ny // 2, Nx // 2) again."""
        from ducc0 import fft

        wide = fft.c2r(cells, axes=(-2, -1), lastsize=self.padded[1], forward=False, inorm=2, nthreads=0)
        wide = np.roll(wide, [n // 2 for n in self.shape], axis=(-2, -1))
        return np.asarray(wide[..., : self.shape[0], : self.shape[1]])


@dataclass(frozen=True)
class Lobes:
    """PSFs of channels (F, Ny, Nx), peak 1, and the sizes in pixels of the scales on which is cleaned, 0 for points."""

    psf: Float
    scales: tuple[float, ...] = (0.0,)

    @cached_property
    def folding(self) -> Folding:
        """Foldings of images of this size."""
        return Folding((self.psf.shape[1], self.psf.shape[2]))

    @cached_property
    def response(self) -> Complex:
        """Transforms of the PSFs (F, ...)."""
        return self.folding.kernel(self.psf)

    @cached_property
    def kernels(self) -> list[Complex | None]:
        """Transforms of the shapes of the scales; `None` for points."""
        shape = self.folding.shape
        return [self.folding.kernel(scale_kernel(s, shape)) if s > 0 else None for s in self.scales]

    @cached_property
    def smoothed(self) -> list[Float]:
        """PSFs folded twice with the shape of each scale, (Ny, Nx, F)."""
        each = [self.psf if k is None else self.folding.centred(self.response * np.abs(k) ** 2) for k in self.kernels]
        return [np.ascontiguousarray(np.moveaxis(p, 0, -1)) for p in each]

    @property
    def bias(self) -> Float:
        """What peaks of the scales count for."""
        smallest = min((s for s in self.scales if s > 0), default=1.0)
        return np.array([1.0 if s == 0 else BIAS ** (-1 - np.log2(s / smallest)) for s in self.scales])


@dataclass(frozen=True)
class Search:
    """How peaks are looked for in K Stokes parameters and F channels at once, and what is taken there.

    `share` (K, F) weighs the channels, 0 for a parameter in which nothing is looked for; `fit` (K, F, F) takes the
    values of channels to those of the spectrum that they may have; `mask` (Ny, Nx) is where components may be.
    """

    share: Float
    fit: Float
    gain: float
    mask: Bool
    negative: bool = True

    def height(self, images: Float) -> Float:
        """What is looked at, (Ny, Nx), of images (K, F, Ny, Nx): 0 outside the mask."""
        sums = np.einsum("kf,kfyx->kyx", self.share, images)
        if not self.negative:
            sums = np.maximum(sums, 0)
        return np.where(self.mask, np.abs(sums[0]) if len(sums) == 1 else np.sqrt((sums**2).sum(axis=0)), 0.0)


def minor_cycle(residual: Float, lobes: Lobes, search: Search, floor: float, most: int) -> tuple[Float, int, bool]:
    """Components until the peak is below a floor: the model they make (K, F, Ny, Nx), their number, False if diverging.

    `residual` (K, F, Ny, Nx) is changed in place: the model folded with the PSF is taken off it. Pixels that are above
    the floor are cleaned by themselves, which is Hogbom's CLEAN of the whole image as long as no other rises above
    them; the whole is then brought up to date, and looked at again.
    """
    model, done = np.zeros_like(residual), 0
    several = len(lobes.scales) > 1
    while done < most:
        which, smooth, height = _highest(residual, lobes, search)
        top, bias = float(height.max()), float(lobes.bias[which])
        if not top * bias > floor:
            break
        low = max(floor / bias, (1 - AT_ONCE) * top) if several else floor
        part, count, left = _taken(smooth, height > low, lobes.smoothed[which], search, (low, most - done))
        if (kernel := lobes.kernels[which]) is not None:
            part = lobes.folding.back(lobes.folding.transform(part) * kernel)
        model += part
        residual -= lobes.folding.back(lobes.folding.transform(part) * lobes.response)
        done += count
        if count == 0 or left > 1.5 * top:
            return model, done, count == 0
    return model, done, True


def _taken(
    images: Float, active: Bool, psf: Float, search: Search, limits: tuple[float, int]
) -> tuple[Float, int, float]:
    """Components at active pixels, as images (K, F, Ny, Nx), their number, and the peak that is left there."""
    ny, nx, channels = psf.shape
    gain, part = search.gain / psf[ny // 2, nx // 2], np.zeros_like(images)
    ends = np.array([*limits, search.negative])
    if len(images) == channels == 1 and np.count_nonzero(active) > WHOLE * active.size:
        mask, weight = search.mask.astype(float), float(search.share[0, 0])
        ends[0] /= weight
        image = np.array(images[0, 0])
        done, left = take_whole(image, np.ascontiguousarray(psf[..., 0]), mask, float(gain[0]), ends, part[0, 0])
        return part, done, left * weight
    rows, columns = np.nonzero(active)
    values = np.ascontiguousarray(np.moveaxis(images[:, :, rows, columns], -1, 0))
    taken, places = np.zeros_like(values), np.stack([rows, columns], axis=1)
    done, left = take(values, places, psf, search.share, search.fit, gain, ends, taken)
    part[:, :, rows, columns] = np.moveaxis(taken, 0, -1)
    return part, done, left


def _highest(residual: Float, lobes: Lobes, search: Search) -> tuple[int, Float, Float]:
    """The scale with the highest peak, the residual folded with it (K, F, Ny, Nx), and its height (Ny, Nx)."""
    if len(lobes.scales) == 1 and lobes.kernels[0] is None:
        return 0, residual, search.height(residual)
    cells, best = lobes.folding.transform(residual), (0, residual, np.zeros(residual.shape[2:]))
    highest = -1.0
    for s, (kernel, bias) in enumerate(zip(lobes.kernels, lobes.bias, strict=True)):
        smooth = residual if kernel is None else lobes.folding.back(cells * kernel)
        height = search.height(smooth)
        if (top := float(height.max()) * bias) > highest:
            highest, best = top, (s, smooth, height)
    return best


def spectral_fit(freq_hz: Float, weight: Float, terms: int | None) -> Float:
    """The matrix (F, F) that takes values of channels to a polynomial of `terms` terms through them, least squares.

    `None` leaves each channel as it is. Channels of weight 0 get what the others say.
    """
    count = len(freq_hz)
    if terms is None or (terms >= count and np.all(weight > 0)):
        return np.eye(count)
    x = (freq_hz - freq_hz.mean()) / max(float(np.ptp(freq_hz)) / 2, 1.0)
    basis = np.polynomial.legendre.legvander(x, min(terms, int((weight > 0).sum())) - 1)
    root = np.sqrt(weight)
    return np.asarray(basis @ np.linalg.pinv(basis * root[:, None]) * root)


def sigma_of(images: Float, share: Float, where: Bool) -> float:
    """Noise of the height that a search looks at, from the median of |residual| (K, F, Ny, Nx) in each Stokes."""
    sums = np.einsum("kf,kfyx->kyx", share, images)[:, where]
    return float(np.sqrt(((1.4826 * np.median(np.abs(sums), axis=1)) ** 2).sum())) if sums.size else 0.0


def restored(model: Float, lobe: tuple[float, float, float], pixel_rad: float, folding: Folding) -> Float:
    """Model images (..., Ny, Nx) in Jy/pixel folded with a Gaussian of peak 1: major, minor (fwhm) and angle, rad."""
    if not model.any():
        return np.zeros_like(model)
    major, minor, angle = lobe
    y, x = (pixel_rad * (np.arange(n) - n // 2) for n in folding.shape)
    north, east = y[:, None], -x
    along, across = north * np.cos(angle) + east * np.sin(angle), east * np.cos(angle) - north * np.sin(angle)
    beam = np.exp(-4 * np.log(2) * ((along / major) ** 2 + (across / minor) ** 2))
    return folding.back(folding.transform(model) * folding.kernel(beam))
