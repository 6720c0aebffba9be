"""Delay spectra: power straight from visibilities, of each baseline along frequency, in K² Mpc³; no image between."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from instrument.analyze.power.bins import Frame, Plane
from instrument.analyze.power.cells import Cells
from instrument.analyze.power.fourier import (
    Stokes,
    Taper,
    check_redshift,
    check_stokes,
    comoving,
    line_of_sight,
    taper_of,
)
from instrument.analyze.power.modes import independent
from instrument.analyze.power.transform import delays
from instrument.errors import InputError, warn
from instrument.observe.directions import LIGHT
from instrument.sky.made import jy_per_k
from instrument.units import Bool, Complex, Float, Int, one_si
from instrument.visibilities import Visibilities, VisibilitySet
from instrument.visibility_sets import as_set

EVEN = 1e-6  # of a channel: what steps between channels may differ by


@dataclass(frozen=True)
class Delay:
    """How visibilities are brought to delays; see `Analyzer.delay_spectrum`."""

    solid_angle: Any
    stokes: Stokes = "I"
    taper: Taper | None = "blackman-harris"
    across_times: bool = False
    redshift: float | None = None
    cosmology: Any = None


@dataclass(frozen=True, eq=False)
class DelayModes:
    """How many independent values a bin has: integrations and baselines all, delays as a taper (N,) leaves them."""

    along: Float

    def cylindrical(self, cells: Plane, perp: Float, bounds: Int, rows: Int, bins_par: int) -> Float:
        """Modes (P, L) of bins of k_perp, which begin at `bounds` among the cells, and of delays, by their bins."""
        n = len(self.along)
        signed = np.zeros((bins_par, n), bool)
        for m, row in enumerate(rows):
            if row >= 0:
                signed[row, [m % n, -m % n]] = True
        parts = [np.flatnonzero(has) for has in signed]
        line = independent(
            np.ones((1, 1)), self.along, [(0 * d, 0 * d, d, np.ones(len(d))) for d in parts],
            signed.sum(axis=1).astype(float), lambda b, _v, _u, d: signed[b, d % n],
        )  # fmt: skip
        return np.multiply.outer(cells.sums(bounds, np.ones(len(cells.k_perp))), line)

    def spherical(self, cells: Plane, edges: Float, bounds: Int, slope: float, least: float) -> Float:
        """Modes (N,) of bins of k, as if each bin held long rows of delays."""
        power = np.abs(np.fft.fft(self.along**2)) ** 2
        upto = np.append(0.0, np.cumsum(cells.times))
        each = [fold * np.diff(upto[cut]) for fold, cut in zip(cells.folds, bounds, strict=True)]
        return np.asarray(np.sum(each, axis=0) * power[0] / power.sum())


def delay_cells(given: VisibilitySet | Iterable[Visibilities], how: Delay) -> Cells:
    """Power of every baseline, integration and delay; see `Analyzer.delay_spectrum`.

    P = (c² / 2 k nu²)² D² Y / (Omega B) |sum_nu w V dnu exp(-2 pi i nu tau)|², D the transverse distance, Y the depth
    of a Hz, Omega the integral of the beam squared, B = sum w² dnu (Parsons et al. 2012, ApJ 756, 165).
    """
    check_stokes(how.stokes)
    omega = one_si(how.solid_angle, "sr", "solid_angle", above=0)
    parts: list[tuple[Float, list[Complex]]] = []
    freq: Float | None = None
    before: tuple[Any, ...] = ()  # the last integration of the block before
    counted = np.zeros(2, int)  # of integrations of baselines: all, and those that are not whole
    for block in _whole_bands(given):
        freq = _even(block.freq_hz) if freq is None else freq
        if not np.array_equal(freq, block.freq_hz):
            raise InputError("the blocks have other channels than one another: a delay spectrum needs all of a band")
        values, seen = _stokes(block, how.stokes)
        length = np.hypot(block.uvw_m[..., 0], block.uvw_m[..., 1]) * (freq[0] + freq[-1]) / 2 / LIGHT
        counted += [seen.size, int((~seen).sum())]
        kelvin = values / jy_per_k(freq, 1.0)[:, None]
        pairs = [kelvin]
        if how.across_times:
            now = length, seen, kelvin
            length, seen, kelvin = (np.concatenate(x) for x in zip(before, now, strict=True)) if before else now
            before = length[-1:], seen[-1:], kelvin[-1:]
            seen, length = seen[1:] & seen[:-1], (length[1:] + length[:-1]) / 2
            pairs = [kelvin[:-1], kelvin[1:]]
        parts.append((length[seen], [np.moveaxis(x, 1, 2)[seen].T for x in pairs]))
    if freq is None or not any(len(k) for k, _ in parts):
        when = "at one time and the next" if how.across_times else "at one time"
        raise InputError(
            f"no baseline is there in all channels {when}: fill in or leave out channels that are flagged everywhere"
        )
    if counted[1]:
        share = 100 * counted[1] / counted[0]
        warn(f"{share:.2g} % of the integrations of baselines are not there in all channels: left out")
    length = np.concatenate([k for k, _ in parts])
    spectra = [np.concatenate([x[j] for _, x in parts], axis=1) for j in range(len(parts[0][1]))]
    return _cells(length, spectra, freq, omega, how, int(counted[1]))


def _cells(length: Float, spectra: list[Complex], freq: Float, omega: float, how: Delay, lost: int) -> Cells:
    n, step, middle = len(freq), float(freq[1] - freq[0]), float((freq[0] + freq[-1]) / 2)
    redshift = check_redshift(how.redshift, float(freq[0]), float(freq[-1]))
    z, distance = comoving(middle, redshift, how.cosmology)
    depth = line_of_sight(z, how.cosmology)
    order = np.argsort(length, kind="stable")
    along = taper_of(n, how.taper)
    folds = np.where(np.isin(np.arange(n // 2 + 1), [0] if n % 2 else [0, n // 2]), 1.0, 2.0)
    scale = distance**2 * depth * step / (omega * n * float((along**2).mean()))
    power, auto = delays([x[:, order] for x in spectra], along, folds, scale)
    frame = Frame(
        "K", how.stokes, middle, z, distance, depth, how.taper, None, None, 0.0, 0,
        False,
    )  # fmt: skip
    k_par = 2 * np.pi / (n * step * depth) * np.arange(len(folds), dtype=float)
    k_perp, place = 2 * np.pi * length[order] / distance, np.arange(len(order))
    left_out = {"integrations of baselines without all channels": lost * n}
    return Cells(
        frame, k_perp, k_par, power, auto, np.ones(len(order)), folds, place, 0 * place, DelayModes(along), left_out
    )


def _stokes(block: Visibilities, stokes: str) -> tuple[Complex, Bool]:
    """A Stokes parameter (T, F, B), Jy, and which integrations of baselines (T, B) have it in all channels."""
    which = [1, 2] if stokes == "P" else ["IQUV".index(stokes)]
    all_four = block.stokes()
    values = all_four[..., 1] + 1j * all_four[..., 2] if stokes == "P" else all_four[..., which[0]]
    weight = block.stokes_weight
    weight = np.broadcast_to(weight, (*values.shape, weight.shape[-1]))
    seen = (weight[..., which if weight.shape[-1] > 1 else [0]] > 0).all(axis=(1, 3))
    return values, np.asarray(seen)


def _even(freq_hz: Float) -> Float:
    if len(freq_hz) < 2:
        raise InputError("one channel has no delays: a delay spectrum needs a band")
    steps = np.diff(freq_hz)
    if steps.min() <= 0 or np.ptp(steps) > EVEN * steps.mean() + 1e-3:
        raise InputError(f"channels are not evenly spaced ({steps.min():g} to {steps.max():g} Hz): take a part that is")
    return freq_hz


def _whole_bands(given: VisibilitySet | Iterable[Visibilities]) -> Iterator[Visibilities]:
    """Blocks of all channels: those that follow each other at the same times become one."""
    waiting: list[Visibilities] = []
    for block in as_set(given).blocks():
        if waiting and not np.array_equal(waiting[0].at.slots_s, block.at.slots_s):
            yield _joined(waiting)
            waiting = []
        waiting.append(block)
    if waiting:
        yield _joined(waiting)


def _joined(parts: list[Visibilities]) -> Visibilities:
    """Blocks of the same times beside each other, in order of frequency."""
    if len(parts) == 1:
        return parts[0]
    parts = sorted(parts, key=lambda block: float(block.freq_hz[0]))
    freq = np.concatenate([p.freq_hz for p in parts])
    weights = [np.broadcast_to(p.effective_weight, p.data.shape[: p.effective_weight.ndim]) for p in parts]
    most = max(w.ndim for w in weights)
    wide = [np.broadcast_to(w if w.ndim == most else w[..., None, None], p.data.shape[:most])
            for w, p in zip(weights, parts, strict=True)]  # fmt: skip
    weight = np.concatenate(wide, axis=1)
    return replace(
        parts[0], data=np.concatenate([p.data for p in parts], axis=1), at=replace(parts[0].at, freq_hz=freq),
        weight=weight, flag=weight == 0, width_hz=None,
    )  # fmt: skip
