"""One channel seen through beams, and the three ways to correct its images for them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from instrument import mat2
from instrument.correlations import ALL_FOUR
from instrument.errors import RefusedError
from instrument.image.beam_weights import MuellerWeights
from instrument.predict.base import EVERY
from instrument.predict.operator import STOKES, ImageOperator
from instrument.units import Bool, Complex, Float, Int

Q_AND_U = (1, 2)
CORRELATIONS = ("pp", "pq", "qp", "qq")


@dataclass(frozen=True)
class Channel:
    """Visibilities (T, 1, B, 2, 2) with weights (T, 1, B), and the operator that takes images to them.

    `known` (2, 2) are the correlations that have these weights, the others none. `centre` (T, 1, A, 2, 2) is what took
    the beam towards the phase centre out of the data; the operator is taken through it too: with beams as they are, the
    sidelobes of a source would be polarized as the dipoles lie.
    """

    operator: ImageOperator
    channel: slice
    pairs: tuple[Int, Int]
    data: Complex
    weight: Float
    weights: MuellerWeights
    centre: Complex | None = None
    known: Bool = field(default_factory=lambda: ALL_FOUR)

    @property
    def each(self) -> Float:
        """Weights of the correlations, (T, 1, B, 2, 2), or (T, 1, B, 1, 1) where all have one."""
        weight = self.weight[..., None, None]
        return weight if self.known.all() else weight * self.known

    def seen(self, images: Float) -> Complex:
        """A x of images (4, Ny, Nx)."""
        found = self.operator.forward(images[None], EVERY, self.channel, self.pairs)
        if self.centre is None:
            return found
        return mat2.between(self.centre, found, *self.pairs)

    def back(self, data: Complex, kinds: tuple[int, ...] = STOKES) -> Float:
        """A^H w y, (4, Ny, Nx), of some Stokes parameters; 0 of the others."""
        weight = self.each
        weighted = np.asarray(weight * np.where(weight > 0, data, 0), complex)
        if self.centre is not None:
            weighted = mat2.between(mat2.herm(self.centre), weighted, *self.pairs)
        return self.operator.adjoint(weighted, EVERY, self.channel, self.pairs, kinds)[0]

    def size(self, data: Complex) -> float:
        """sqrt(sum w |V|^2)."""
        weight = self.each
        return float(np.sqrt(np.sum(weight * np.abs(np.where(weight > 0, data, 0.0)) ** 2)))


@dataclass(frozen=True)
class Corrected:
    """Images (4, Ny, Nx) of the sky, the model that was taken out of them, and what is recorded."""

    images: Float
    model: Float
    record: dict[str, Any]


def normalised(seen: Channel) -> Corrected:
    """A^H w V through the inverse of sum w M^H M."""
    return Corrected(seen.weights.undone(seen.back(seen.data)), np.zeros((4, *seen.weights.usable.shape)), {})


def joint(seen: Channel, mask: Bool, iterations: int, least: float) -> Corrected:
    """I, Q, U, V of the pixels of a mask by conjugate gradients, preconditioned with the inverse of each matrix.

    The images are what is left, normalised; the model is in Jy/pixel. Ends when the residual is `least` of the data.
    """
    mask = mask & seen.weights.usable
    model = np.zeros((4, *mask.shape))
    left, whole = seen.data.copy(), seen.size(seen.data)
    r = np.where(mask, seen.back(left), 0.0)
    z = seen.weights.solved(r, mask)
    p, rz, done, share = z, float(np.vdot(r, z)), 0, 1.0
    while done < iterations and rz > 0 and share > least:
        q = seen.seen(p)
        step = rz / seen.size(q) ** 2
        model += step * p
        left -= step * q
        share = seen.size(left) / whole
        r = np.where(mask, seen.back(left), 0.0)
        z = seen.weights.solved(r, mask)
        rz, before = float(np.vdot(r, z)), rz
        p = z + rz / before * p
        done += 1
    images = seen.weights.undone(seen.back(left))
    return Corrected(images, model, {"iterations": done, "left_of_data": share})


def linear(data: Complex) -> Complex:
    """The Q and U of visibilities (..., 2, 2), without their I and V."""
    q, u = (data[..., 0, 0] - data[..., 1, 1]) / 2, (data[..., 0, 1] + data[..., 1, 0]) / 2
    return mat2.pack(q, u, u, -q)


def predicted(seen: Channel, iterations: int, least: float) -> Corrected:
    """Q and U alone by conjugate gradients on the Q and U of the data; what they leak into I and V is taken out.

    The images have I and V of what is left, and Q and U as they were seen; all normalised.
    """
    if not seen.known.all():
        there = [name for name, one in zip(CORRELATIONS, seen.known.flat, strict=True) if one]
        raise RefusedError(
            f"way = 'predict' needs all four correlations, and a channel has {', '.join(there)} alone: flag that "
            "channel, or take way = 'normalised' or 'joint'"
        )
    model = np.zeros((4, *seen.weights.usable.shape))
    wanted = linear(seen.data)
    left, whole = seen.data.copy(), seen.size(wanted)
    r = seen.back(wanted, Q_AND_U)
    p, rr, done, share = r, float(np.vdot(r, r)), 0, 1.0
    while done < iterations and rr > 0 and share > least:
        q = seen.seen(p)
        step = rr / seen.size(linear(q)) ** 2
        model += step * p
        left -= step * q
        share = seen.size(linear(left)) / whole
        r = seen.back(linear(left), Q_AND_U)
        rr, before = float(np.vdot(r, r)), rr
        p = r + rr / before * p
        done += 1
    # apart: taken back together, Q and U would leak into I by their sidelobes, as without any solution
    images = seen.weights.undone(seen.back(left))
    images[list(Q_AND_U)] = seen.weights.undone(seen.back(seen.data))[list(Q_AND_U)]
    return Corrected(images, model, {"iterations": done, "left_of_linear": share})
