"""RM-CLEAN: spectra in Faraday depth as components, each with the RMSF of the channels that its own pixel has."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Generic, TypeVar

import numpy as np

from instrument.analyze.faraday.band import half_height, one
from instrument.analyze.faraday.chunks import in_threads
from instrument.analyze.faraday.spectra import FaradaySpectra
from instrument.compiled import compiled
from instrument.errors import InputError, InstrumentError, Outcome
from instrument.phasor import FAST
from instrument.shown import short_repr
from instrument.units import Complex, Float, Int

C = TypeVar("C", bound=FaradaySpectra)
OUTCOMES = (Outcome.CONVERGED, Outcome.ITERATION_LIMIT, Outcome.NON_FINITE)
BLOCK = 32  # spectra side by side: rows of 256 bytes are read and written, a column alone costs a page each value
LANES = 64  # spectra are padded to a multiple of it, so that vector loops have no tail
CHUNK_BYTES = 64 << 20  # of tables, where every pixel has flags of its own: 72 bytes a pixel and depth


@dataclass(frozen=True, eq=False)
class FaradayClean(Generic[C]):
    """What RM-CLEAN made of a Faraday cube, complex (N, Ny, Nx) each: components, residual and restored.

    Högbom's algorithm along Faraday depth (Heald, Braun & Edmonds 2009): the largest |F| times the gain becomes a
    component, and the RMSF centred there, times it, is taken off, until no |F| is above the cutoff. `restored` is the
    residual plus the components as real Gaussians of the FWHM of |R|, `fwhm` (Ny, Nx). `iterations` (Ny, Nx) are the
    components counted with repeats; `cutoff` (Ny, Nx) is in the unit of the cube. Pixels without data are NaN, their
    outcome is non-finite. Of a real Stokes parameter a component at phi has its conjugate at -phi: let the axis hold
    both.
    """

    __repr__ = short_repr
    dirty: C
    components: Complex
    residual: Complex
    restored: Complex
    iterations: Int
    codes: Any  # places in OUTCOMES, uint8 (Ny, Nx)
    cutoff: Float
    fwhm: Float
    gain: float

    @property
    def depths(self) -> Float:
        """Faraday depths, rad/m² (N,)."""
        return self.dirty.depths

    @cached_property
    def outcome(self) -> Any:
        """How each spectrum ended, `Outcome` (Ny, Nx)."""
        return np.array(OUTCOMES, object)[self.codes]

    @property
    def converged(self) -> Any:
        """Which spectra are cleaned down to the cutoff, bool (Ny, Nx)."""
        return self.codes == 0

    @property
    def cube(self) -> C:
        """The restored spectra as a `FaradayCube`, for peaks and files."""
        return replace(self.dirty, data=self.restored)

    def check(self) -> None:
        """Raise `InstrumentError` when a spectrum that has data did not come down to the cutoff."""
        ended = Counter(OUTCOMES[k] for k in self.codes[self.codes == 1])
        for outcome, count in ended.items():
            raise InstrumentError(f"{count} of {self.codes.size} spectra did not converge: {outcome.value}")


@compiled(nogil=True, fastmath=FAST, error_model="numpy")
def _subtract(re: Any, im: Any, power: Any, bits: Any, c: Any, table: Any, k: int, n: int) -> Any:
    """Take c R(i - k) off one spectrum of n depths, padded; the place of the largest |.|² left.

    `bits` is `power` as integers: of numbers that are not negative they have the same order, and unlike floats their
    largest is found by vector instructions (20 ns of 401, not 190).
    """
    wide, cr, ci = len(re), c[0], c[1]
    tre, tim = table[0][n - 1 - k : n - 1 - k + wide], table[1][n - 1 - k : n - 1 - k + wide]
    for i in range(wide):
        re[i] -= cr * tre[i] - ci * tim[i]
        im[i] -= cr * tim[i] + ci * tre[i]
        power[i] = re[i] * re[i] + im[i] * im[i]
    power[n:] = 0
    top = bits[0]
    for i in range(wide):
        if bits[i] > top:
            top = bits[i]
    place = np.int32(wide)
    for i in range(wide):
        place = min(place, np.int32(i) if bits[i] == top else np.int32(wide))
    return place


@compiled(nogil=True, error_model="numpy")
def _taken(data: Any, first: int, re: Any, im: Any, many: int) -> None:
    """Put `many` spectra of data (N, pixels) from pixel `first` on into the rows of `re` and `im`."""
    for k in range(data.shape[0]):
        for i in range(many):
            re[i, k] = data[k, first + i].real
            im[i, k] = data[k, first + i].imag


@compiled(nogil=True, error_model="numpy")
def _given(re: Any, im: Any, first: int, data: Any, many: int) -> None:
    """Put `many` rows of `re` and `im` into data (N, pixels) from pixel `first` on."""
    for k in range(data.shape[0]):
        for i in range(many):
            data[k, first + i] = complex(re[i, k], im[i, k])


@compiled(nogil=True, error_model="numpy")
def _largest(x: Any, y: Any, n: int) -> float:
    """Largest |value| of the first n of both, NaN where one is not finite."""
    size = 0.0
    for k in range(n):
        size = max(size, abs(x[k]), abs(y[k]))
        if not (np.isfinite(x[k]) and np.isfinite(y[k])):
            return np.nan
    return size


@compiled(nogil=True, fastmath={"contract"}, error_model="numpy")
def _clean(data: Any, first: int, pattern: Any, tables: Any, settings: Any, room: Any, made: Any, ended: Any) -> None:
    """Clean pixels from `first` on, as many as `pattern` (n,) has; tables (patterns, 2N - 1 and padding) of R and beam.

    `settings` are cutoff (n,), gain and most iterations; `room` to work in is (7, BLOCK, N and padding), and its last
    row as integers; `made` are components, residual and restored, `ended` iterations and codes.
    """
    n = data.shape[0]
    tre, tim, beam = tables
    cutoff, gain, limit = settings
    held, bits = room
    iterations, codes = ended
    re, im, cre, cim, fre, fim = held[0], held[1], held[2], held[3], held[4], held[5]
    power, c = held[6, 0], np.zeros(2, held.dtype)
    for start in range(0, len(pattern), BLOCK):
        many = min(BLOCK, len(pattern) - start)
        _taken(data, first + start, re, im, many)
        cre[:] = 0
        cim[:] = 0
        for i in range(many):
            pixel, p = first + start + i, pattern[start + i]
            x, y = re[i], im[i]
            size = _largest(x, y, n)
            iterations[pixel] = 0
            if not np.isfinite(size):
                codes[pixel] = 2
                held[:, i] = np.nan
                continue
            # by a power of two, which is exact: |F|² of 1e-20 would be 0 in float32
            scale = math.ldexp(1.0, math.frexp(size)[1]) if size > 0 else 1.0
            for k in range(n):
                x[k] /= scale
                y[k] /= scale
            bound = (cutoff[start + i] / scale) ** 2
            c[:] = 0
            x[n:] = 0
            y[n:] = 0
            k = _subtract(x, y, power, bits, c, (tre[p], tim[p]), 0, n)
            count = 0
            while power[k] > bound and count < limit:
                c[0], c[1] = gain * x[k], gain * y[k]
                cre[i, k] += c[0]
                cim[i, k] += c[1]
                k = _subtract(x, y, power, bits, c, (tre[p], tim[p]), k, n)
                count += 1
            iterations[pixel] = count
            codes[pixel] = (1 if power[k] > bound else 0) if np.isfinite(x[:n].sum() + y[:n].sum()) else 2
            fre[i], fim[i] = x, y
            for k in range(n):
                if cre[i, k] != 0 or cim[i, k] != 0:
                    for j in range(n):
                        fre[i, j] += cre[i, k] * beam[p, n - 1 + j - k]
                        fim[i, j] += cim[i, k] * beam[p, n - 1 + j - k]
            for values in (x, y, cre[i], cim[i], fre[i], fim[i]):
                for k in range(n):
                    values[k] *= scale
        _given(cre, cim, first + start, made[0], many)
        _given(re, im, first + start, made[1], many)
        _given(fre, fim, first + start, made[2], many)


def rm_clean(
    cube: C,
    cutoff: Any,
    sigmas: float | None,
    gain: float,
    iterations: int,
    progress: Callable[[float], None] | None,
) -> FaradayClean[C]:
    """Clean every spectrum of a cube; see `FaradayCube.clean`."""
    n, step = len(cube.depths), _step(cube.depths)
    if (cutoff is None) == (sigmas is None):
        raise InputError(f"clean needs one of cutoff= (in {cube.unit}) and sigmas= (multiples of the noise)")
    if not 0 < gain <= 1:
        raise InputError(f"gain = {gain} must be above 0 and at most 1, such as 0.1")
    if iterations < 0:
        raise InputError(f"iterations = {iterations} must not be below 0")
    pixels, shape = cube.data[0].size, cube.data.shape
    if sigmas is not None:
        level = (one(sigmas, "", "sigmas") * cube.noise_map()).ravel()
    else:
        level = np.full(pixels, one(cutoff, cube.unit, "cutoff"))
    if (level < 0).any():
        raise InputError(f"the cutoff of RM-CLEAN must not be below 0, got {np.nanmin(level):.4g} {cube.unit}")
    data = np.asarray(cube.data).reshape(n, -1)
    real = data.real.dtype
    wide = -(-n // LANES) * LANES
    tables = _Tables(cube, step, n, wide - n, real)
    size = int(np.clip(CHUNK_BYTES // (72 * n * BLOCK), 1, 64)) * BLOCK
    made = tuple(np.empty(data.shape, data.dtype) for _ in range(3))
    count, codes, fwhm = np.empty(pixels, np.int32), np.empty(pixels, np.uint8), np.empty(pixels)

    compiled: Any = _clean

    def work(first: int) -> None:
        here = slice(first, min(first + size, pixels))
        pattern, widths, *table = tables.of(here)
        fwhm[here] = widths[pattern]
        held = np.zeros((7, BLOCK, wide), real)
        bits = held[6, 0].view(f"i{real.itemsize}")
        settings = level[here], float(gain), int(iterations)
        compiled(data, first, pattern, tuple(table), settings, (held, bits), made, (count, codes))

    in_threads(work, range(0, pixels, size), progress)
    components, residual, restored = (x.reshape(shape) for x in made)
    plane = shape[1:]
    return FaradayClean(
        dirty=cube,
        components=components,
        residual=residual,
        restored=restored,
        iterations=count.reshape(plane),
        codes=codes.reshape(plane),
        cutoff=level.reshape(plane),
        fwhm=fwhm.reshape(plane),
        gain=float(gain),
    )


def _step(depths: Float) -> float:
    """The step of depths (N,); raises `InputError` where they are not even."""
    n = len(depths)
    step = float((depths[-1] - depths[0]) / max(1, n - 1))
    if np.abs(depths - (depths[0] + step * np.arange(n))).max() > 1e-4 * abs(step):
        raise InputError(
            "RM-CLEAN needs evenly spaced depths: give rm_synthesis an axis such as np.linspace(-50, 50, 401)"
        )
    if n > 1 and step == 0:
        raise InputError("RM-CLEAN needs depths that differ")
    return step


class _Tables:
    """R and the restoring beam at the 2N - 1 differences of depths, for every set of channels that pixels have."""

    def __init__(self, cube: FaradaySpectra, step: float, n: int, padding: int, real: Any) -> None:
        self.cube, self.real, self.use, self.padding = cube, real, cube.weights > 0, padding
        self.lambda2, self.weights = cube.lambda2[self.use], cube.weights[self.use]
        self.depths = step * np.arange(n)
        angle = 2 * np.outer(self.lambda2 - cube.lambda2_0, self.depths)
        self.waves = np.cos(angle), np.sin(angle)
        self.whole = self._made(np.ones((1, len(self.weights)), bool))

    def of(self, pixels: slice) -> tuple[Any, ...]:
        """The place of each pixel among the patterns (n,), and of every pattern FWHM, R (real, imaginary) and beam."""
        flags = self.cube.flags
        if flags is None or not flags[:, pixels].any():
            return np.zeros(pixels.stop - pixels.start, np.int64), *self.whole
        rows = np.ascontiguousarray(flags[:, pixels].T)
        _, first, pattern = np.unique(
            rows.view(np.dtype((np.void, rows.shape[1]))).ravel(), return_index=True, return_inverse=True
        )
        there = np.unpackbits(rows[first], axis=1, count=len(self.use))[:, self.use] == 0
        return pattern, *self._made(there)

    def _made(self, there: Any) -> tuple[Any, ...]:
        weights = there * self.weights
        total = weights.sum(axis=1, keepdims=True)
        widths = 2 * np.array([half_height(self.lambda2, w) for w in weights])
        half = [np.divide(weights @ wave, total, out=np.zeros((len(there), len(self.depths))), where=total > 0)
                for wave in self.waves]  # fmt: skip
        beam = np.exp(-4 * np.log(2) * np.divide.outer(self.depths, widths).T ** 2)
        # R(-phi) is the conjugate of R(phi) = C - iS
        parts = ((half[0], 1), (-half[1], -1), (beam, 1))
        full = (np.concatenate([sign * x[:, :0:-1], x], axis=1) for x, sign in parts)
        return widths, *(np.pad(x, ((0, 0), (0, self.padding))).astype(self.real) for x in full)
