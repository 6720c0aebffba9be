"""Figures of laboratories: errors against the sources in a model, and what is left of clusters of directions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from instrument.errors import InputError
from instrument.report.spectra import log_numbers
from instrument.report.style import BLUE, GREY, INK, ORANGE, axes_of, styled
from instrument.units import Float

if TYPE_CHECKING:
    from instrument.experiments.incomplete_model_result import Sweep
    from instrument.experiments.many_directions_result import ManyDirectionsResult

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
        low, high = ax.get_ylim()
        log_numbers(ax.yaxis, high / low)
        ax.grid(color="#dddddd", lw=0.6)
        ax.legend(frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=2 if ax is above else 3, borderpad=0)
    below.set_xlabel(f"sources in the model, of {sweep.sources}")
    below.set_xticks(n, [f"{k:g}" for k in n])
    below.minorticks_off()
    figure.subplots_adjust(hspace=0.2)
    return figure


@styled
def left_of_clusters(found: ManyDirectionsResult, ax: Axes | None = None) -> Axes:
    """Rms (C,) of what is left of each cluster, in Jy on a log axis: solved in many directions, in one; the noise.

    Raises `InputError` for a result that does not know it.
    """
    if found.apart_jy is None or not (np.nan_to_num(found.apart_jy) > 0).any():
        raise InputError("this result does not know what is left of each cluster: run the laboratory again")
    ax = axes_of(ax, (6.4, 4.8))
    at = np.arange(len(found.names))
    shown = np.where(found.apart_jy > 0, found.apart_jy, np.nan)
    for values, label, colour, marker in (
        (shown[1], "one direction for all", ORANGE, "s"),
        (shown[0], "every cluster its own", BLUE, "o"),
    ):
        ax.plot(at, values, ls="", marker=marker, ms=9, color=colour, label=label)
    if found.noise_jy:
        ax.axhline(found.noise_jy, color=GREY, ls="--", lw=1.6, label="noise")
    ax.set(yscale="log", ylabel="rms left of the cluster (Jy)", xlim=(-0.5, len(at) - 0.5))
    labels = [f"{name}\n{flux:.3g} Jy" for name, flux in zip(found.names, found.flux_jy, strict=True)]
    seen = shown[np.isfinite(shown)]
    log_numbers(ax.yaxis, float(seen.max() / seen.min()))
    crowded = len(at) > 7
    ax.set_xticks(at, found.names if crowded else labels, rotation=60 if crowded else 0)
    ax.set_xlabel("cluster" if crowded else "cluster, and its flux")
    ax.grid(color="#dddddd", lw=0.6, axis="y")
    ax.legend(frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=3, borderpad=0, columnspacing=1.2)
    return ax
