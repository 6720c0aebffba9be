"""What is left of visibilities on the baselines of each station, integration by integration."""

from __future__ import annotations

import numpy as np

from instrument.checked import checked
from instrument.units import Float
from instrument.visibilities import Visibilities


@checked
def rms_by_station(left: Visibilities, of: Visibilities) -> Float:
    """Rms of visibilities over that of others on the baselines of each station, all channels together, (T, A).

    What is flagged or not finite in the first counts in neither; NaN where a station has no data, or others of zero.
    """
    return share_of(powers_by_station(left, of))


def share_of(powers: Float) -> Float:
    """Root of the ratio of two powers (2, T, A); NaN where the second is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(np.where(powers[1] > 0, powers[0] / powers[1], np.nan))


@checked
def powers_by_station(left: Visibilities, of: Visibilities) -> Float:
    """The sums of |V|² of both on the baselines of each station, all channels together, (2, T, A)."""
    left.check_same(of)
    good = left.whole_weight > 0
    ends = np.zeros((len(left.antenna1), len(left.layout)))
    ends[np.arange(len(ends)), left.antenna1] = ends[np.arange(len(ends)), left.antenna2] = 1.0
    powers = []
    for vis in (left, of):
        power = (vis.data.real**2 + vis.data.imag**2).sum(axis=(-2, -1))
        powers.append(np.where(good, power, 0.0).sum(axis=1) @ ends)
    return np.stack(powers)
