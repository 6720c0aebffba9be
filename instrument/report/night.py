"""A figure in the colours of a dark screen: paper and ink change places, images and colours of data stay."""

from __future__ import annotations

import base64
from io import BytesIO
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import Collection, QuadMesh
from matplotlib.colors import to_hex, to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text

PAPER, INK = np.array(to_rgba("#1d2126")), np.array(to_rgba("#e6e9ed"))  # those of the page
BRIGHTER = {"#0072b2": "#56b4e9", "#d55e00": "#f0803c"}  # 3:1 on dark paper is hard to read; Okabe & Ito's lighter blue
COLOURFUL = 0.15  # what differs more between its channels is a colour, not ink


def night(figure: Figure) -> str:
    """The figure on dark paper as a data URI; what it is drawn with is changed in place. Images (Ny, Nx, 3) stay.

    WebP where there is an encoder, for it is a tenth of the PNG of an image of noise, else PNG.
    """
    from PIL import features

    figure.set_layout_engine("none")  # as it was laid out for the day
    kept = {id(part) for ax in figure.axes for artist in _of_images(ax) for part in artist.findobj()}
    for artist in figure.findobj():
        if id(artist) not in kept:
            _recolour(artist)
    kind = "webp" if features.check("webp") else "png"
    out = BytesIO()
    more: Any = {"pil_kwargs": {"quality": 90}} if kind == "webp" else {}
    figure.savefig(out, format=kind, dpi=150, bbox_inches="tight", facecolor=PAPER, **more)
    return f"data:image/{kind};base64,{base64.b64encode(out.getvalue()).decode()}"


def _of_images(ax: Axes) -> list[Artist]:
    """What lies on images: it was chosen for their colours, and stays."""
    if not ax.images and not any(isinstance(c, QuadMesh) for c in ax.collections):
        return []
    frame: list[Any] = [ax.xaxis, ax.yaxis, *ax.spines.values(), ax.title, *ax.child_axes]
    if (legend := ax.get_legend()) is not None and not legend.get_frame_on():
        frame.append(legend)
    return [artist for artist in ax.get_children() if artist not in frame]


def flipped(colour: Any) -> Any:
    """A colour for the night: greys from paper to ink change places, colours stay or become brighter."""
    if isinstance(colour, str) and colour in ("none", "auto"):
        return colour
    rgba = np.array(to_rgba(colour))
    if np.ptp(rgba[:3]) > COLOURFUL:
        name = to_hex((rgba[0], rgba[1], rgba[2]))
        return to_rgba(BRIGHTER.get(name, name), rgba[3])
    light = rgba[:3].mean()
    return (*(light * PAPER + (1 - light) * INK)[:3], rgba[3])


def _recolour(artist: Any) -> None:
    if isinstance(artist, Axes):
        ink = tuple(INK)
        artist.tick_params(which="both", color=ink, labelcolor=ink)
    elif isinstance(artist, Text):
        artist.set_color(flipped(artist.get_color()))
        if (box := artist.get_bbox_patch()) is not None:
            _recolour(box)
    elif isinstance(artist, Line2D):
        face, edge = artist.get_markerfacecolor(), artist.get_markeredgecolor()
        artist.set(color=flipped(artist.get_color()), mfc=flipped(face), mec=flipped(edge))
    elif isinstance(artist, Patch):
        face, edge = artist.get_facecolor(), artist.get_edgecolor()
        artist.set(facecolor=flipped(face), edgecolor=flipped(edge))
    elif isinstance(artist, Collection) and not isinstance(artist, QuadMesh):
        edges = [flipped(c) for c in artist.get_edgecolor()]
        if artist.get_array() is None:
            artist.set_facecolor([flipped(c) for c in artist.get_facecolor()])
        artist.set_edgecolor(edges)
