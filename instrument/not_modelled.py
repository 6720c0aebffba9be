"""What the prediction of a scene does not model, with its size: smearing, beams across extended sources, no horizon."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from instrument import mat2
from instrument.jones.base import ElementBeam
from instrument.observe.directions import EARTH_RATE, LIGHT, separation, tangents
from instrument.plan import Item, count_of
from instrument.predict.base import Problem
from instrument.sky.points import points_of
from instrument.sky.rounding import flux
from instrument.sky.sources import FWHM_TO_SIGMA
from instrument.units import Float, Int, si_prefix

SHAPED = 24  # extended sources across which the beam is worked out; the effect of the others is scaled from theirs
JONES = 1.5e5  # station Jones matrices spent on it, spread over times and channels
SPOKES = 6
NEAR_ZENITH, SPREAD = np.sin(np.deg2rad(1.0)), 24  # how near a zenith, and from how many azimuths it is looked at
BESIDE = 1e-5  # rad from it: axes of stations are orthogonal to 1e-10 only, which turns azimuths at 1e-9 by 6 deg
NODES, WEIGHTS = np.polynomial.laguerre.laggauss(3)  # rings of a two-dimensional Gaussian, in r^2 / 2


def not_modelled(problem: Problem, scale_jy: float) -> list[Item]:
    """Every such item; those whose `bound` is not 0 are part of the bound of a plan, relative to `scale_jy`."""
    out = _smearing(problem)
    for name, one in problem.members().items():
        found = [*_extended(one, scale_jy), *_no_horizon(one), *_zenith(one), *_doubts(one)]
        out += [item.of(name) for item in found]
    return out


def _doubts(problem: Problem) -> list[Item]:
    """What a sky says of itself: spectra taken far, what of a file was not read, how images were made."""
    return [Item(name, text) for name, text in problem.sky.doubts(problem.at.freq_hz).items()]


def _smearing(problem: Problem) -> list[Item]:
    """Averaging within a channel and an integration."""
    far = float(np.sin(np.minimum(separation(problem.at.vectors, problem.at.centre).max(), np.pi / 2)))
    longest = problem.at.layout.longest_m
    if problem.uv_range is not None:
        longest = min(longest, problem.uv_range[1] * LIGHT / float(problem.at.freq_hz.min()))
    parts = []
    turns = EARTH_RATE * problem.interval_s * longest * float(problem.at.freq_hz.max()) / LIGHT * far
    parts.append(f"averaging over {si_prefix(problem.interval_s, 's')} would lose {_percent(1 - np.sinc(turns))}")
    if problem.width_hz:
        lost = 1 - np.sinc(problem.width_hz * longest / LIGHT * far)
        parts.append(f"over {si_prefix(problem.width_hz, 'Hz')} {_percent(lost)}")
    where = "longest baseline" if problem.uv_range is None else "longest of these baselines"
    return [Item("smearing", f"{', '.join(parts)} of the farthest source on the {where}; a prediction loses none")]


def _percent(lost: float) -> str:
    return "all" if lost >= 0.995 else f"{100 * lost:.2g} %"


def _no_horizon(problem: Problem) -> list[Item]:
    """Sources that set, or never rise, in a chain that sees through the Earth."""
    if problem.chain.blind_below_horizon:
        return []
    below = problem.at.rising.lowest < 0
    if not below.any():
        return []
    never = int((problem.at.rising.highest < 0).sum())
    first = problem.block(slice(0, 1), slice(None))
    hidden = float(flux(first.sky, first.at)[..., below].sum(axis=-1).max())
    when = f"{never} throughout" if never else "for part of the time"
    what = "cell" if problem.sky.kind == "image" else "direction"
    text = f"{count_of(int(below.sum()), what)} ({si_prefix(hidden, 'Jy')}) below it, {when}, seen in full"
    return [Item("horizon", f"no term is blind there: {text}")]


def _zenith(problem: Problem) -> list[Item]:
    """Directions that come within a degree of a zenith where an element is known to be no single field."""
    elements = [t for t in problem.chain.parts if isinstance(t, ElementBeam) and t.zenith_seam]
    near = int(((problem.at.rising.zenith < NEAR_ZENITH) & (problem.at.rising.highest > 0.5)).sum()) if elements else 0
    if not near:
        return []
    at = problem.at.block(slice(0, 1), slice(None)).one_per_frame()
    angle = 2 * np.pi * np.arange(SPREAD) / SPREAD
    local = np.stack([BESIDE * np.cos(angle), BESIDE * np.sin(angle), np.ones(SPREAD)], axis=1)
    around = replace(at.towards(np.zeros(SPREAD), np.zeros(SPREAD)), seen=(local @ at.layout.axes[0])[None])
    turn = mat2.pack(np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle))
    out = []
    for element in elements:
        ground = mat2.mul(element.jones(around)[0, :, 0], turn)
        apart = float(np.abs(ground - ground[:, :1]).max() / np.abs(ground[:, 0]).max())
        text = f"J of {element.called} there depends on the azimuth by {apart:.1e}, as its published model has it"
        out.append(Item("zenith", f"{count_of(near, 'direction')} within 1 deg of it: {text}"))
    return out


def _extended(problem: Problem, scale_jy: float) -> list[Item]:
    """The beam is taken at the centre of a Gaussian source: what it changes by across it, at the times looked at.

    |V - V'| <= integral G |J B J^H - J0 B J0^H| on every baseline, for the phases have modulus 1.
    """
    sky = points_of(problem.sky)
    if sky is None or not sky.gaussian.any() or not any(t.directional for t in problem.chain.parts):
        return []
    jansky = flux(sky, problem.at).max(axis=(0, 1))
    size = np.maximum(np.asarray(sky.major_rad), np.asarray(sky.minor_rad))
    order = np.argsort(-jansky * size, kind="stable")[: int(sky.gaussian.sum())]
    chosen, rest = order[:SHAPED], order[SHAPED:]
    change = _change(problem, chosen)
    wrong = float((change * jansky[chosen]).sum())
    if len(rest):
        wrong += float((change / size[chosen]).max() * (jansky * size)[rest].sum())
    if not wrong:
        return []
    worst = sky.names[chosen[int(np.argmax(change * jansky[chosen]))]]
    text = f"the beam is that of their centres; most matters '{worst}'"
    return [Item(count_of(len(order), "extended source"), text, wrong / scale_jy)]


def _change(problem: Problem, rows: Int) -> Float:
    """What the beam changes by across sources of 1 Jy, weighted with their shapes: the largest at some times."""
    sky = points_of(problem.sky)
    assert sky is not None
    part = sky.select(rows)
    angle = np.zeros(len(part)) if part.angle_rad is None else part.angle_rad
    east, north = tangents(part.ra_rad, part.dec_rad)
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    major = FWHM_TO_SIGMA * np.asarray(part.major_rad)[:, None] * (cos * north + sin * east)
    minor = FWHM_TO_SIGMA * np.asarray(part.minor_rad)[:, None] * (cos * east - sin * north)
    spokes = 2 * np.pi * (np.arange(SPOKES) + 0.5) / SPOKES
    ring = np.sqrt(2 * NODES)[:, None]
    x, y = (np.append(0.0, ring * f(spokes)) for f in (np.cos, np.sin))
    v = part.vectors[:, None] + x[:, None] * major[:, None] + y[:, None] * minor[:, None]  # (S, 1 + nodes, 3)
    ra, dec = np.arctan2(v[..., 1], v[..., 0]), np.arctan2(v[..., 2], np.hypot(v[..., 0], v[..., 1]))
    at = problem.at.towards(ra.ravel() % (2 * np.pi), dec.ravel())
    times, channels, stations, directions = at.shape
    slots = max(2, int(JONES / (stations * directions)))
    some = np.linspace(0, channels - 1, min(channels, 2 if slots < 6 else 3)).round().astype(int)
    chosen = np.linspace(0, times - 1, min(times, max(1, slots // len(some)))).round().astype(int)
    weight = np.repeat(WEIGHTS, SPOKES) / SPOKES
    out = np.zeros(len(part))
    for t in chosen:
        for f in some:
            jones = problem.chain.jones(at.block(slice(t, t + 1), slice(f, f + 1)))[0, 0]
            jones = np.broadcast_to(jones, (len(jones), directions, 2, 2)).reshape(len(jones), *v.shape[:2], 2, 2)
            apart = mat2.singular_values(jones - jones[:, :, :1])[0].max(axis=0)
            large = mat2.singular_values(jones)[0].max(axis=0)
            out = np.maximum(out, (apart * (large + large[:, :1]))[:, 1:] @ weight)
    return np.asarray(out)
