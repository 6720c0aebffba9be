"""Separable kernels: all node images at each sample from one grid, and their adjoint; the core of `grid_atom.py`.

Functions between nodes are polynomials, c_k = sum_ij s_kij T_i(l) T_j(m). A kernel of W weights that reads the sum with
exp(-2 pi i u l) off a grid has brothers that read those with T_i(l) exp(-2 pi i u l) off the same cells, and so one
patch of W x W cells gives the images of all nodes, in as many products as a few of them alone would take. The slow twin
is `gridding.py`, a w-gridder for each node; tests/accuracy/test_separable.py compares them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from instrument.observe.grid import ImageGrid
from instrument.predict.beam_nodes import BeamNodes
from instrument.predict.separable_loops import CELLS, POINTS
from instrument.units import Complex, Float

SIGMA = 2  # cells as many times as fine as the image asks for
WIDTHS = (6, 8, 10, 12, 14, 16, 18, 20, 22, 24)
SAFETY = 2.0  # over the largest error that was looked at
LOOKED = 3000
LARGEST = 6e8  # bytes of a grid
PRODUCT = 2e-10  # seconds, most of it loads and stores


class Kernel(NamedTuple):
    """Weights of W cells for degrees 0 ... d, at places between them: (CELLS + POINTS, W, d + 1 and zeros)."""

    width: int
    degree: int
    table: Float

    def taper(self, x: Float) -> Float:
        """What an image is divided by at x cycles a cell, |x| <= 1 / (2 SIGMA)."""
        return _taper(x, self.width, self.degree)

    def made(self, x: Float, off: Float) -> Complex:
        """What it makes of T_i(2 SIGMA x), (N, d + 1), at x (N,), `off` (N,) from the middle of its cells."""
        first, share = _between(off)
        rows = first[:, None] + np.arange(POINTS)
        weights = np.einsum("nq,nqti->nti", share, self.table[rows])[..., : self.degree + 1]
        cells = np.arange(self.width) - (self.width - 1) / 2
        fringes = np.exp(-2j * np.pi * x[:, None] * (cells - off[:, None])) / self.taper(x)[:, None]
        return np.einsum("nti,nt->ni", weights, fringes) * (-1j) ** (np.arange(self.degree + 1) % 2)


@cache
def kernel(width: int, degree: int) -> Kernel:
    """The weights, by least squares over the band of the image, at each place between cells."""
    x = np.cos((np.arange(4 * width) + 0.5) * np.pi / (4 * width)) / (2 * SIGMA)
    taper = _taper(x, width, degree)[:, None]
    series = np.polynomial.chebyshev.chebvander(2 * SIGMA * x, degree)
    odd = np.arange(degree + 1) % 2 == 1  # real weights make i times what is odd
    due = np.concatenate([series * ~odd, series * odd])
    cells = np.arange(width) - (width - 1) / 2
    table = np.zeros((CELLS + POINTS, width, -(-(degree + 1) // 4) * 4))
    for row, off in enumerate((np.arange(CELLS + POINTS) - (POINTS // 2 - 1)) / CELLS - 0.5):
        fringes = np.exp(-2j * np.pi * np.outer(x, cells - off)) / taper
        rows = np.concatenate([fringes.real, fringes.imag])
        table[row, :, : degree + 1] = np.linalg.lstsq(rows, due, rcond=1e-15)[0]
    table.setflags(write=False)  # shared by all
    return Kernel(width, degree, table)


def _taper(x: Float, width: int, degree: int) -> Float:
    """The transform of an exponential of a semicircle, two cells narrower than a kernel of many degrees."""
    return np.asarray(np.polynomial.chebyshev.chebval(8 * SIGMA**2 * x**2 - 1, _taper_series(width, degree)))


@cache
def _gauss() -> tuple[Float, Float]:
    return np.polynomial.legendre.leggauss(96)


@cache
def _taper_series(width: int, degree: int) -> Float:
    half = (width - 2 * (degree > 0)) / 2
    beta = 0.98 * np.pi * 2 * half * (1 - 0.5 / SIGMA)
    t, w = _gauss()
    shape = w * half * np.exp(beta * (np.sqrt(1 - t**2) - 1))

    def transform(z: Any) -> Any:  # of x squared: it is even
        x = np.sqrt((z + 1) / 8) / SIGMA
        return np.cos(2 * np.pi * np.outer(x, t * half)) @ shape

    return np.asarray(np.polynomial.chebyshev.chebinterpolate(transform, 24))


def _between(off: Float) -> tuple[Any, Float]:
    """The first row of a table for places between -1/2 and 1/2 (N,), and the weights of `POINTS` rows (N, POINTS)."""
    first = np.minimum(((off + 0.5) * CELLS).astype(int), CELLS - 1)
    at = (off + 0.5) * CELLS - first + POINTS // 2 - 1
    q = np.arange(POINTS)
    share = [np.prod([(at - j) / (i - j) for j in q if j != i], axis=0) for i in q]
    return first, np.stack(share, axis=-1)


@dataclass(frozen=True)
class Kernels:
    """Kernels across the sky and along w for some nodes; `error` bounds the sum over nodes of that of |c_k|."""

    across: Kernel
    deep: Kernel
    error: float

    def cells(self, grid: ImageGrid, uv: float, w: float) -> tuple[int, int, int]:
        """Cells along u, v and w for baselines of up to so many wavelengths."""
        across = [2 * uv * SIGMA * n * grid.pixel + self.across.width for n in grid.pixels[::-1]]
        return int(across[0]), int(across[1]), int(w / planes(grid)[1]) + 1 + self.deep.width

    def seconds(self, nodes: int, kinds: int) -> float:
        """Of one sample of `kinds` Stokes parameters on one core: its products."""
        width, orders, numbers = self.across.width, self.across.degree + 1, 2 * kinds
        cells = width * width * numbers * (self.deep.width + orders) + width * numbers * orders * (orders + 2)
        return PRODUCT * (cells + nodes * (numbers * orders * (orders + 1) / 2 + 190))


def fits(cells: Any) -> bool:
    """Whether a grid of so many cells along u, v and w, of four Stokes parameters, is small enough."""
    return 64.0 * float(np.prod(cells, dtype=float)) <= LARGEST


def planes(grid: ImageGrid) -> tuple[float, float]:
    """The middle of n - 1 over an image and the distance of planes of w, in wavelengths."""
    ny, nx = grid.pixels
    r2 = np.hypot(nx // 2, ny // 2) ** 2 * grid.pixel**2  # pixel (0, 0) is the farthest
    middle = min(-r2 / (1 + np.sqrt(1 - r2)) / 2, -1e-9)
    return float(middle), float(1 / (2 * SIGMA * abs(middle)))


def kernels_for(nodes: BeamNodes, wanted: float) -> Kernels | None:
    """The narrowest kernels whose error is at most `wanted`, `None` where none is."""
    rng = np.random.default_rng(0)
    x, off = rng.uniform(-0.5, 0.5, (2, LOOKED, 2))
    third = LOOKED // 3
    x[:third] = 0.5 * np.sign(x[:third])  # corners
    for axis in range(2):  # and edges
        edge = slice((1 + axis) * third // 2 + third // 2, (2 + axis) * third // 2 + third // 2)
        x[edge, axis] = 0.5 * np.sign(x[edge, axis])
    x /= SIGMA
    degree = nodes.series.shape[1] - 1
    due = nodes.at(2 * SIGMA * x * nodes.reach)
    for deep in (kernel(width, 0) for width in WIDTHS):
        along = SAFETY * float(np.abs(deep.made(x[:, 0], off[:, 0]) - 1).max())
        if along * nodes.growth <= wanted / 4:
            break
    else:
        return None
    for across in (kernel(width, degree) for width in WIDTHS if width > degree // 2):
        found = nodes.summed(across.made(x[:, 0], off[:, 0]), across.made(x[:, 1], off[:, 1]))
        error = SAFETY * float(np.abs(found - due).sum(axis=0).max())
        if error * (1 + along) + along * nodes.growth <= wanted:
            return Kernels(across, deep, error * (1 + along) + along * nodes.growth)
    return None
