"""What is doubtful about a list of sources at some frequencies: fluxes that turn negative, spectra taken far."""

from __future__ import annotations

import numpy as np

from instrument.errors import InputError
from instrument.files_in import harmless
from instrument.sky.sources import Sources
from instrument.units import Float

FAR = 1.5  # a spectrum is a fit over a band: beyond this factor of its frequency it is a guess


def doubts(sky: Sources, freq_hz: Float) -> dict[str, str]:
    """A thing and what is doubtful about it, {} for nothing; raises `InputError` where a flux is not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        stokes = sky.stokes(freq_hz)
    bad = ~np.isfinite(stokes).all(axis=2)
    if bad.any():
        f, s = np.argwhere(bad)[0]
        raise InputError(
            f"source '{harmless(sky.names[s], 60)}' has no finite flux at {freq_hz[f] / 1e6:g} MHz by its spectrum; "
            "correct the spectrum, or leave the source out"
        )
    found = [*_negative(sky, stokes[..., 0], freq_hz), *_far(sky, freq_hz)]
    out = {"spectra": "; ".join(found)} if found else {}
    return out | ({"not read": "; ".join(sky.not_read)} if sky.not_read else {})


def _negative(sky: Sources, intensity: Float, freq_hz: Float) -> list[str]:
    """Sources whose I is positive where it was measured and negative at a frequency asked for."""
    turned = np.where(sky.stokes_jy[:, 0] >= 0, intensity, 0.0)
    count = int((turned < 0).any(axis=0).sum())
    if not count:
        return []
    f, s = np.unravel_index(np.argmin(turned), turned.shape)
    sources = "source is" if len(sky) == 1 else f"of {len(sky)} sources {'is' if count == 1 else 'are'}"
    return [
        f"{count} {sources} negative in I by {'its spectrum' if count == 1 else 'their spectra'}, at worst "
        f"'{harmless(sky.names[s], 60)}': {turned[f, s]:.3g} Jy at {freq_hz[f] / 1e6:g} MHz"
    ]


def _far(sky: Sources, freq_hz: Float) -> list[str]:
    """How far from where it was measured the flux of a source is taken, where that is far."""
    if sky.reference_hz is None:
        return []
    apart = np.abs(np.log(freq_hz[:, None] / sky.reference_hz))
    f, s = np.unravel_index(np.argmax(apart), apart.shape)
    if apart[f, s] <= np.log(FAR):
        return []
    terms = sky.spectral_terms
    flat = len(sky) if terms is None else int((~np.any(terms != 0, axis=1)).sum())
    constant = f"; {flat} of {len(sky)} without a spectral index" if flat else ""
    return [
        f"fluxes are taken up to {np.exp(apart[f, s]):.3g} times away from where they were measured: "
        f"'{harmless(sky.names[s], 60)}', {sky.reference_hz[s] / 1e6:g} MHz, at {freq_hz[f] / 1e6:g} MHz{constant}"
    ]
