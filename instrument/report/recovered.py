"""Figure of recovered over injected power: ratio and transfer of a signal against k."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from instrument.report.spectra import LOOKS, log_numbers
from instrument.report.style import GREY, styled

if TYPE_CHECKING:
    from instrument.analyze.power.recovered import Recovered


@styled
def recovered_over_injected(ends: Mapping[str, Recovered]) -> Figure:
    """Ratio of power (N,), log-log, above; transfer of the signal below; a line at 1 in both, a colour for each end."""
    figure = Figure(figsize=(6.8, 7.0), layout="constrained")
    ratio, transfer = figure.subplots(2, 1, sharex=True)
    for (name, one), (colour, marker) in zip(ends.items(), LOOKS, strict=False):
        line: Any = {"color": colour, "marker": marker, "ms": 5, "lw": 1.4, "elinewidth": 1, "label": name}
        k = one.injected.k  # type: ignore[union-attr]
        ratio.errorbar(k, np.where(one.ratio > 0, one.ratio, np.nan), one.ratio_sigma, **line)
        transfer.errorbar(k, one.transfer, one.transfer_sigma, **line)
    ratio.set(xscale="log", yscale="log", ylabel="power over that injected")
    transfer.set(xscale="log", xlabel="k (Mpc$^{-1}$)", ylabel="transfer of the signal")
    shown = np.concatenate([one.transfer for one in ends.values()])
    low, high = (float(f(shown, initial=v)) for f, v in ((np.nanmin, 0.0), (np.nanmax, 1.0)))
    transfer.set_ylim(low - 0.1, high + 0.1)  # bars of what is lost in foregrounds would hide the rest
    for ax in (ratio, transfer):
        ax.axhline(1.0, color=GREY, lw=1, zorder=0)
        ax.grid(color="#dddddd", lw=0.6)
        left, right = ax.get_xlim()
        log_numbers(ax.xaxis, right / left)
    bottom, top = ratio.get_ylim()
    log_numbers(ratio.yaxis, top / bottom)
    ratio.legend(loc="best", frameon=False)
    return figure
