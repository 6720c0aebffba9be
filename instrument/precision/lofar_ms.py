"""A Measurement Set of zeros for a peer program to predict into: what `MeasurementSet.create` writes, and columns."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike

import numpy as np

from instrument.files.measurement_set import MeasurementSet
from instrument.files.ms_tables import opened
from instrument.model import Instrument
from instrument.observe.observation import Observation
from instrument.observe.sampling import Sampling
from instrument.visibilities import Visibilities


def make_ms(
    path: str | PathLike[str],
    instrument: Instrument,
    observation: Observation,
    columns: Sequence[str] = ("DATA",),
    turned: bool = False,
) -> None:
    """Write the set at `path`, `columns` zero and weights 1; rows in time order, then in that of `layout.baselines`.

    `turned` makes UVW position of ANTENNA1 minus ANTENNA2: the sign with which DP3's fringes agree with its beams.
    """
    layout, centre = instrument.layout(), observation.phase_centre
    at = Sampling.build(layout, observation.times(layout), observation.freq_hz, centre.ra_rad, centre.dec_rad, centre)
    one, two = layout.baselines
    data = np.broadcast_to(np.zeros((), complex), (*at.shape[:2], len(one), 2, 2))
    zeros = Visibilities(data, at, one, two, observation.interval, observation.width_hz)
    made = MeasurementSet.create(path, zeros, instrument=instrument)
    for name in columns[1:]:
        made.write(name, zeros)
    if turned:
        with opened(path, writable=True) as table:
            table.putcol("UVW", -table.getcol("UVW"))
