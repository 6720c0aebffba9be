"""The contract of Jones terms and element beams: one claim per function, its name the sentence."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from itertools import pairwise
from typing import get_args

import numpy as np

from instrument import mat2
from instrument.conformance.bench import (
    ROUNDING,
    Broken,
    cuts,
    demand,
    demand_repeatable,
    demand_same,
    hard_places,
)
from instrument.jones.base import Basis, ElementBeam, JonesTerm, PerStation, Structure
from instrument.observe.sampling import Sampling


def its_declarations_are_known_words(term: JonesTerm, at: Sampling) -> str:
    """`maps`, `structure` and `per_station` are words of the framework."""
    demand(len(term.maps) == 2 and set(term.maps) <= set(get_args(Basis)), f"maps = {term.maps}")
    demand(term.structure in get_args(Structure), f"structure = {term.structure!r}")
    demand(term.per_station in get_args(PerStation), f"per_station = {term.per_station!r}")
    return f"{term.maps[0]} to {term.maps[1]}, {term.structure}, {term.per_station}"


def its_shape_is_times_channels_stations_directions_2_2(term: JonesTerm, at: Sampling) -> str:
    """Complex (T, F, A, S, 2, 2), every axis full or of length 1."""
    found = term.jones(at)
    fits = found.ndim == 6 and all(n in (1, m) for n, m in zip(found.shape, at.shape, strict=False))
    demand(fits and found.shape[-2:] == (2, 2), f"{found.shape} for a sampling of {at.shape}")
    demand(np.iscomplexobj(found), f"it is {found.dtype}, not complex")
    return str(found.shape)


def an_axis_of_length_1_is_constant(term: JonesTerm, at: Sampling) -> str:
    """Where an axis has length 1, any one time, channel or direction gives the same, and so do other stations."""
    found = term.jones(at)
    for constant, name, where, due in cuts(found, at, (0, 1, 3)):
        if constant:
            demand_same(term.jones(where), due, f"{name} differs")
    if found.shape[2] == 1:
        turned = replace(at, layout=at.layout.select(at.layout.names[::-1]))
        demand_same(term.jones(turned), found, "stations differ")
    return ""


def a_block_equals_the_slice_of_the_whole(term: JonesTerm, at: Sampling) -> str:
    """Asking for one time, channel or direction gives what it has among the others."""
    for constant, name, where, due in cuts(term.jones(at), at, (0, 1, 3)):
        if not constant:
            demand_same(term.jones(where), due, f"{name} alone")
    return ""


def its_structure_is_true(term: JonesTerm, at: Sampling) -> str:
    """Diagonal: zero off the diagonal; scalar: also equal on it; an element that is `real`: no imaginary part."""
    j = term.jones(at)
    if term.structure != "full":
        off = max(np.abs(j[..., 0, 1]).max(), np.abs(j[..., 1, 0]).max())
        demand(off == 0, f"'{term.structure}' but {off:.1e} off the diagonal")
    if term.structure == "scalar":
        demand_same(j[..., 0, 0], j[..., 1, 1], "'scalar' but unequal on the diagonal")
    if isinstance(term, ElementBeam) and term.real:
        demand(not j.imag.any(), f"'real' but its imaginary part is {np.abs(j.imag).max():.1e}")
    return term.structure


def its_per_station_is_true(term: JonesTerm, at: Sampling) -> str:
    """Shared: the same for all stations; frame: for those of equal axes, and one of each is enough to ask."""
    j = np.broadcast_to(term.jones(at), (*at.shape, 2, 2))
    if term.per_station == "shared":
        demand_same(j, j[:, :, :1], "'shared' but stations differ")
    if term.per_station == "frame":
        first, group = at.layout.frames
        demand_same(j, j[:, :, first][:, :, group], "'frame' but stations of equal axes differ")
        demand_same(term.jones(at.one_per_frame()), j[:, :, first], "one station of each frame")
    return term.per_station


def a_term_that_is_not_directional_has_one_direction(term: JonesTerm, at: Sampling) -> str:
    """`directional = False`: the axis of directions has length 1."""
    if term.directional:
        return "directional"
    count = term.jones(at).shape[3]
    demand(count == 1, f"directional = False but it gives {count} directions")
    return "not directional"


def blindness_below_the_horizon_is_exact(term: JonesTerm, at: Sampling) -> str:
    """`blind_below_horizon`: exactly zero below the antenna plane of each station."""
    if not term.blind_below_horizon:
        return "not claimed"
    hard = hard_places(at)
    # 1e-12 rad: whether the plane itself is above or below is a matter of rounding
    below = np.broadcast_to((hard.zenith_angle > np.pi / 2 + 1e-12)[:, None], hard.shape)
    leak = np.abs(np.broadcast_to(term.jones(hard), (*hard.shape, 2, 2))[below]).max(initial=0.0)
    demand(leak == 0, f"{leak:.1e} below the antenna plane")
    return f"{below.sum()} matrices"


def it_is_finite_at_zenith_horizon_nadir_and_pole(term: JonesTerm, at: Sampling) -> str:
    """Finite in every direction, the singular points of its coordinates included."""
    for where in (at, hard_places(at)):
        bad = ~np.isfinite(np.broadcast_to(term.jones(where), (*where.shape, 2, 2))).all(axis=(-2, -1))
        if bad.any():
            t, _, a, s = np.argwhere(bad)[0]
            angle, dec = np.rad2deg(where.zenith_angle[t, a, s]), np.rad2deg(where.dec_rad[s])
            raise Broken(f"not finite at zenith angle {angle:.6g} deg, declination {dec:.6g} deg")
    return ""


def a_call_has_no_side_effects(term: JonesTerm, at: Sampling) -> str:
    """The same call twice gives the same, and nothing that was given has changed."""
    return demand_repeatable(
        lambda: term.jones(at), term, at, at.itrf, at.local, at.zenith_angle, at.azimuth_cos_sin, at.lmn, at.vectors
    )


def its_parts_multiply_to_its_jones(term: JonesTerm, at: Sampling) -> str:
    """`parts()`: their product, receiver to sky, is the term, and their bases meet."""
    parts = term.parts()
    demand(parts, "it has no part")
    meet = all(left.maps[0] == right.maps[1] for left, right in pairwise(parts))
    ends = (parts[-1].maps[0], parts[0].maps[1])
    demand(meet and ends == term.maps, f"the bases of the parts give {ends}, the term {term.maps}")
    product = reduce(mat2.mul, (part.jones(at) for part in parts))
    return demand_same(product, term.jones(at), "the product of the parts")


def its_scalar_agrees_with_its_jones(term: JonesTerm, at: Sampling) -> str:
    """A scalar term: `scalar` times the identity is `jones`."""
    if term.structure != "scalar":
        return "not scalar"
    return demand_same(term.scalar(at)[..., None, None] * mat2.IDENTITY, term.jones(at), "scalar times the identity")


def what_simplify_leaves_keeps_its_bound(term: JonesTerm, at: Sampling) -> str:
    """`simplify` at tolerance 0 is exact; at any other its error is below its bound, and that below the tolerance."""
    exact = term.jones(at)
    scale = np.abs(exact).max()
    for tolerance in (0.0, 1e-6, 1e-2):
        left, reason, bound = term.simplify(at, tolerance)
        demand(0 <= bound <= tolerance, f"bound {bound} at tolerance {tolerance:g}")
        demand(left is not None or reason, "left out without a reason")
        error = float(np.abs((mat2.IDENTITY if left is None else left.jones(at)) - exact).max())
        demand(error <= (bound + ROUNDING) * scale, f"error {error:.1e} above the bound {bound:.1e} of {scale:.1e}")
    return ""


CLAIMS = (
    its_declarations_are_known_words,
    its_shape_is_times_channels_stations_directions_2_2,
    an_axis_of_length_1_is_constant,
    a_block_equals_the_slice_of_the_whole,
    its_structure_is_true,
    its_per_station_is_true,
    a_term_that_is_not_directional_has_one_direction,
    blindness_below_the_horizon_is_exact,
    it_is_finite_at_zenith_horizon_nadir_and_pole,
    a_call_has_no_side_effects,
    its_parts_multiply_to_its_jones,
    its_scalar_agrees_with_its_jones,
    what_simplify_leaves_keeps_its_bound,
)
