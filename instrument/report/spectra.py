"""Figures of power spectra: power of images against k_perp and against length of baselines."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter

from instrument.errors import InputError
from instrument.report.style import BLUE, GREY, INK, ORANGE, axes_of, styled

if TYPE_CHECKING:
    from instrument.analyze.power.spectra import Spectrum2D

# Okabe & Ito, and a marker each: told apart with every colour vision and without colour
LOOKS = tuple(zip((BLUE, ORANGE, "#009E73", "#CC79A7", INK, GREY), "osD^vx", strict=True))


@styled
def spectra_2d(curves: dict[str, Spectrum2D], ax: Axes | None = None) -> Axes:
    """Power of images (N,) against k_perp, log-log, with the lengths of baselines on top; bars are sample errors.

    Lines break at empty bins. A bar that reaches zero ends at the axis. Curves without any power (a Stokes parameter
    that is zero) are named in the legend. Raises `InputError` for curves of different units or distances.
    """
    if not curves:
        raise InputError("no spectrum was given to draw")
    if len({(c.unit, c.distance_mpc) for c in curves.values()}) > 1:
        raise InputError("spectra of different units or redshifts have no common axes: draw them apart")
    ax = axes_of(ax, (6.4, 5.2))
    ax.set(xscale="log", yscale="log")
    tops: list[float] = []
    floors: list[float] = []
    for i, (name, curve) in enumerate(curves.items()):
        colour, marker = LOOKS[i % len(LOOKS)]
        shown = np.where(curve.power > 0, curve.power, np.nan)
        label = name if np.isfinite(shown).any() else f"{name}: no power"
        tops.extend((shown + curve.sigma)[np.isfinite(shown)])
        floors.extend(shown[np.isfinite(shown)])
        line: Any = {"color": colour, "marker": marker, "ms": 5, "lw": 1.4, "ls": ("-", "--")[i // len(LOOKS) % 2]}
        ax.errorbar(curve.k_perp, shown, curve.sigma, elinewidth=1, capsize=0, label=label, **line)
    first = next(iter(curves.values()))
    if floors:
        ax.set_ylim(min(floors) / 3, 2 * max(tops))
    low, high = min(c.edges[0] for c in curves.values()), max(c.edges[-1] for c in curves.values())
    ax.set_xlim(low if low > 0 else np.nanmin(first.k_perp) / 2, high)
    per_mpc = 2 * np.pi / first.distance_mpc
    to_wavelengths: Any = (lambda k: k / per_mpc, lambda uv: uv * per_mpc)
    top = ax.secondary_xaxis("top", functions=to_wavelengths)
    top.set_xlabel(f"baseline (wavelengths) at z = {first.redshift:.3g}", labelpad=8)
    unit = "K$^2$" if first.unit == "K" else f"({first.unit})$^2$"
    ax.set(xlabel=r"$k_\perp$ (Mpc$^{-1}$)", ylabel=f"power ({unit} Mpc$^2$)")
    for axis, (left, right) in ((ax.xaxis, ax.get_xlim()), (top.xaxis, ax.get_xlim()), (ax.yaxis, ax.get_ylim())):
        log_numbers(axis, right / left)
    ax.grid(color="#dddddd", lw=0.6)
    ax.legend(loc="upper center", bbox_to_anchor=(0.46, -0.16), ncols=min(len(curves), 3), frameon=False)
    return ax


def log_numbers(axis: Any, span: float) -> None:
    """Numbers at 1, 2, 5 where an axis spans less than 2.5 decades, and at powers of ten where more."""
    if span < 300:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())
