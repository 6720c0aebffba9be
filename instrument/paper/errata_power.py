"""The slips of the paper about power spectra, 7 to 9: the largest k_par, the distance, the volume."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.analyze.analyzer import Analyzer
from instrument.analyze.power.fourier import HYDROGEN, comoving
from instrument.image.cube import StokesCube
from instrument.observe.directions import LIGHT
from instrument.paper.finding import Finding, near, slip
from instrument.units import Float

BAND_HZ = np.linspace(134e6, 166e6, 161)


def _cube(field: Float, freq_hz: Float) -> StokesCube:
    from astropy import units as u

    data = np.zeros((len(field), 4, *field.shape[1:]))
    data[:, 0] = field
    return StokesCube(data, freq_hz * u.Hz, 2 * u.arcmin, "K", constants="data")


def tone() -> tuple[Float, Float, float]:
    """k_par of the printed axis, power on it of a tone, and the k_par of the tone."""
    plain = Analyzer(_cube(np.ones((161, 16, 16)), BAND_HZ)).cylindrical(taper=None, bins=1)
    cell = int(np.argmin(np.abs(plain.k_par - 0.3))) + 1
    wave = np.cos(2 * np.pi * cell * np.arange(161) / 161)[:, None, None]
    across = np.cos(2 * np.pi * 3 * np.arange(16) / 16)
    drawn = Analyzer(_cube(wave * across, BAND_HZ)).cylindrical(taper=None, paper_axis=True, bins=1)
    return drawn.k_par, drawn.power[0], float(plain.k_par[cell - 1])


def nyquist() -> list[Finding]:
    """Slip 7: the largest k_par."""
    noise = _cube(np.ones((161, 16, 16)), BAND_HZ)
    last, printed = (
        float(Analyzer(noise).cylindrical(taper=None, bins=1, paper_axis=which).k_par[-1]) for which in (False, True)
    )
    k, power, at = tone()
    twice = k[power > power.max() / 2]
    text = f"a tone at {at:.3f} /Mpc is drawn at {' and '.join(f'{x:.3f}' for x in twice)}: the rest is a mirror image"
    from astropy.cosmology import Planck15

    z = HYDROGEN / 150e6 - 1
    depth = LIGHT / 1e3 * (1 + z) ** 2 / (Planck15.H(z).value * HYDROGEN)  # Mpc/Hz
    # pi over the depth of a channel; the last cell of 161 is 160/161 of it
    highest = np.pi / (0.2e6 * depth)
    what = "7. largest k_par of channels of 0.2 MHz"
    return [slip(what, last, "/Mpc", "1/dnu: 1.85", printed, text, (0.98 * highest, highest))]


def distance() -> list[Finding]:
    """Slip 8: the comoving distance."""
    from astropy.cosmology import Planck15

    z, mpc = comoving(150e6, None, None)
    unit = float(Planck15.hubble_distance.to_value("Mpc"))
    text = f"the printed integral is {mpc / unit:.3f}, a number without c/H0 = {unit:.0f} Mpc"
    return [
        slip(f"8. comoving distance at z = {z:.2f}", mpc, "Mpc", "no c/H0", mpc / unit, text, near(_integral(z), 3e-3))
    ]


def _integral(z: float) -> float:
    """Comoving distance in Mpc of flat cold matter and a constant (Planck 2015), summed by the trapezium rule."""
    from astropy.cosmology import Planck15

    steps = np.linspace(0.0, z, 100_001)
    matter, radiation = Planck15.Om0 + Planck15.Onu0, Planck15.Ogamma0  # neutrinos of which most have mass, as matter
    rate = np.sqrt(matter * (1 + steps) ** 3 + radiation * (1 + steps) ** 4 + 1 - matter - radiation)
    return float(LIGHT / 1e3 / Planck15.H0.value * np.trapezoid(1 / rate, steps))


def volume(rng: Any) -> list[Finding]:
    """Slip 9: power has a volume."""

    def both(count: int) -> tuple[float, float]:
        """Variance of a cube, from its power summed over cells: as it should be, and without the volume factor."""
        freq = BAND_HZ[:count]
        field = rng.normal(size=(count, 32, 32))
        field /= field.std()
        cells = Analyzer(_cube(field, freq)).cylindrical(taper=None, bins=1)
        frame = cells.frame
        side = 32 * np.deg2rad(2 / 60) * frame.distance_mpc
        volume = side**2 * count * (freq[1] - freq[0]) * frame.depth_mpc_per_hz
        square = float(np.sum(np.abs(np.fft.fftn(field)) ** 2)) / volume
        return float(np.nansum(cells.power * cells.count) / np.nansum(cells.count) * field.size / volume), square

    right, wrong = both(161)
    half = both(80)[1]
    text = f"the printed square gives {wrong:.3g}, and {half:.3g} for half of the channels: it is no power of a field"
    return [slip("9. variance of a field of 1 K from its power", right, "K2", "no volume", wrong, text, near(1.0))]
