"""Contests of Faraday synthesis, against the sum in extended precision, and of RM-CLEAN, against what was put in."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from instrument.analyze.analyzer import Analyzer
from instrument.analyze.faraday.clean import FaradayClean
from instrument.analyze.faraday.cube import FaradayCube
from instrument.image.cube import StokesCube
from instrument.precision.contest import RIGHT, WRONG, Contest, Entry, Form, Trial
from instrument.precision.cube_peers import FARADAY, clean_peers, synthesis_peers
from instrument.precision.truth import LIGHT, cis, real
from instrument.units import Complex, Float

SIDES = (48, 8, 256)  # pixels along a side: of the quick form, and of the full one
SIDES_CLEAN = (8, 2, 16)
FREQ = 134e6 + 0.2e6 * np.arange(161)
DEPTHS = np.linspace(-50, 50, 401)
# what Analyzer.rm_synthesis promises, of the largest |F|
PRECISIONS = {4e-7: "single", 1e-12: "double"}
SPECTRA = 48  # of which the truth is worked out
CUTOFFS = tuple(10.0 ** (-k / 4) for k in range(2, 21))
GAINS = (0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
LIMITS = (10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)
GAIN, CUTOFF, MOST = 0.1, 1e-3, 100_000
NEAR = 1.1  # rad/m², half a FWHM: components that belong to a source


def synthesis(form: Form) -> list[Contest]:
    """One a size: three thin sources and noise in every pixel, 161 channels, 401 depths, float32."""
    return [_synthesis(side, form) for side in (SIDES[:1] if form.quick else sorted(SIDES))]


def _synthesis(side: int, form: Form) -> Contest:
    cube = _cube(_sources(side, 3)[2], noise=0.3)
    spots = np.unique(np.linspace(0, side * side - 1, SPECTRA).astype(int))
    data = np.asarray(cube.data).reshape(len(FREQ), 4, -1)[:, 1:3, spots]
    due = _plain_sum(data[:, 0] + 1j * data[:, 1].astype(np.complex128))
    scale = float(np.abs(due).max())
    peak = _peaks(due)

    def judge(found: Complex, asked: float) -> Trial:
        got = found.reshape(len(DEPTHS), -1)[:, spots]
        off = np.abs(_peaks(got) - peak)
        return Trial(float(np.abs(got - due).max()) / scale, float(np.sqrt(np.mean(off**2))), user_max=float(off.max()))

    analyzer = Analyzer(cube)
    entries = [Entry("instrument", lambda asked: analyzer.rm_synthesis(DEPTHS, precision=_word(asked)).data)]
    if form.peers:
        entries += synthesis_peers(cube, DEPTHS)
    return Contest(
        name=f"rm-synthesis of {side} x {side} pixels",
        kind="rm-synthesis",
        knob="accuracy",
        values=tuple(PRECISIONS),
        entries=tuple(entries),
        judge=judge,
        error=f"largest error of F of {len(spots)} spectra, over the largest |F|",
        error_user="error of the depth of the brightest peak, rms, rad/m2",
        truth="the sum over channels in extended precision",
        honoured=True,
        family="rm-synthesis",
        size=side,
        size_word="pixels a side",
        peers=FARADAY,
    )


def _word(asked: float) -> Any:
    return PRECISIONS[asked]


def clean(form: Form) -> list[Contest]:
    """One a size: two thin sources 8 to 40 rad/m2 apart in every pixel, on steps of the axis, without noise."""
    return [_clean(side, form) for side in (SIDES_CLEAN[:1] if form.quick else sorted(SIDES_CLEAN))]


def _clean(side: int, form: Form) -> Contest:
    depth, put, p = _sources(side, 2)
    cube = _cube(p, kind=float)
    dirty = Analyzer(cube).rm_synthesis(DEPTHS)
    truth = put * np.exp(2j * depth * dirty.lambda2_0)

    def judge(found: Any, asked: float) -> Trial:
        components, ended = found
        near = np.abs(DEPTHS[:, None, None, None] - depth) <= NEAR
        got = (components[:, None] * near).sum(axis=0)
        apart = np.abs(got - truth)
        lost = 1 - np.abs(got[0]) / np.abs(truth[0])
        scale = float(np.sqrt(np.mean(np.abs(truth) ** 2)))
        return Trial(
            float(np.sqrt(np.mean(apart**2))) / scale, abs(float(lost.mean())), ended, float(np.abs(lost).max())
        )

    quick = form.quick
    entries = [
        Entry("instrument (cutoff)", _cleaned(dirty, "cutoff")),
        Entry("instrument (gain)", _cleaned(dirty, "gain"), GAINS[::3] if quick else GAINS),
        Entry("instrument (iterations)", _cleaned(dirty, "iterations"), LIMITS[::2] if quick else LIMITS),
    ]
    if form.peers:
        entries += clean_peers(dirty, GAIN)
    return Contest(
        name=f"rm-clean of {side} x {side} pixels",
        kind="rm-clean",
        knob="own setting",
        values=CUTOFFS[2::4] if quick else CUTOFFS,
        entries=tuple(entries),
        judge=judge,
        error=f"rms error of the components within {NEAR} rad/m2 of a source, over the rms of the sources",
        error_user="bias of the polarized intensity of the first source, of itself",
        truth="the two sources put in",
        family="rm-clean",
        size=side,
        size_word="pixels a side",
        peers=FARADAY,
    )


def _cleaned(dirty: FaradayCube, knob: str) -> Callable[[float], Any]:
    """Components (N, Ny, Nx), and how it ended, of one setting with the others as they are."""

    def answer(asked: float) -> Any:
        settings: dict[str, Any] = {"cutoff": CUTOFF, "gain": GAIN, "iterations": MOST}
        settings[knob] = int(asked) if knob == "iterations" else asked
        if knob == "iterations":
            settings["cutoff"] = 0.0
        found = dirty.clean(**settings)
        return found.components, _ended(found)

    return answer


def _ended(found: FaradayClean[Any]) -> str:
    """How most spectra ended; wrong where a spectrum that converged leaves more than the cutoff of what it is of."""
    if not found.converged.all():
        return str(found.outcome[~found.converged][0].name)
    middle = tuple(n // 2 for n in found.iterations.shape)
    dirty, parts = found.dirty, found.components[(slice(None), *middle)]
    left = dirty.data[(slice(None), *middle)].astype(complex)
    for k in np.flatnonzero(parts):
        left -= parts[k] * dirty.rmsf_at(DEPTHS - DEPTHS[k])
    return WRONG if np.abs(left).max() > found.cutoff[middle] + 1e-9 * np.abs(dirty.data).max() else RIGHT


def _sources(side: int, count: int) -> tuple[Float, Complex, Complex]:
    """Depths and complex amplitudes (count, side, side) of thin sources, and their P (F, side, side)."""
    rng, shape = np.random.default_rng(196), (side, side)
    lambda2 = (299792458 / FREQ) ** 2
    if count == 2:  # apart by more than the side lobes reach
        step = DEPTHS[1] - DEPTHS[0]
        first = rng.uniform(-30, 0, shape)
        depth = step * np.round(np.stack([first, first + rng.uniform(8, 40, shape)]) / step)
    else:
        depth = rng.uniform(-20, 20, (count, *shape))
    put = rng.uniform(0.1, 1, depth.shape) * np.exp(2j * rng.uniform(0, np.pi, depth.shape))
    p = np.zeros((len(FREQ), *shape), complex)
    for source, at in zip(put, depth, strict=True):
        p += source * np.exp(2j * np.multiply.outer(lambda2, at))
    return depth, put, p


def _cube(p: Complex, noise: float = 0.0, kind: Any = np.float32) -> StokesCube:
    """P (F, Ny, Nx), and noise, as a cube in K."""
    from astropy import units as u

    data = np.zeros((len(p), 4, *p.shape[1:]), kind)
    data[:, 1], data[:, 2] = p.real, p.imag
    if noise:
        data[:, 1:3] += np.random.default_rng(1).normal(scale=noise, size=data[:, 1:3].shape)
    return StokesCube(data, FREQ * u.Hz, 0.5 * u.arcmin, "K")


def _plain_sum(p: Complex) -> Complex:
    """F (N, S) of spectra P (F, S): the mean over channels of P exp(-2i phi (lambda2 - their mean))."""
    lambda2 = (LIGHT / real(FREQ)) ** 2
    off = lambda2 - lambda2.mean()
    pi = np.longdouble("3.14159265358979323846264338327950288")
    out = np.empty((len(DEPTHS), p.shape[1]), complex)
    wide = p.astype(np.clongdouble)
    for k, phi in enumerate(real(DEPTHS)):
        out[k] = (cis(-phi * off / pi)[:, None] * wide).sum(axis=0) / len(lambda2)
    return out


def _peaks(f: Complex) -> Float:
    """Depth of the brightest peak of spectra (N, S), between the steps by a parabola, rad/m² (S,)."""
    size = np.abs(f).astype(float)
    k = np.clip(size.argmax(axis=0), 1, len(size) - 2)
    low, top, high = (size[k + d, np.arange(size.shape[1])] for d in (-1, 0, 1))
    return np.asarray(DEPTHS[k] + (DEPTHS[1] - DEPTHS[0]) * (low - high) / (2 * (low - 2 * top + high)))
