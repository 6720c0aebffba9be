"""write_calfits: gains of stations as calfits, the solutions of the 21-cm packages, through pyuvdata."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from instrument.calibrate.base import Solution
from instrument.checked import checked
from instrument.errors import InputError
from instrument.files.solutions import diagonal_gains
from instrument.files.uv_data import library, name_antennas, telescope_of, told
from instrument.files.uv_file import JD_OF_MJD, MEAN
from instrument.jones.table import JonesTable
from instrument.observe.sampling import Sampling
from instrument.provenance import written_by
from instrument.units import Float, one_si
from instrument.whole_file import whole_file


@checked
def write_calfits(
    path: str | os.PathLike[str],
    solution: Solution | JonesTable,
    at: Sampling,
    interval: Any = None,
    channel_width: Any = None,
    overwrite: bool = False,
) -> None:
    """Write diagonal gains as calfits (extra `uv`), which data are divided by: V_ab / (g_a g_b*), as ours are.

    `at` (such as `vis.at`) lends stations, and times and channels where the gains are constant along them. `interval`
    and `channel_width` are the spacing of several, and needed for one. Gains that are not finite, or 0, are flagged.
    Raises `InputError` for entries off the diagonal above 1e-6, and for times or channels that are not evenly spaced.
    """
    gains, usable, slots_s, freq_hz, names = diagonal_gains(solution, at)
    if np.array_equal(slots_s, [0.0]):
        slots_s = at.slots_s
    if np.array_equal(freq_hz, [0.0]):
        freq_hz = at.freq_hz
    known = solution.interval_s if isinstance(solution, Solution) else None
    step_s = _step(slots_s, None if interval is None else one_si(interval, "s", "interval", above=0), known, "interval")
    given = None if channel_width is None else one_si(channel_width, "Hz", "channel_width", above=0)
    width_hz = _step(freq_hz, given, None, "channel_width")
    shape = len(slots_s), len(freq_hz), *gains.shape[2:]
    flag = np.broadcast_to(~usable[..., None], shape)
    values = np.where(flag, 1.0, np.broadcast_to(gains, shape))
    with whole_file(path, overwrite) as partial, told(path):
        cal = library().UVCal.new(
            cal_style="sky", gain_convention="divide", jones_array=np.array([-5, -6]), cal_type="gain",
            telescope=telescope_of(at.layout), time_array=JD_OF_MJD + slots_s / 86400.0, freq_array=freq_hz,
            integration_time=np.full(len(slots_s), step_s), channel_width=np.full(len(freq_hz), width_hz),
            ant_array=np.arange(len(names)) + 1, ref_antenna_name="various", sky_catalog="unknown", gain_scale="Jy",
            pol_convention=MEAN,
            update_telescope_from_known=False, history=f"{written_by()['software']}, {written_by()['written']}. ",
            data={"gain_array": np.array(np.moveaxis(values, 2, 0).swapaxes(1, 2)),
                  "flag_array": np.array(np.moveaxis(flag, 2, 0).swapaxes(1, 2))},
        )  # fmt: skip
        cal.write_calfits(str(partial))
        name_antennas(partial, "ANTENNAS", "ANTNAME", at.layout.names)


def _step(places: Float, given: float | None, known: float | None, name: str) -> float:
    """The spacing of times or channels; raises `InputError` where it is not even, or not known."""
    steps = np.diff(places)
    if steps.size and np.ptp(steps) > 1e-6 * abs(steps[0]):
        what = "times" if name == "interval" else "channels"
        raise InputError(f"calfits takes evenly spaced {what}: these are {steps.min():g} to {steps.max():g} apart")
    found = given or (float(steps[0]) if steps.size else known)
    if found is None:
        raise InputError(f"one time or channel does not tell how long or wide it is: give {name}=")
    return found
