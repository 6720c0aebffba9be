"""One atom of the gridded engine: a channel of some integrations, with a w-gridder for each node.

Its brother on one grid for all nodes is `separable_atom.py`; tests/accuracy/test_separable.py holds them together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from instrument.compiled import compiled
from instrument.observe.directions import tangents
from instrument.observe.sampling import Sampling
from instrument.phasor import FAST
from instrument.predict.beam_times import BeamTimes
from instrument.predict.gridding import Gridder
from instrument.predict.time_samples import TimeSamples
from instrument.units import Complex, Direction, Float


class Span(NamedTuple):
    """Integrations `begin` to `end` from the first of an atom: stations (N, A, 3) there, the instants of its beams."""

    begin: int
    end: int
    stations_m: Float
    moments: Sampling


@dataclass(frozen=True)
class Atom:
    """Samples (N,) with their antennas and slots, a gridder, beams at the instants (instants, A, K, 2, 2).

    `functions` (K, Ny, Nx) are those of the nodes.
    """

    samples: TimeSamples
    listed: tuple[Any, Any, Any]
    gridder: Gridder
    shift: Complex | None  # (N,): from the centre of the image to that of the visibilities
    beams: Complex
    instants: BeamTimes
    slots: int
    functions: Float

    def forward(self, images: Float) -> Complex:
        """Samples (N, 4) of images (4, Ny, Nx)."""
        out = np.zeros((self.samples.count, 4), complex)
        there = np.array([s for s in range(4) if images[s].any()], int)
        for k in range(len(self.functions) if len(there) else 0):
            planes = np.array([self.gridder.visibilities(self.functions[k] * images[s]) for s in there])
            if self.shift is not None:
                planes *= self.shift
            _forward(planes, there, self._jones(k), *self.listed, out)
        return out

    def adjoint(self, samples: Complex, kinds: tuple[int, ...]) -> Float:
        """Images (4, Ny, Nx) of samples (N, 4), of some Stokes parameters, 0 in the others."""
        out, planes = np.zeros((4, *self.gridder.pixels)), np.empty((4, len(samples)), complex)
        for k in range(len(self.functions)):
            _adjoint(samples, self._jones(k), *self.listed, planes)
            if self.shift is not None:
                planes *= self.shift.conj()
            for s in kinds:
                out[s] += self.functions[k] * self.gridder.image(planes[s])
        return out

    def _jones(self, node: int) -> Complex:
        """Beams towards a node at every slot, (slots, A, 2, 2)."""
        return self.instants.between(self.beams[:, :, node], self.slots)


def about(uvw: Float, grid: Direction, centre: Direction) -> tuple[Float, Complex | None]:
    """Baselines (N, 3) about the centre of an image, and the fringe (N,) that takes its visibilities to another."""
    if grid == centre:
        return np.ascontiguousarray(uvw), None
    axes = [
        np.concatenate([*tangents(np.array([d.ra_rad]), np.array([d.dec_rad])), d.vector[None]]) for d in (centre, grid)
    ]
    turned = uvw @ (axes[0] @ axes[1].T)
    cycles = turned[:, 2] - uvw[:, 2]
    return np.ascontiguousarray(turned), np.exp(-2j * np.pi * (cycles - np.rint(cycles)))


@compiled(nogil=True, fastmath=FAST, error_model="numpy")
def _forward(planes: Any, there: Any, jones: Any, one: Any, other: Any, slots: Any, out: Any) -> None:
    """Add J_a F J_b^H of a node to samples (N, 4), F of planes (n, N) of the Stokes parameters that are there."""
    for n in range(len(one)):
        a, b = jones[slots[n], one[n]], jones[slots[n], other[n]]
        p = q = r = s = 0j
        for i in range(len(there)):
            f = planes[i, n]
            if there[i] == 0:
                p += f
                s += f
            elif there[i] == 1:
                p += f
                s -= f
            elif there[i] == 2:
                q += f
                r += f
            else:
                q += 1j * f
                r -= 1j * f
        x, y = a[0, 0] * p + a[0, 1] * r, a[0, 0] * q + a[0, 1] * s
        z, w = a[1, 0] * p + a[1, 1] * r, a[1, 0] * q + a[1, 1] * s
        out[n, 0] += x * np.conj(b[0, 0]) + y * np.conj(b[0, 1])
        out[n, 1] += x * np.conj(b[1, 0]) + y * np.conj(b[1, 1])
        out[n, 2] += z * np.conj(b[0, 0]) + w * np.conj(b[0, 1])
        out[n, 3] += z * np.conj(b[1, 0]) + w * np.conj(b[1, 1])


@compiled(nogil=True, fastmath=FAST, error_model="numpy")
def _adjoint(data: Any, jones: Any, one: Any, other: Any, slots: Any, planes: Any) -> None:
    """Planes (4, N) of I, Q, U, V: those of J_a^H V J_b at a node, of samples (N, 4)."""
    for n in range(len(one)):
        a, b = jones[slots[n], one[n]], jones[slots[n], other[n]]
        x = data[n, 0] * b[0, 0] + data[n, 1] * b[1, 0]
        y = data[n, 0] * b[0, 1] + data[n, 1] * b[1, 1]
        z = data[n, 2] * b[0, 0] + data[n, 3] * b[1, 0]
        w = data[n, 2] * b[0, 1] + data[n, 3] * b[1, 1]
        p, q = np.conj(a[0, 0]) * x + np.conj(a[1, 0]) * z, np.conj(a[0, 0]) * y + np.conj(a[1, 0]) * w
        r, s = np.conj(a[0, 1]) * x + np.conj(a[1, 1]) * z, np.conj(a[0, 1]) * y + np.conj(a[1, 1]) * w
        planes[0, n], planes[1, n] = p + s, p - s
        planes[2, n], planes[3, n] = q + r, -1j * (q - r)
