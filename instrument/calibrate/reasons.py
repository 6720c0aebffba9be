"""Why an interval has no solution: what its data and its models lack, in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from instrument.calibrate.cluster_equations import unit_diagonal
from instrument.calibrate.gauge import UNKNOWNS
from instrument.calibrate.graph import counted, tied
from instrument.units import Bool, Complex, Float, Int

ENOUGH = 50  # iterations after which a fit that leaves most of the data will leave them for good
ONE_RECEPTOR = 1e-6  # of the power at a station: what a model shows of its other polarization
FAINT = 0.3  # standard error of a gain, relative to itself, beyond which it is noise
HARDLY = 1e-6  # of the power at a typical station
ALIKE = 1e-4  # least eigenvalue of what models show the whole array: with less, noise mixes the matrices of clusters
NEAR = 0.1  # the same of two models that differ by half of themselves: with few data that may be too little


@dataclass(frozen=True)
class Asked:
    """What is solved for: baselines between which stations (A names), the pattern, and clusters by name."""

    a1: Int
    a2: Int
    stations: Sequence[str]
    pattern: str
    clusters: Sequence[str] = ("",)

    def reason(self, data: Complex, models: Complex, weight: Float, dead: Any = None) -> str:
        """What data (N, B, 2, 2) of weight (N, B), and models (C, N, B, 2, 2), do not tell; "" where nothing is known.

        Stations `dead` (A,) have no solution anyway.
        """
        weight = weight / np.max(weight, initial=1e-300)
        use = (weight > 0) & np.isfinite(models).all(axis=(0, -2, -1))
        if dead is not None:
            use = use & ~(dead[self.a1] | dead[self.a2])
        if not use.any():
            return "no data count: flagged, of weight zero, or left out"
        if not np.any(data[use]):
            return "the data are zero"
        size = max(float(np.abs(models[:, use]).max()), 1e-300)
        root = np.sqrt(np.where(use, weight, 0.0))[..., None, None]
        models = np.asarray(np.where(root > 0, models, 0.0) / size * root, complex)
        power = np.asarray((np.abs(models) ** 2).sum(axis=1))
        for name, each in zip(self.clusters, power, strict=True):
            if found := self._of_baselines(each):
                return found.format(_model(name))
        numbers, unknowns = 8 * int(use.sum()), UNKNOWNS[self.pattern] * len(models) * self._seen(power).sum()
        if numbers < unknowns:
            return f"{numbers} numbers do not give {unknowns} unknowns: longer intervals, or fewer clusters"
        return self._of_receptors(self._moments(models))

    def _seen(self, power: Float) -> Bool:
        """Stations (A,) that a model is seen by, of its power (..., B, 2, 2)."""
        out = np.zeros(len(self.stations), bool)
        here = power.reshape(-1, len(self.a1), 4).sum(axis=(0, 2)) > 0
        out[self.a1[here]] = out[self.a2[here]] = True
        return out

    def _of_baselines(self, power: Float) -> str:
        """What the baselines of a model of some power (B, 2, 2) leave open; {} stands for the model."""
        if not power.any():
            return "{} is zero wherever data count"
        used, stations = counted(power[None]), len(self.stations)
        seen = self._seen(np.where(used[0], power, 0.0))
        if not np.any(seen & ~tied(used, self.a1, self.a2, stations, self.pattern)[0]):
            return ""
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import connected_components

        on = used[0].any(axis=(-2, -1))
        links = csr_array((np.ones(on.sum()), (self.a1[on], self.a2[on])), shape=(stations, stations))
        sizes = np.sort(np.bincount(connected_components(links)[1][seen]))[::-1]
        sizes = sizes[sizes > 0]
        if len(sizes) > 1:
            return (
                "the baselines where {} is seen leave the stations in pieces of "
                f"{', '.join(str(n) for n in sizes[:5])}{' ...' if len(sizes) > 5 else ''}: baselines between them, or "
                "each piece by itself"
            )
        return (
            "the baselines where {} is seen join two groups of stations with none inside a group, or a tree: they "
            "leave amplitudes open"
        )

    def _moments(self, models: Complex) -> Complex:
        """What the models show to each station, sum_b Z Z^H (A, 2C, 2C) for other stations of unit matrices."""
        clusters, _, baselines = models.shape[:3]
        out = np.zeros((len(self.stations), 2 * clusters, 2 * clusters), complex)
        for end, m in ((self.a1, models), (self.a2, np.conj(np.swapaxes(models, -1, -2)))):
            z = m.transpose(2, 0, 3, 1, 4).reshape(baselines, 2 * clusters, -1)
            np.add.at(out, end, z @ np.conj(np.swapaxes(z, 1, 2)))
        return out

    def _of_receptors(self, moments: Complex) -> str:
        """Which stations see one polarization only, or next to nothing; and which clusters are alike."""
        for c, name in enumerate(self.clusters):
            own = moments[:, 2 * c : 2 * c + 2, 2 * c : 2 * c + 2]
            values = np.linalg.eigvalsh(own) if self.pattern == "full" else np.sort(np.einsum("aii->ai", own).real)
            here = values[:, 1] > 0
            half = here & (values[:, 0] <= ONE_RECEPTOR * values[:, 1])
            if half.any() and self.pattern != "scalar":
                return (
                    f"{_model(name)} shows one polarization only at {self._listed(half, here)}: it is wholly "
                    "polarized, or in the null of a beam (pattern 'scalar' asks for less)"
                )
            faint = here & (values[:, 1] < HARDLY * np.median(values[here, 1]))
            if faint.any():
                return f"{_model(name)} is hardly seen at {self._listed(faint, here)}: in the null of a beam; flag them"
        values, vectors = np.linalg.eigh(unit_diagonal(moments.sum(axis=0))[0])
        shares = (np.abs(vectors[:, 0]) ** 2).reshape(-1, 2).sum(axis=1)
        both = [f"'{self.clusters[k]}'" for k in np.argsort(-shares) if shares[k] > 0.1]
        if len(both) < 2 and values[0] < ALIKE and self.pattern == "full":
            name = self.clusters[int(np.argmax(shares))]
            return f"{_model(name)} shows hardly more than one polarization: it is polarized to nearly 100 %"
        if len(both) < 2 or values[0] > NEAR:
            return ""
        apart = 100 * np.sqrt(2 * max(float(values[0]), 0.0))
        return f"the models of {' and '.join(both[:2])} differ by {apart:.2g} % of themselves: join them"

    def _listed(self, which: Bool, of: Bool) -> str:
        if which.sum() == of.sum():
            return "all stations"
        return _few([self.stations[int(k)] for k in np.flatnonzero(which)])


def told(reasons: Iterable[str]) -> tuple[str, ...]:
    """Sentences of the reasons of intervals, with how many there are of each."""
    found = Counter(text for text in reasons if text)
    return tuple(f"no solution of {n} interval{'s' * (n > 1)}: {text}" for text, n in found.most_common())


def noisy(jones: Complex, error: Float, pattern: str) -> Float:
    """Standard errors (t, f, A) of gains by those (t, f, A, 2, 2) of elements, relative to matrices; 0 if unknown.

    1/2 where there is nothing but noise: the matrix is then as large as its error.
    """
    known = np.isfinite(error).all(axis=(-2, -1)) & np.isfinite(jones).all(axis=(-2, -1))
    share = 1.0 if pattern == "full" else 0.5  # of the elements are unknown
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        found = np.sqrt(np.mean(error**2, axis=(-2, -1)) / share / (np.sum(np.abs(jones) ** 2, axis=(-2, -1)) / 2))
    return np.where(known & np.isfinite(found), found, 0.0)


def faint(size: Float, converged: Bool, stations: Sequence[str], what: str) -> tuple[str, ...]:
    """Sentences where the matrices of some stations, or all of them, are noise, by their relative errors (t, f, A)."""
    out, noise = [], size > FAINT
    some = noise & (2 * noise.sum(axis=-1, keepdims=True) <= (size > 0).sum(axis=-1, keepdims=True))
    if some.any():
        counts = some.sum(axis=(0, 1))
        names = [stations[int(k)] for k in np.argsort(-counts, kind="stable")[: np.count_nonzero(counts)]]
        out.append(
            f"gains of {_few(names)} are noise (standard error {np.median(size[some]):.2g} of themselves) in "
            f"{some.any(axis=-1).sum()} of {converged.sum()} solutions: {what} is hardly seen "
            "there, flag them, or make intervals longer"
        )
    joined = ", or join it to another cluster" * (what == "the cluster")
    rest = np.where(some, 0.0, size)
    rms = np.sqrt((rest**2).sum(axis=-1) / np.maximum((rest > 0).sum(axis=-1), 1))
    if np.any(rms > FAINT):
        out.append(
            f"{(rms > FAINT).sum()} of {converged.sum()} solutions are noise (standard error "
            f"{np.median(rms[rms > FAINT]):.2g} of the gains): {what} is too faint for these intervals (make them "
            f"longer{joined}), or its polarization leaves elements open"
        )
    return tuple(out)


def unknown(error: Float, converged: Bool) -> tuple[str, ...]:
    """A sentence where errors (t, f, A, 2, 2) of a solution are not known, because of its size."""
    lost = int((converged & ~np.isfinite(error).any(axis=(-3, -2, -1))).sum())
    return (f"errors of gains, and weak directions, of {lost} solutions are not known: too many unknowns",) * bool(lost)


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def _model(name: str) -> str:
    return f"the model of '{name}'" if name else "the model"
