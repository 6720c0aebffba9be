"""Is a fit right? Judged baseline by baseline, since the rms of all is that of the strongest.

Noise leaves the same on every baseline, but for what the unknowns take of it; a model that is wrong in general leaves
the same share of each. What is left over on a baseline is held against both, each as the better baselines have it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from instrument.calibrate.gauge import UNKNOWNS
from instrument.units import Bool, Float, Int

FAR = 100.0  # of the power that noise leaves: 800 for a chi^2 of 8 degrees of freedom
HALF = 0.25  # of its own power left over: a baseline that is not explained at all
WORTH = 1e-4  # of its own power: less is not worth a word (1 % in amplitude)
LEAVES = 0.01  # of the rms of the data: noise, or a model that lacks something
PULL = 0.003  # relative change of a station's matrix for which one baseline answers
BETTER = 0.25  # quantile of the baselines that the others are held against
FREE = 0.3  # share of a baseline's noise that the unknowns must leave to measure it there


@dataclass(frozen=True)
class Left:
    """Power left over by a fit, of the data and of the fitted model, (L, B) each, and samples that count (L, B)."""

    rest: Float
    data: Float
    fit: Float
    samples: Int

    def __getitem__(self, lanes: Any) -> Left:
        return Left(self.rest[lanes], self.data[lanes], self.fit[lanes], self.samples[lanes])

    @cached_property
    def share(self) -> Float:
        """Rms left over, relative to that of the data (L,)."""
        return _root(self.rest.sum(axis=1), self.data.sum(axis=1))

    @cached_property
    def usual(self) -> Float:
        """The same without the few strongest baselines (L,): interference, or two stations, may be all that fits."""
        few = min(max(1, self.data.shape[1] // 50), self.data.shape[1] - 1)
        strongest = np.argpartition(self.data, -1 - few, axis=1)[:, self.data.shape[1] - few :]
        rest, data = self.rest.copy(), self.data.copy()
        for x in (rest, data):  # not the difference of two sums: one may be 1e20 times the other
            np.put_along_axis(x, strongest, 0.0, axis=1)
        return _root(rest.sum(axis=1), data.sum(axis=1))

    @cached_property
    def typical(self) -> Float:
        """Median over the baselines of what is left over of each, relative to it (L,)."""
        use = (self.samples > 0) & (self.data > 0)
        return np.sqrt(_quantile(np.where(use, self.rest / np.where(use, self.data, 1.0), np.nan), 0.5))

    @cached_property
    def top(self) -> float:
        """The largest share of its power that is left of any baseline: where that is little, nothing else is asked."""
        return float(np.max(self.rest / np.where(self.data > 0, self.data, np.inf), initial=0.0))

    @cached_property
    def worst(self) -> Float:
        """The largest of the three (L,)."""
        if self.top <= 0.01 * WORTH:
            return self.share
        return np.fmax(np.fmax(self.share, self.usual), self.typical)

    @property
    def uneven(self) -> Bool:
        """Whether all but the strongest baselines may have been forgotten (L,)."""
        return (self.worst > LEAVES) & (self.worst > 30 * self.share)

    def poor(self, unexplained: float) -> Bool:
        """Whether most of the data stay unexplained (L,), or most of all but the few strongest baselines."""
        return ~(self.share <= unexplained) | self.few_fit(unexplained)

    def few_fit(self, unexplained: float) -> Bool:
        """Whether all that fits are the few strongest baselines (L,)."""
        if self.top <= unexplained**2:
            return np.zeros(len(self.rest), bool)
        return (self.usual > unexplained) & (self.usual > 1.5 * self.share)


def strange(left: Left, a1: Int, a2: Int, stations: int, tolerance: float, pattern: str, sets: int = 1) -> Bool:
    """Baselines (L, B) that a fit is wrong about though it stands still; whole stations with all of their baselines.

    `sets` of matrices a station were solved for.
    """
    if left.top <= 0.01 * WORTH:
        return np.zeros(left.rest.shape, bool)
    use = (left.samples > 0) & (left.data > 0)
    # what a solve to this tolerance leaves is not noise
    small = left.rest <= min(100 * tolerance, 1e-3) ** 2 * left.data
    rest = np.where(use & ~small, left.rest, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        each = np.where(use, rest / left.samples, np.nan)
    out = np.zeros(use.shape, bool)
    # most fits end here: no baseline has much more left over than others
    look = np.flatnonzero(np.nanmax(each, axis=1, initial=0.0) > FAR * _quantile(each, BETTER))
    if len(look):
        out[look] = _looked(left[look], rest[look], use[look], a1, a2, stations, pattern, sets)
    return out


def _looked(left: Left, rest: Float, use: Bool, a1: Int, a2: Int, stations: int, pattern: str, sets: int) -> Bool:
    free = 1 - sets * taken(left.fit, a1, a2, stations, pattern) / np.maximum(left.samples, 1)
    measures = use & (free > FREE)
    with np.errstate(invalid="ignore", divide="ignore"):
        each = np.where(measures, rest / left.samples / free, np.nan)
        share = np.where(measures, rest / free / left.data, np.nan)
    enough = measures.sum(axis=1) >= np.maximum(3, 0.2 * use.sum(axis=1))
    noise = np.where(enough, _quantile(each, BETTER), np.inf)[:, None] * np.maximum(left.samples, 1)
    wide = np.where(enough, _quantile(share, BETTER), np.inf)[:, None] * np.where(use, left.data, 1.0)
    off = use & (rest > FAR * noise)  # more than noise leaves
    odd = off & (rest > FAR * (noise + wide)) & (rest > WORTH * left.data)
    pull = np.sqrt(rest * left.fit)
    per = np.zeros((len(use), stations, stations, 3))
    for one, other in ((a1, a2), (a2, a1)):
        per[:, one, other] = np.stack([np.where(use, left.fit, 0.0), np.where(odd, pull, 0.0), odd], axis=-1)
    size = np.where(per[..., 0] > 0, per[..., 0], np.nan)
    count = np.isfinite(size).sum(axis=2)
    typical = count * _quantile(size, 0.5)
    pulled = per[..., 1].sum(axis=2) > PULL * np.where(typical > 0, typical, np.inf)
    alone = (per[..., 2].sum(axis=2) > 0.5 * count) & (count > 0)  # stations that are odd on most of their baselines
    hit = pulled | alone
    return (off & (rest > HALF * left.data)) | (odd & (hit[:, a1] | hit[:, a2]))


def doubts(converged: Bool, left: Float, spoilt: Mapping[str, int]) -> tuple[str, ...]:
    """What a reader of solutions (t, f) should know: how much is left over, and which visibilities stand out."""
    out = []
    much = converged & (left > LEAVES)
    if much.any():
        out.append(
            f"{much.sum()} of {converged.sum()} solutions leave more than 1 % of a typical baseline once corrected "
            f"({100 * np.median(np.broadcast_to(left, much.shape)[much]):.2g} %): noise, or what the model lacks"
        )
    if spoilt:
        names = sorted(spoilt, key=lambda name: -spoilt[name])
        more = f" and {len(names) - 5} more" if len(names) > 5 else ""
        listed = ", ".join(f"{name} ({spoilt[name]})" for name in names[:5])
        out.append(
            f"visibilities of {listed}{more} stand out and spoil fits: flag them (solution.suspects) and solve again"
        )
    return tuple(out)


def taken(fit: Float, a1: Int, a2: Int, stations: int, pattern: str) -> Float:
    """Samples' worth of noise that the unknowns take from each baseline (L, B), by the power of its fit.

    In an unpolarized model all Hermitian parts of J_a^-1 dJ_a count alike, and all others; they add and subtract in a
    baseline: x^T (D + W)^-1 x and x^T (D - W)^+ x for the two stations of it, times its power W_ab.
    """
    w = np.zeros((len(fit), stations, stations))
    w[:, a1, a2] = fit
    w = w + np.swapaxes(w, 1, 2)
    total = w.sum(axis=2)
    root = np.sqrt(np.where(total > 0, total, 1.0))
    scaled = w / root[:, :, None] / root[:, None, :]
    eye = np.eye(stations)
    parts = []
    for sign in (1.0, -1.0):
        values, vectors = np.linalg.eigh(eye + sign * scaled)
        inverse = np.where(values > 1e-9, 1 / np.maximum(values, 1e-9), 0.0)
        p = (vectors * inverse[:, None, :]) @ np.swapaxes(vectors, 1, 2) / root[:, :, None] / root[:, None, :]
        diagonal = np.einsum("laa->la", p)
        parts.append(fit * (diagonal[:, a1] + diagonal[:, a2] + sign * 2 * p[:, a1, a2]))
    plus, minus = (np.clip(x, 0.0, 1.0) for x in parts)
    return np.asarray(UNKNOWNS[pattern] / 8 * (minus if pattern == "phase" else (plus + minus) / 2))


def _root(above: Float, below: Float) -> Float:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.sqrt(above / below)


def _quantile(values: Float, share: float) -> Float:
    """Quantile of what is finite along the last axis; zero where nothing is."""
    order = np.sort(values, axis=-1)  # NaN come last
    count = np.isfinite(values).sum(axis=-1)
    place = np.clip((share * count).astype(int), 0, np.maximum(count - 1, 0))
    return np.where(count > 0, np.take_along_axis(order, place[..., None], axis=-1)[..., 0], 0.0)
