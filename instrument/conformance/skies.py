"""The claims about skies: fixed directions about a centre, a Hermitian brightness, an envelope within 0 and 1."""

from __future__ import annotations

import numpy as np

from instrument import mat2
from instrument.conformance.bench import ROUNDING, cuts, demand, demand_repeatable, demand_same
from instrument.jones.mueller import stokes
from instrument.observe.sampling import Sampling
from instrument.sky.base import PlacedSky, Sky, power


def about_a_phase_centre_its_directions_are_fixed(sky: Sky, at: Sampling) -> str:
    """`about` changes nothing on the sky, gives the same twice, and what it gives needs no placing any more."""
    before = sky.to_json()
    placed = sky.about(at.centre)
    demand(sky.to_json() == before, "about changes the sky")
    demand(sky.about(at.centre) == placed, "a second about gives another sky")
    demand(placed.about(at.centre) == placed, "what about gives is not placed")
    ra, dec = placed.directions()
    demand(ra.ndim == 1 and ra.shape == dec.shape and ra.size, f"directions of shapes {ra.shape} and {dec.shape}")
    demand(np.all(np.isfinite(ra)) and np.all(np.abs(dec) <= np.pi / 2 + 1e-12), "directions off the sphere")
    return f"{len(ra)} directions"


def its_brightness_is_times_channels_directions_2_2(sky: PlacedSky, at: Sampling) -> str:
    """Complex (T, F, S, 2, 2), every axis full or of length 1, finite."""
    found = sky.brightness(at)
    due = (at.shape[0], at.shape[1], at.shape[3])
    fits = found.ndim == 5 and all(n in (1, m) for n, m in zip(found.shape, due, strict=False))
    demand(fits and found.shape[-2:] == (2, 2), f"{found.shape} for a sampling of {at.shape}")
    demand(np.all(np.isfinite(found)), "not finite")
    return str(found.shape)


def its_brightness_is_hermitian(sky: PlacedSky, at: Sampling) -> str:
    """[[I+Q, U+iV], [U-iV, I-Q]] with real I, Q, U, V."""
    found = sky.brightness(at)
    return demand_same(found, mat2.herm(found), "brightness and its conjugate transpose")


def a_block_of_its_brightness_equals_the_slice_of_the_whole(sky: PlacedSky, at: Sampling) -> str:
    """Asking for one time or channel gives what it has among the others, and an axis of length 1 is constant."""
    for _, name, where, due in cuts(sky.brightness(at), at, (0, 1)):
        demand_same(sky.brightness(where), due, f"{name} alone")
    return ""


def its_envelope_takes_nothing_off_a_baseline_of_zero(sky: PlacedSky, at: Sampling) -> str:
    """`None`, or real (T, F, B, S) within 0 and 1, and 1 where u = v = w = 0."""
    uvw = np.random.default_rng(0).uniform(-3e3, 3e3, (*at.shape[:2], 4, 3))
    uvw[:, :, 0] = 0.0
    found = sky.envelope(at, uvw)
    if found is None:
        return "points only"
    due = (*uvw.shape[:3], at.shape[3])
    demand(found.ndim == 4 and all(n in (1, m) for n, m in zip(found.shape, due, strict=True)), f"{found.shape}")
    demand(np.isrealobj(found) and np.all((found >= 0) & (found <= 1)), "not a number between 0 and 1")
    return demand_same(found[:, :, 0], np.ones(1), "envelope at u = v = w = 0")


def its_total_is_that_of_its_brightness(sky: PlacedSky, at: Sampling) -> str:
    """`total_jy`: |I| + P of all directions at the brightest time, to which errors are relative; at least that."""
    due = power(np.asarray(stokes(sky.brightness(at)).real)).sum(axis=-1).max(axis=0)
    found = sky.total_jy(at.freq_hz)
    demand(found.shape == at.freq_hz.shape, f"shape {found.shape}, due {at.freq_hz.shape}")
    demand(
        np.all(found >= due * (1 - ROUNDING)), f"total {found.tolist()} Jy, its brightness adds up to {due.tolist()}"
    )
    return f"{found.max():.3g} Jy"


def stokes_parameters_that_it_says_are_zero_are_zero(sky: PlacedSky, at: Sampling) -> str:
    """`nonzero`: may say that one is there that is not, never the other way round."""
    said = sky.nonzero(at.freq_hz)
    there = np.any(np.abs(stokes(sky.brightness(at))) > 0, axis=(0, 1, 2))
    demand(len(said) == 4 and not np.any(there & ~np.array(said)), f"it says {said}, there are {there.tolist()}")
    return ", ".join(k for k, has in zip("IQUV", said, strict=True) if has)


def its_parts_are_the_whole(sky: PlacedSky, at: Sampling) -> str:
    """`parts`: pieces for sums in bounded memory, whose brightness adds up to that of the whole."""
    pieces = list(sky.parts(3, at.freq_hz))
    counts = [p.count for p in pieces]
    demand(len(pieces) == 1 or max(counts) <= 3, f"pieces of {counts} directions where 3 were asked for")
    total = sum(p.brightness(at.towards(*p.directions())).sum(axis=2) for p in pieces)
    # of the flux: the sum of fluctuations is nothing but rounding
    off = np.abs(total - sky.brightness(at).sum(axis=2)).max() / sky.total_jy(at.freq_hz).max()
    demand(off <= ROUNDING, f"the sum of its parts and of the whole are {off:.1e} of the flux apart")
    return f"apart by {off:.0e}"


def a_call_of_its_brightness_has_no_side_effects(sky: PlacedSky, at: Sampling) -> str:
    """The same call twice gives the same, and nothing that was given has changed."""
    return demand_repeatable(lambda: sky.brightness(at), sky, at)


CLAIMS = (
    its_brightness_is_times_channels_directions_2_2,
    its_brightness_is_hermitian,
    a_block_of_its_brightness_equals_the_slice_of_the_whole,
    its_envelope_takes_nothing_off_a_baseline_of_zero,
    its_total_is_that_of_its_brightness,
    stokes_parameters_that_it_says_are_zero_are_zero,
    its_parts_are_the_whole,
    a_call_of_its_brightness_has_no_side_effects,
)
