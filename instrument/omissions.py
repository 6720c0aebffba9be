"""What a plan leaves out of a scene: terms, Stokes parameters, directions and baselines, each with its bound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from instrument.errors import InputError
from instrument.jones.chain import Chain
from instrument.observe.directions import LIGHT
from instrument.observe.sampling import Sampling
from instrument.plan import Item, count_of
from instrument.predict.base import Problem
from instrument.predict.rounding import known_gain, total_flux
from instrument.sky.base import PlacedSky, power
from instrument.sky.pixels import PixelSky
from instrument.sky.points import PointSky, points_of
from instrument.sky.sums import SumSky
from instrument.units import Bool, Float

KINDS = ("I", "Q", "U", "V")
WORTH = 0.01  # of all sources: fewer faint ones save nothing and are no error worth having


class Budget:
    """What a tolerance leaves for omissions after rounding; each is offered a part and takes what it needs."""

    def __init__(self, tolerance: float, rounded: float) -> None:
        self.left = max(0.0, tolerance - rounded)

    def take(self, bound: float) -> None:
        """Spend a bound."""
        self.left = max(0.0, self.left - bound)


def simplify_chain(chain: Chain, at: Sampling, budget: Budget, kept: list[Item], left_out: list[Item]) -> Chain:
    """The chain that a scene needs, by what each term says of itself; spends of the budget."""
    gain = known_gain(chain, at)
    # n terms each wrong by d of their peak change J B J^H by (1 + d)^2n - 1 of its own: half of what is left
    share = 0.5 * budget.left / gain if gain else 0.0
    smaller, fates = chain.simplified(at, float(np.expm1(np.log1p(share) / (2 * max(len(chain.terms), 1)))))
    grown = 1.0
    for term, fate in fates:
        name = type(term).__name__
        bound = gain * grown * fate.bound * (2 + fate.bound)
        grown *= (1 + fate.bound) ** 2
        budget.take(bound)
        if fate.term is None:
            left_out.append(Item(name, fate.reason, bound))
        else:
            shared = ", ".join(p.sharing(at) for p in reversed(fate.term.parts()))
            kept.append(Item(name, fate.reason or shared, bound))
    if not smaller.parts:
        left_out.append(Item("2x2 algebra", "the chain is the identity"))
    elif smaller.structure != "full":
        left_out.append(Item("2x2 algebra", f"the chain is {smaller.structure}"))
    return smaller


def simplify_sky(full: Problem, chain: Chain, budget: Budget, left_out: list[Item]) -> Problem:
    """Drop directions that give exactly nothing, and with a tolerance the faintest, by flux times the peak of |J|^2."""
    if full.sky.kind == "sum":
        return _each_member(full, chain, budget, left_out)
    problem, sky = replace(full, chain=chain), points_of(full.sky)
    if sky is not None:
        return _fewer(problem, sky, budget, left_out)
    there = full.sky.nonzero(full.at.freq_hz)
    if not any(there):
        raise InputError(f"the sky ({full.sky.size}) has no flux at all")
    if isinstance(full.sky, PixelSky) and (dark := len(full.sky.grid) - full.sky.count):
        left_out.append(Item(count_of(dark, "pixel"), "no flux"))
    if not all(there):
        zero = ", ".join(kind for kind, has in zip(KINDS, there, strict=True) if not has)
        left_out.append(Item(f"{zero} of the sky", "zero in every direction"))
    return problem


def _each_member(full: Problem, chain: Chain, budget: Budget, left_out: list[Item]) -> Problem:
    """A sum of skies without members that give nothing, and of the others what each needs; bounds are of all flux.

    What is left out of a member is within the budget of its own flux: a faint one is as whole as a bright one.
    """
    total, members = total_flux(full) or 1.0, full.members()
    shares = {name: total_flux(one) / total for name, one in members.items()}
    each = budget.left / max(1.0, sum(shares.values()))
    kept: dict[str, PlacedSky] = {}
    for name, one in members.items():
        share, said, own = shares[name], list[Item](), Budget(each, 0.0)
        try:
            kept[name] = simplify_sky(one, chain, own, said).sky
        except InputError:
            left_out.append(Item(name, "no flux, or never above the antenna planes"))
            continue
        budget.take(share * (each - own.left))
        left_out += [item._replace(bound=item.bound * share).of(name) for item in said]
    if not kept:
        raise InputError("nothing of the sky is ever above the antenna planes, or it has no flux at all")
    return replace(full, chain=chain).of(SumSky(skies=kept))


def _fewer(full: Problem, sky: PointSky, budget: Budget, left_out: list[Item]) -> Problem:
    """A list without the sources that are below the horizon or have no flux, nor, with a tolerance, the faintest."""
    chain = full.chain
    stokes = sky.stokes(full.at.freq_hz)
    use = np.any(stokes != 0, axis=(0, 2))
    if not use.all():
        left_out.append(Item(count_of(int((~use).sum()), "direction"), "no flux"))
    if chain.blind_below_horizon:
        risen = full.at.rising.highest > -1e-9  # on the safe side: a direction at the very edge is kept
        if np.any(use & ~risen):
            below = count_of(int((use & ~risen).sum()), "direction")
            left_out.append(Item(below, "below the antenna planes throughout"))
        use &= risen
    zero = [k for k, there in zip(KINDS, np.any(stokes != 0, axis=(0, 1)), strict=True) if not there]
    if zero:
        left_out.append(Item(f"{', '.join(zero)} of the sky", "zero in every direction"))
    if not use.any():
        raise InputError("nothing of the sky is ever above the antenna planes, or it has no flux at all")
    if budget.left > 0:
        faint, bound = _faint(stokes, use, chain.peak(full.at), 0.5 * budget.left)
        if faint.sum() >= WORTH * use.sum():
            budget.take(bound)
            left_out.append(Item(count_of(int(faint.sum()), "faint direction"), "flux times the peak of |J|^2", bound))
            use &= ~faint
    if use.all():
        return replace(full, chain=chain)
    kept = np.flatnonzero(use)
    return replace(full, chain=chain, sky=sky.select(kept), at=full.at.of(kept))


def _faint(stokes: Float, use: Bool, peak: float, tolerance: float) -> tuple[Bool, float]:
    """The faintest sources whose sum stays below a tolerance, and that sum."""
    flux = power(stokes)
    share = peak * (peak * flux / flux.sum(axis=1).max()).max(axis=0)
    faint = np.zeros(len(use), bool)
    if not np.isfinite(peak):
        return faint, 0.0
    order = np.argsort(np.where(use, share, np.inf), kind="stable")[: int(use.sum()) - 1]
    dropped = order[np.cumsum(share[order]) <= tolerance]
    faint[dropped] = True
    return faint, float(share[dropped].sum())


def within(problem: Problem, uv_range: tuple[float, float] | None, left_out: list[Item]) -> Problem:
    """Drop baselines that never come within the uv range (wavelengths) that the products ask for."""
    if uv_range is None:
        return problem
    at = problem.at
    low, high = (r * LIGHT / f for r, f in zip(uv_range, (at.freq_hz.max(), at.freq_hz.min()), strict=True))
    use = np.zeros(len(problem.antenna1), bool)
    for t in range(0, at.shape[0], 64):
        uv = at.block(slice(t, t + 64), slice(None)).uvw_m[..., :2]
        length = np.linalg.norm(uv[:, problem.antenna1] - uv[:, problem.antenna2], axis=-1)
        use |= np.any((length >= low) & (length <= high), axis=0)
    problem = replace(problem, uv_range=uv_range)
    if use.all():
        return problem
    if not use.any():
        raise InputError(f"no baseline ever lies within uv_range = {list(uv_range)} wavelengths")
    text = f"never within {uv_range[0]:g} to {uv_range[1]:g} wavelengths"
    left_out.append(Item(count_of(int((~use).sum()), "baseline"), text))
    return problem.between(problem.antenna1[use], problem.antenna2[use])


def w_term(problem: Problem) -> Item:
    """The w-term is always kept: it costs nothing here; what leaving it out would do is said."""
    low = float(problem.at.lmn[:, 2].min())
    turns = problem.at.layout.longest_m * float(problem.at.freq_hz.max()) / LIGHT * abs(low)
    return Item("w-term", f"without it phases could be wrong by {turns:.2g} turns")
