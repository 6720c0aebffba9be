"""Cells: the Fourier cells of a cube, and their spectra in bins of k_perp and k_par, or of k."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from instrument.analyze.power.bins import Frame, Plane
from instrument.analyze.power.cylinders import Cylindrical, Spherical, bounds_of, divided, length, rows_of
from instrument.analyze.power.fourier import bin_edges, per_mpc, sine
from instrument.errors import InputError
from instrument.units import FINITE, Float, Int


class ModeCount(Protocol):
    """How many independent modes bins have; see `Modes`."""

    def cylindrical(self, cells: Plane, perp: Float, bounds: Int, rows: Int, bins_par: int) -> Float:
        """Modes of bins of k_perp and k_par."""

    def spherical(self, cells: Plane, edges: Float, bounds: Int, slope: float, least: float) -> Float:
        """Modes of bins of k."""


@dataclass(frozen=True, eq=False)
class Cells(Plane):
    """Cells with what makes them alike, from which spectra are made."""

    modes: ModeCount  # which cells are alike: behind a taper, or of both signs
    left_out: dict[str, int]

    def cylindrical(
        self, bins: Any = 15, bins_par: Any = None, log: bool = True, paper_axis: bool = False
    ) -> Cylindrical:
        """Spectrum in bins of k_perp and k_par; see `Analyzer.cylindrical`."""
        return cylindrical(self, bins, bins_par, log, paper_axis)

    def spherical(self, bins: Any = 15, log: bool = True, wedge: Any = None, k_par_min: Any = None) -> Spherical:
        """Spectrum in bins of k; see `Analyzer.spherical`."""
        return spherical(self, bins, log, wedge, k_par_min)


def cylindrical(
    cells: Cells, bins: Any = 15, bins_par: Any = None, log: bool = True, paper_axis: bool = False
) -> Cylindrical:
    """Cells in bins of k_perp and k_par; see `Analyzer.cylindrical`."""
    if paper_axis:
        cells = _mirrored(cells)
    perp = _edges(cells.k_perp, bins, log, cells.frame)
    if bins_par is None:
        # every delay is a bin: edges half-way between
        step = cells.k_par[1]
        par = step * (np.arange(len(cells.k_par) + (not log)) + (0.5 if log else -0.5))
    else:
        par = _edges(cells.k_par, bins_par, log)
    bounds, rows = bounds_of(cells.k_perp, perp), rows_of(cells.k_par, par)
    shape = len(perp) - 1, len(par) - 1
    weight, sums, both = (np.zeros(shape) for _ in range(3))
    each = cells.sums(bounds, np.ones(len(cells.k_perp)))
    for row, fold, power, auto in zip(rows, cells.folds, cells.power, cells.auto, strict=True):
        if row >= 0:
            weight[:, row] += fold * each
            found = cells.sums(bounds, power)
            sums[:, row] += fold * found
            both[:, row] += fold * (found if cells.auto is cells.power else cells.sums(bounds, auto))
    count = weight.round().astype(int)
    power = divided(sums, count)
    folds = np.bincount(rows[rows >= 0], cells.folds[rows >= 0], shape[1])
    k_par = np.bincount(rows[rows >= 0], (cells.folds * cells.k_par)[rows >= 0], shape[1])
    plane, alone = cells.times.sum(), 0.0 if bounds[0] == 0 else cells.times[cells.k_perp <= 0].sum()
    flat = 0.0 if rows[0] >= 0 else cells.folds[0] * (plane - alone)
    left_out = dict(cells.left_out) | {"k_perp = 0": round(alone * cells.folds.sum()), "k_par = 0": round(flat)}
    left_out["outside all bins"] = round(plane * cells.folds.sum() - alone * cells.folds.sum() - flat - weight.sum())
    return Cylindrical(
        divided(cells.sums(bounds, cells.k_perp), each),
        divided(k_par, folds),
        power,
        _sigma(power, divided(both, count), cells.modes.cylindrical(cells, perp, bounds, rows, shape[1])),
        count,
        perp,
        par,
        cells.frame,
        left_out,
        cells,
    )


def spherical(cells: Cells, bins: Any = 15, log: bool = True, wedge: Any = None, k_par_min: Any = None) -> Spherical:
    """Cells in bins of k, those of the wedge or of small k_par left out where asked; see `Analyzer.spherical`."""
    slope = cells.frame.horizon_slope * sine(wedge)
    least = FINITE.check(float(per_mpc(0.0 if k_par_min is None else k_par_min, "k_par_min")), "k_par_min")
    if not 0 <= least < cells.k_par[-1]:
        raise InputError(f"k_par_min = {k_par_min} is not within 0 to {cells.k_par[-1]:.3g} /Mpc")
    # of every delay, the cells (u, v) that are above the wedge: the first so many
    ends = np.where(cells.k_par < least, 0, np.searchsorted(cells.k_perp * slope, cells.k_par, "right"))
    first = cells.k_perp[: np.searchsorted(cells.k_perp, 0.0, "right") + 1]
    k = length(first, cells.k_par[ends > 0][:, None])
    lowest = float(k[k > 0].min(initial=np.inf))
    highest = float(length(cells.k_perp[-1], cells.k_par[-1]))
    edges = bin_edges(lowest, highest, bins, log)
    shape = len(edges) - 1
    weight, sums, both, k_sum = (np.zeros(shape) for _ in range(4))
    bounds = np.zeros((len(cells.k_par), shape + 1), int)
    upto = np.append(0.0, np.cumsum(cells.times))  # whole numbers: differences are exact
    in_wedge = 0.0
    for m, (k_par, fold, end) in enumerate(zip(cells.k_par, cells.folds, ends, strict=True)):
        k = length(cells.k_perp, k_par)
        cut = bounds_of(k, edges)
        if k_par == 0 and edges[0] == 0:
            cut = np.maximum(cut, np.searchsorted(k, 0.0, "right"))  # k = 0 is the mean
        bounds[m] = cut = np.minimum(cut, end)
        weight += fold * np.diff(upto[cut])
        k_sum += fold * cells.sums(cut, k)
        found = cells.sums(cut, cells.power[m])
        sums += fold * found
        both += fold * (found if cells.auto is cells.power else cells.sums(cut, cells.auto[m]))
        in_wedge += fold * (upto[-1] - upto[end])
    count = weight.round().astype(int)
    power = divided(sums, count)
    left_out = dict(cells.left_out)
    if wedge is not None or k_par_min is not None:
        left_out["in the wedge, or below k_par_min"] = round(in_wedge)
    left_out["k = 0, or outside all bins"] = round(cells.folds.sum() * upto[-1] - in_wedge - weight.sum())
    sigma = _sigma(power, divided(both, count), cells.modes.spherical(cells, edges, bounds, slope, least))
    return Spherical(divided(k_sum, count), power, sigma, count, edges, cells.frame, left_out, cells, bounds)


def _edges(k: Float, bins: Any, log: bool, frame: Frame | None = None) -> Float:
    """Edges over the range of k, or of the cut of baselines; from the first k above 0 in log bins."""
    above = k[k > 0]
    if not above.size:
        raise InputError("an image of one pixel has no k_perp above 0: there is nothing to bin")
    low, high = float(above.min()) if log else float(k.min()), float(k.max())
    if frame is not None and frame.uv_range is not None:
        per_mpc = 2 * np.pi / frame.distance_mpc
        low = frame.uv_range[0] * per_mpc if frame.uv_range[0] > 0 else low
        high = frame.uv_range[1] * per_mpc if np.isfinite(frame.uv_range[1]) else high
    return bin_edges(low, high, bins, log)


def _sigma(power: Float, auto: Float, modes: Float) -> Float:
    """Scatter of a Gaussian field: power over the root of the modes; across two cubes, from all three powers."""
    size = power if auto is power else np.sqrt((power**2 + auto**2) / 2)
    return divided(size, np.sqrt(modes))


def _mirrored(cells: Cells) -> Cells:
    """Delays up to 1/dnu as printed in the paper: what is beyond Nyquist, 1/(2 dnu), is its mirror image."""
    m = len(cells.k_par)
    n = round(float(cells.folds.sum()))
    back = np.arange(n)
    back = np.minimum(back, n - back)
    assert back.max() == m - 1
    auto = cells.auto[back] if cells.auto is not cells.power else None
    power = cells.power[back]
    return replace(
        cells,
        k_par=cells.k_par[1] * np.arange(n),
        power=power,
        auto=power if auto is None else auto,
        folds=np.ones(n),
    )
