"""Minor cycles by radler, the deconvolution library of WSClean, in float32."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.errors import InputError
from instrument.image.minor import AT_ONCE, BIAS, Lobes, Search
from instrument.units import Float


def radler_cycle(
    residual: Float, lobes: Lobes, search: Search, floor: float, most: int, pixel_rad: float
) -> tuple[Float, int]:
    """The model of one minor cycle (K, F, N, N) down to a floor, of a residual; and how many components at most.

    One call without major cycles of its own. Raises `InputError` where radler is absent or cannot do what is asked.
    """
    try:
        import radler
    except ImportError:
        raise InputError("backend = 'radler' needs that library: pip install 'instrument[radler]'") from None
    kinds, channels = residual.shape[:2]
    if kinds > 1 or channels > 1 or not search.mask.all():
        raise InputError(
            "backend = 'radler' cleans one Stokes parameter of one channel at a time, without a mask: leave out terms "
            "and mask, and clean with peaks = 'each'; Q and U then need backend = 'own'"
        )
    settings = _settings(radler, residual.shape[-1], lobes, search, floor, most, pixel_rad)
    # single precision: scaled so that its largest is 1
    top = float(np.abs(residual).max())
    left = np.ascontiguousarray(residual[0, 0] / top, np.float32)
    model = np.zeros_like(left)
    settings.absolute_threshold = floor / top
    psf = np.ascontiguousarray(lobes.psf[0], np.float32)
    made = radler.Radler(settings, psf, left, model, pixel_rad, polarization=radler.Polarization.stokes_i)
    made.perform(0)
    return top * model.astype(float)[None, None], int(made.iteration_number)


def _settings(radler: Any, pixels: int, lobes: Lobes, search: Search, floor: float, most: int, pixel_rad: float) -> Any:
    """What is asked, as radler spells it."""
    settings = radler.Settings()
    settings.trimmed_image_width = settings.trimmed_image_height = pixels
    settings.pixel_scale.x = settings.pixel_scale.y = pixel_rad
    settings.minor_iteration_count = most
    settings.minor_loop_gain = search.gain
    settings.major_loop_gain = 1.0
    settings.allow_negative_components = search.negative
    settings.stop_on_negative_components = False
    settings.thread_count = 1
    if len(lobes.scales) > 1:
        settings.algorithm_type = radler.AlgorithmType.multiscale
        settings.multiscale.scale_list = list(lobes.scales)
        settings.multiscale.scale_bias = BIAS
        settings.multiscale.sub_minor_loop_gain = AT_ONCE
    return settings
