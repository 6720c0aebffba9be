"""What leaks of the polarization of a cube into Stokes I through the beam of an instrument."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.checked import checked
from instrument.errors import InputError, warn
from instrument.image.cube import StokesCube
from instrument.image.mocks import add_leakage
from instrument.model import Instrument
from instrument.observe.directions import offset
from instrument.units import Float

ENOUGH = 0.01  # of the largest entry: interpolation errors above are said
NOTHING = 1e-6  # of the beam itself: below, there is no leakage whose share could count


@checked
def leaked_through(
    cube: StokesCube,
    instrument: Instrument,
    times: Any,
    baseline: tuple[str, str] | None = None,
    nodes: int = 9,
    channels: int = 5,
) -> StokesCube:
    """The same with I + M_IQ Q + M_IU U + M_IV V for I, of the mean Mueller matrix of a baseline over some times.

    M is that of the differential beam (corrected towards the centre of the cube), real part. It is evaluated in `nodes`
    x `nodes` directions over the image and at `channels` frequencies, at Chebyshev points, and interpolated by
    polynomials through them. At 20 other places the interpolation is compared with the beam itself: a warning says
    where it is wrong by more than 1 % of the largest entry, and 1e-6 of the beam. Q, U, V stay as they are. Needs a
    cube with a centre.
    """
    if cube.centre is None:
        raise InputError("the beam needs the centre of the cube: StokesCube(..., centre=...)")
    if nodes < 2 or channels < 1:
        raise InputError(f"nodes = {nodes} must be 2 or more, channels = {channels} 1 or more")
    from astropy import units as u
    from astropy.coordinates import SkyCoord

    centre, l, m = cube.centre, cube.grid.east, cube.grid.north
    l_at, m_at, f_at = _points(l, nodes), _points(m, nodes), _points(cube.freq_hz, channels)

    def entries(east: Float, north: Float, freq_hz: Float) -> Float:
        """M_II, M_IQ, M_IU, M_IV at S places and F frequencies (F, 4, S)."""
        at = SkyCoord(*offset(centre, east, north), unit="rad")
        found = instrument.mueller(at, times, freq_hz * u.Hz, centre.skycoord, baseline, "differential")
        return np.moveaxis(found.real.mean(axis=0)[..., 0, :], -1, 1)

    grid_l, grid_m = (g.ravel() for g in np.meshgrid(l_at, m_at))
    beam, values = np.split(entries(grid_l, grid_m, f_at).reshape(len(f_at), 4, len(m_at), len(l_at)), [1], axis=1)
    to_f, to_m, to_l = _through(f_at, cube.freq_hz), _through(m_at, m), _through(l_at, l)
    # as many places where no node is, and the middle frequency
    rng = np.random.default_rng(0)
    some_l, some_m = rng.uniform(l.min(), l.max(), 20), rng.uniform(m.min(), m.max(), 20)
    middle = np.array([(cube.freq_hz.min() + cube.freq_hz.max()) / 2])
    near = np.einsum(
        "f,fkyx,sy,sx->ks", _through(f_at, middle)[0], values, _through(m_at, some_m), _through(l_at, some_l)
    )
    wrong = float(np.abs(near - entries(some_l, some_m, middle)[0, 1:]).max())
    largest = float(np.abs(values).max())
    if not wrong <= max(ENOUGH * largest, NOTHING * float(np.abs(beam).max())):
        share = 100 * wrong / largest if largest else np.inf
        said = f"the leakage between {nodes} x {nodes} nodes is wrong by {share:.2g} % of its largest: more nodes"
        warn(said)
    data = np.array(cube.data, np.result_type(cube.data, np.float32))
    for plane, weights in zip(data, to_f, strict=True):
        maps = (to_m @ np.tensordot(weights, values, 1) @ to_l.T).astype(data.dtype)
        add_leakage(plane, maps)
    return cube.with_data(data)


def _points(values: Float, n: int) -> Float:
    """Chebyshev points over the range of some values: n of them, or one where all are the same."""
    low, high = float(values.min()), float(values.max())
    if low == high:
        return np.array([low])
    return np.asarray((low + high) / 2 - (high - low) / 2 * np.cos(np.pi * (np.arange(n) + 0.5) / n))


def _through(nodes: Float, at: Float) -> Float:
    """Weights (N, n) that take values at n nodes to a polynomial's at N places: Lagrange, barycentric form."""
    apart = nodes[:, None] - nodes + np.eye(len(nodes))
    scale = 1 / np.prod(apart / np.abs(apart).max(), axis=1)
    off = at[:, None] - nodes
    on = off == 0
    weights = scale / np.where(on, 1.0, off)
    weights = np.where(on.any(axis=1, keepdims=True), on, weights)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))
