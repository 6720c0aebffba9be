"""Minor cycles by radler, the deconvolution library of WSClean, in float32."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import Any

import numpy as np

from instrument.errors import InputError
from instrument.image.minor import AT_ONCE, BIAS, Lobes, Search
from instrument.units import Float

ALONE, PAIR, ALL = 1, 2, 4  # how many Stokes parameters it takes at once


def radler_cycle(
    residual: Float, lobes: Lobes, search: Search, floor: float, most: int, pixel_rad: float
) -> tuple[Float, int]:
    """The model of one minor cycle (K, F, N, N) down to a floor, of a residual, and how many components it has.

    One call without major cycles of its own. Raises `InputError` where radler is absent or cannot do what is asked.
    """
    try:
        import radler
    except ImportError:
        raise InputError("backend = 'radler' needs that library: pip install 'instrument[radler]'") from None
    kinds, channels, pixels = residual.shape[:3]
    if not search.mask.all():
        raise InputError("backend = 'radler' takes no mask: leave it out, or take backend = 'own'")
    if channels > 1 or kinds not in (ALONE, PAIR, ALL):
        raise InputError(
            "backend = 'radler' cleans one channel at a time, in I, in V, in Q and U or in all four: leave out terms, "
            "or take backend = 'own'"
        )
    settings = _settings(radler, lobes, search, most, pixel_rad)
    settings.trimmed_image_width = settings.trimmed_image_height = pixels
    # single precision: scaled so that its largest is 1. Its height of two Stokes parameters is 1 / sqrt 2 of theirs
    top = float(np.abs(residual).max())
    settings.absolute_threshold = floor / top / (np.sqrt(2) if kinds == PAIR else 1.0)
    left = np.ascontiguousarray(residual[:, 0] / top, np.float32)
    model, psf = np.zeros_like(left), np.ascontiguousarray(lobes.psf[0], np.float32)
    names = {ALONE: "i", PAIR: "qu", ALL: "iquv"}[kinds]
    each = [getattr(radler.Polarization, f"stokes_{name}") for name in names]
    if kinds > 1 and not search.share[1:].any():
        settings.linked_polarizations = {each[0]}
    table = radler.WorkTable(np.zeros((0, 2), np.uint64), 1, 1)
    for k, polarization in enumerate(each):
        entry = radler.WorkTableEntry()
        entry.index, entry.polarization, entry.image_weight = k, polarization, 1.0
        entry.residual, entry.model = left[k], model[k]
        if k == 0:
            entry.psfs.append(psf)
        table.add_entry(entry)
    made = radler.Radler(settings, table, pixel_rad)
    with _silent():
        made.perform(0)
    return top * model.astype(float)[:, None], int(made.iteration_number)


def _settings(radler: Any, lobes: Lobes, search: Search, most: int, pixel_rad: float) -> Any:
    """What is asked, as radler spells it."""
    settings = radler.Settings()
    settings.pixel_scale.x = settings.pixel_scale.y = pixel_rad
    settings.minor_iteration_count = most
    settings.minor_loop_gain = search.gain
    settings.major_loop_gain = 1.0
    settings.squared_joins = len(search.share) > 1
    settings.allow_negative_components = search.negative
    settings.thread_count = 1
    if len(lobes.scales) > 1:
        settings.algorithm_type = radler.AlgorithmType.multiscale
        settings.multiscale.scale_list = list(lobes.scales)
        settings.multiscale.scale_bias = BIAS
        settings.multiscale.sub_minor_loop_gain = AT_ONCE
    return settings


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Without what the library writes to the terminal from C++."""
    kept = os.dup(1)
    try:
        with open(os.devnull, "w") as nothing:
            os.dup2(nothing.fileno(), 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
