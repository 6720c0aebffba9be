"""Figures of the incomplete-model laboratory: errors against the number of sources in the model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from instrument.report.style import BLUE, GREY, INK, ORANGE, styled
from instrument.units import Float

if TYPE_CHECKING:
    from instrument.experiments.incomplete_model_result import Sweep

GREEN = "#009E73"  # Okabe & Ito


@styled
def errors_against_model(sweep: Sweep, figure: Figure | None = None) -> Figure:
    """Rms, flux errors (above) and position errors (below) against the number of sources n in the model, log-log.

    Medians over the watched sources; what is zero or not measured is not drawn.
    """
    figure = figure or Figure(figsize=(6.4, 8.2))
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(1.5, 1))
    table = sweep.table()
    n = np.asarray(table["n"])

    def column(name: str) -> Float:
        return np.asarray(getattr(table[name], "value", table[name]), float)

    curves: Any = (
        (above, column("visibility_rms"), "rms of visibilities, of their rms", INK, "o", "-"),
        (above, column("image_rms"), "rms of the image, of its rms", GREY, "s", "-"),
        (above, column("bright_flux_median"), f"flux error, {sweep.bright} brightest", BLUE, "D", "-"),
        (above, 100 * (1 - column("suppression")), "flux lost, not in the model", ORANGE, "^", "--"),
        (below, column("bright_shift_median"), f"{sweep.bright} brightest", BLUE, "D", "-"),
        (below, column("modelled_shift_median"), "in the model", GREEN, "v", "-"),
        (below, column("unmodelled_shift_median"), "not in the model", ORANGE, "^", "--"),
    )
    for ax, values, label, colour, marker, line in curves:
        shown = np.where(values > 0, values, np.nan)
        if np.isfinite(shown).any():
            ax.plot(n, shown, color=colour, marker=marker, ls=line, ms=6, lw=1.6, label=label)
    for ax, label in ((above, "error (%)"), (below, "position error (arcsec)")):
        ax.set(xscale="log", yscale="log", ylabel=label)
        ax.grid(color="#dddddd", lw=0.6)
        ax.legend(frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=2 if ax is above else 3, borderpad=0)
    below.set_xlabel(f"sources in the model, of {sweep.sources}")
    below.set_xticks(n, [f"{k:g}" for k in n])
    below.minorticks_off()
    figure.subplots_adjust(hspace=0.2)
    return figure
