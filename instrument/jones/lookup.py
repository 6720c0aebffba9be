"""Tables of terms in time and frequency: where they end, the nearest entry, and what lies between two."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument import mat2
from instrument.errors import InputError
from instrument.units import Complex, Float, Int

UNITS = {"time": "s", "frequency": "Hz"}
DAY_S = 86400.0


def demand_within(known: Float, asked: Float, what: str, reach: float) -> None:
    """Raise `InputError` for an `asked` (n,) outside ascending `known` (k,) by more than `reach` of one entry's width.

    The width is the smallest step: gaps only make steps longer. One entry says nothing of its width: it is taken for
    a day, and for a factor of 2 in frequency; at 0 it has no place, and is constant.
    """
    if len(known) == 1:
        if known[0] == 0:
            return
        apart = np.abs(asked - known[0]).max() if what == "time" else np.abs(np.log2(asked / known[0])).max()
        if not apart <= (DAY_S if what == "time" else 1.0):
            worst = asked[np.abs(asked - known[0]).argmax()]
            shown = f"{(worst - known[0]) / DAY_S:+.3g} days" if what == "time" else f"{worst - known[0]:+.6g} Hz"
            name = "slots_s" if what == "time" else "freq_hz"
            raise InputError(
                f"a table of one {what} is asked {shown} outside it; {name}=[0] says that it is constant in {what}"
            )
        return
    outside = np.maximum(known[0] - asked, asked - known[-1]).max()
    # 2e-6: times in double precision resolve 1 microsecond
    if not outside <= reach * np.diff(known).min() * (1 + 1e-6) + (2e-6 if what == "time" else 0.0):
        raise InputError(f"a table is asked at a {what} {outside:.6g} {UNITS[what]} outside it")


def nearest(known: Float, asked: Float) -> Int:
    """The entry of ascending `known` (k,) that is nearest to each of `asked` (n,)."""
    if len(known) == 1:
        return np.zeros(len(asked), int)
    right = np.clip(np.searchsorted(known, asked), 1, len(known) - 1)
    return np.where(asked - known[right - 1] < known[right] - asked, right - 1, right)


def between(first: Complex, second: Complex, share: Any) -> Complex:
    """Jones matrices a share (...) of the way from one to another, (..., 2, 2), in amplitude and phase.

    Diagonal ones go element by element; full ones J = U H turn by the power of U0^H U1 and stretch along the line from
    H0 to H1, which is the same for diagonal ones. Phases go the short way round. The straight line of complex numbers
    would lose amplitude: 0.71 is left half-way along 90 deg, and corrected data are 1.41 too bright.
    """
    first, second = np.broadcast_arrays(first, second)
    share = np.asarray(share)[..., None, None]
    with np.errstate(all="ignore"):
        return np.where(
            _diagonal(first) & _diagonal(second), _elements(first, second, share), _turn(first, second, share)
        )


def _diagonal(jones: Complex) -> Any:
    return ((jones[..., 0, 1] == 0) & (jones[..., 1, 0] == 0))[..., None, None]


def _elements(first: Complex, second: Complex, share: Any) -> Complex:
    # zero has no phase: it takes that of the other end
    start = np.where(first == 0, np.angle(second), np.angle(first))
    turn = np.where((first == 0) | (second == 0), 0.0, np.angle(_unit(second) * _unit(first).conj()))
    return np.asarray(((1 - share) * np.abs(first) + share * np.abs(second)) * np.exp(1j * (start + share * turn)))


def _unit(value: Complex) -> Complex:
    return np.asarray(value / np.abs(value))


def _turn(first: Complex, second: Complex, share: Any) -> Complex:
    u, h = _polar(first)
    other, along = _polar(second)
    return mat2.mul(mat2.mul(u, _power(mat2.mul(mat2.herm(u), other), share)), (1 - share) * h + share * along)


def _polar(jones: Complex) -> tuple[Complex, Complex]:
    """Unitary and positive part of 2x2 matrices, J = U H, in closed form; finite for singular ones too."""
    size = np.abs(jones).max(axis=(-2, -1), keepdims=True)
    scaled = jones / np.where(size > 0, size, 1.0)
    d = mat2.det(scaled)
    turn = np.where(d == 0, 1.0, _unit(d))[..., None, None]
    adjugate = mat2.pack(scaled[..., 1, 1], -scaled[..., 0, 1], -scaled[..., 1, 0], scaled[..., 0, 0])
    unitary = scaled + turn * mat2.herm(adjugate)
    norm = np.sqrt((np.abs(unitary) ** 2).sum(axis=(-2, -1), keepdims=True) / 2)
    unitary = np.where(norm > 0, unitary / norm, mat2.IDENTITY)
    return unitary, mat2.mul(mat2.herm(unitary), scaled) * size


def _power(unitary: Complex, share: Any) -> Complex:
    """U^share of unitary 2x2 matrices, both phases of its eigenvalues taken within half a turn."""
    common = np.angle(mat2.det(unitary))[..., None, None] / 2
    special = unitary * np.exp(-1j * common)  # cos b + i sin b (n . sigma)
    cos = np.real(special[..., 0, 0] + special[..., 1, 1])[..., None, None] / 2
    axis = (special - mat2.herm(special)) / 2j
    sin = np.sqrt((np.abs(axis) ** 2).sum(axis=(-2, -1), keepdims=True) / 2)
    b = np.arctan2(sin, cos)
    plus, minus = (np.angle(np.exp(1j * (common + sign * b))) for sign in (1, -1))
    mean, half = share * (plus + minus) / 2, share * (plus - minus) / 2
    axis = np.where(sin > 0, axis / sin, 0.0)
    return np.asarray(np.exp(1j * mean) * (np.cos(half) * mat2.IDENTITY + 1j * np.sin(half) * axis))
