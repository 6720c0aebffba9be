"""Averages of visibilities over times and channels: weighted means, weights that add up, coordinates between them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from instrument import correlations
from instrument.errors import InputError
from instrument.observe.directions import EarthFrame, earth_frame
from instrument.observe.intervals import intervals
from instrument.observe.sampling import Sampling, times_of
from instrument.units import Complex, Float, Int


def averaged(vis: Any, time_s: float | None, channels: int) -> dict[str, Any]:
    """What of visibilities (T, F, B, 2, 2) changes when integrations of `time_s`, and so many channels, become one.

    Means have the effective weights, which add up; what has no weight at all is zero and flagged. Each new integration
    and channel is as long and wide as what went into it, and stands at the mean time and frequency of that.
    """
    rows, columns = _times(vis, time_s), _channels(vis, channels)
    data, weight = _means(vis.data, vis.effective_weight, rows, columns)
    uvw, at = vis.given_uvw_m, _at(vis, rows, columns)
    return {
        "data": data,
        "weight": _shortened(weight),
        "flag": _shortened(weight == 0),
        "at": at,
        "interval_s": _sums(_each(vis.interval_s, len(vis.at.slots_s)), rows),
        "width_hz": None if vis.width_hz is None else _sums(_each(vis.width_hz, len(vis.freq_hz)), columns),
        "given_uvw_m": None if uvw is None else _between(uvw, vis.at.slots_s, at.slots_s),
    }


def _times(vis: Any, time_s: float | None) -> Int:
    """Where each group of integrations begins, by their times: a gap ends no group early and fills none."""
    slots, one = vis.at.slots_s, vis.integration_s
    if time_s is None:
        return np.arange(len(slots))
    if np.any(np.diff(slots) <= 0):
        raise InputError("averaging needs times in ascending order")
    count = time_s / one
    if abs(count - round(count)) > 1e-3 or round(count) < 1:
        few, more = (max(1.0, float(f(count))) * one for f in (np.floor, np.ceil))
        give = f"{few:.10g} s" if few == more else f"{few:.10g} s or {more:.10g} s"
        raise InputError(f"time = {time_s:g} s is {count:.4g} integrations of {one:g} s: give {give}")
    group = intervals(slots, time_s, one).group
    return np.searchsorted(group, np.arange(group[-1] + 1))


def _channels(vis: Any, channels: int) -> Int:
    """Where each group of channels begins; the last may have fewer."""
    if channels > len(vis.freq_hz):
        raise InputError(f"channels = {channels} of one average, but the data have {len(vis.freq_hz)}")
    if channels > 1 and np.any(np.diff(vis.freq_hz) <= 0):
        raise InputError("averaging needs channels in ascending order")
    return np.arange(0, len(vis.freq_hz), channels)


def _means(data: Complex, weight: Float, rows: Int, columns: Int) -> tuple[Complex, Float]:
    """Weighted means (T', F', B, 2, 2), and sums of the weights."""
    total = np.add.reduceat(np.add.reduceat(weight, rows, axis=0), columns, axis=1)
    counts = (np.diff([*begins, n]) for begins, n in zip((rows, columns), data.shape, strict=False))
    back = total
    for axis, count in enumerate(counts):
        back = np.repeat(back, count, axis=axis)
    share = correlations.alike(data, weight / np.where(back > 0, back, 1.0))[1]  # of 1: no weight leaves float64
    parts = np.where(share > 0, data, 0.0) * share
    return np.add.reduceat(np.add.reduceat(parts, rows, axis=0), columns, axis=1), total


def _at(vis: Any, rows: Int, columns: Int) -> Sampling:
    """Where the means are: the mean times and frequencies, the Earth of these times."""
    at = vis.at
    slots = _centres(at.slots_s, _each(vis.interval_s, len(at.slots_s)), rows)
    widths = _each(1.0 if vis.width_hz is None else vis.width_hz, len(at.freq_hz))
    alone = np.diff([*rows, len(at.slots_s)]) == 1
    earth = at.earth[rows]
    if not alone.all():
        made = earth_frame(times_of(slots), at.layout.centre_m)
        parts = ((made.matrices, earth.matrices), (made.velocity, earth.velocity))
        earth = EarthFrame(*(np.where(alone.reshape(-1, *[1] * (a.ndim - 1)), b, a) for a, b in parts))
    moved = {}
    for name in ("seen", "seen_east", "seen_centre"):
        if (given := getattr(at, name)) is not None:
            found = _between(given, at.slots_s, slots)
            moved[name] = found / np.linalg.norm(found, axis=-1, keepdims=True)
    if at.own_uvw_m is not None:
        moved["own_uvw_m"] = _between(at.own_uvw_m, at.slots_s, slots)
    return replace(at, earth=earth, slots_s=slots, freq_hz=_centres(at.freq_hz, widths, columns), **moved)


def _each(given: Any, count: int) -> Float:
    """One number for each of `count`."""
    return np.broadcast_to(np.asarray(given, float).reshape(-1), count)


def _sums(values: Float, begins: Int) -> Float:
    return np.add.reduceat(values, begins)


def _centres(values: Float, lengths: Float, begins: Int) -> Float:
    """Means of each group, with lengths as weights; of one alone, its bits."""
    first = values[begins]
    ahead = values - np.repeat(first, np.diff([*begins, len(values)]))  # 5e9 s of MJD would leave 1 microsecond
    return first + _sums(ahead * lengths, begins) / _sums(lengths, begins)


def _between(values: Float, known: Float, asked: Float) -> Float:
    """Values (T, ...) at other times, by the cubic through the four nearest: they turn with the Earth.

    10 min apart that leaves 2e-8 of a baseline; 10 s apart, as rounding.
    """
    out = np.empty((len(asked), *values.shape[1:]))
    for k, t in enumerate(asked):
        near = np.argsort(np.abs(known - t), kind="stable")[:4]
        apart = known[near] - t
        weights = [np.prod([-b / (a - b) for j, b in enumerate(apart) if j != i]) for i, a in enumerate(apart)]
        out[k] = np.tensordot(np.array(weights), values[near], axes=1)
    return out


def _shortened(array: Any) -> Any:
    """The same with length 1 along every axis along which it is constant."""
    for axis in range(array.ndim):
        first = array.take([0], axis=axis)
        if np.array_equal(np.broadcast_to(first, array.shape), array):
            array = first
    return array
