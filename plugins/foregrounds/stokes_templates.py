"""Leakage of polarization by templates: what of Stokes I looks like Q and U, pixel by pixel and channel by channel.

A beam makes I + M_IQ Q + M_IU U of I, with entries of its Mueller matrix that vary slowly over the image and with
frequency. Rotation measures then matter no more: what rotates fast in Q does so in the leakage.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from instrument.errors import InputError, Outcome
from instrument.foreground.base import ForegroundRemover, Separation
from instrument.foreground.linear import one_thread, seen
from instrument.foreground.maps import Plane, StokesMaps
from instrument.units import Bool, Float, Int, Whole

SIDE = 16  # patches along an axis at most: each is left out in turn, and 256 normal matrices are held
LEAST = 4  # patches along an axis at least
BEAMS = 3.0  # side of a patch: what noise and signal do in one is then hardly what they do in the next
FLOOR = 1e-12  # of the largest eigenvalue of the normal equations: a weaker combination is not determined
SAMPLE = 1024  # pixels over which the error of the foreground is averaged
ALONE = 1e-6  # share of what determines a combination that is outside a patch: no less is believed


class StokesTemplates(ForegroundRemover):
    """Fits I = M_IQ Q + M_IU U, and `smooth` terms of a polynomial in log(nu) of each pixel, by weighted least squares.

    M_IQ and M_IU are polynomials of total degree `order` over the image and of degree `order_freq` in frequency, one
    set of coefficients for the whole cube: tens of unknowns for millions of voxels. Channels weigh by their noise where
    it can be measured. `covariance` of the separation is that of the leakage of a pixel, the mean over the image, from
    how far the coefficients move when one patch of the image after the other is left out (jackknife): noise may have
    any spatial spectrum, and a signal counts as noise. Without `smooth` terms nothing is taken but what looks like Q
    and U; a smooth sky in I of which Q and U are no templates needs them.
    """

    planes: ClassVar[tuple[Plane, ...]] = ("Q", "U")
    stokes: Literal["I"] = "I"
    order: Annotated[int, Whole(at_least=0, at_most=12)] = 4
    order_freq: Annotated[int, Whole(at_least=0, at_most=6)] = 2
    smooth: Annotated[int, Whole(at_least=0)] = 0

    def separate(self, given: StokesMaps) -> Separation:
        """Foreground M_IQ Q + M_IU U, and the smooth part of the rest."""
        fit = _Fit(self, given)
        if not given["Q"].any() and not given["U"].any():
            return Separation.nothing(given.plane, Outcome.REFUSED, "Q and U are zero: there is nothing to go by")
        with one_thread():
            found, covariance, known = fit.solved()
            foreground, strength = fit.foreground(found)
            spread = fit.spread(covariance)
        error = float(np.sqrt(np.trace(spread) / len(spread)))
        outcome = Outcome.CONVERGED if known == len(found) else Outcome.SINGULAR
        remark = (
            f"{known} of {len(found)} coefficients of the leakage, which has {strength:.3g} rms, known to "
            f"{error:.2g} {given.unit}"
        )
        none = np.zeros((0, *given.plane.shape[1:]), given.plane.dtype)
        return Separation(
            outcome, remark, np.zeros((len(given), 0)), none, foreground=foreground, covariance=spread
        )  # fmt: skip


class _Fit:
    """Columns of the fit, T_s(c, x) F_p(c) S_i(x): template s, polynomial p of frequency, i of the place."""

    def __init__(self, settings: StokesTemplates, given: StokesMaps) -> None:
        self.given = given
        f, (ny, nx) = given.freq_hz, given.plane.shape[1:]
        y, x = np.meshgrid(np.linspace(-1, 1, ny), np.linspace(-1, 1, nx), indexing="ij")
        of_x, of_y = (np.polynomial.legendre.legvander(a.ravel(), settings.order) for a in (x, y))
        degrees = [(i, j) for i in range(settings.order + 1) for j in range(settings.order + 1 - i)]
        self.place = np.stack([of_x[:, i] * of_y[:, j] for i, j in degrees], axis=1)  # (N, n)
        span = float(np.ptp(f))
        at = (2 * f - f.min() - f.max()) / span if span > 0 else np.zeros(len(f))
        self.freq = np.polynomial.legendre.legvander(at, min(settings.order_freq, len(f) - 1))  # (C, P)
        self.root = _root_weights(given)
        log = np.log(f / f.mean())
        powers = np.polynomial.legendre.legvander(log / max(np.abs(log).max(), 1e-30), max(settings.smooth - 1, 0))
        count = min(settings.smooth, len(f))
        self.basis = np.linalg.qr(self.root[:, None] * powers[:, :count])[0]  # (C, k), of weighted spectra
        self.good: Bool = seen(given.plane).ravel()
        self.patch = _patches(given)

    def _by_patch(self) -> Iterator[tuple[Int, Float, Float]]:
        """Pixels (n,) of each patch, products of columns with each other (m, m, n) and with the data (m, n).

        Summed over channels, weighted, and without what the smooth terms can take.
        """
        planes = [self.given[s].reshape(len(self.given), -1) for s in ("Q", "U", "I")]
        m = self.freq.shape[1]
        squares = np.einsum("cp,cq->pqc", self.freq, self.freq).reshape(m * m, -1)
        onto = np.einsum("ck,cp->kpc", self.basis, self.freq).reshape(-1, len(self.freq))
        for number in np.unique(self.patch[self.good]):
            some = np.flatnonzero(self.good & (self.patch == number))
            q, u, i = (self.root[:, None] * plane[:, some].astype(float) for plane in planes)
            gram = np.empty((2, m, 2, m, len(some)))
            gram[0, :, 0], gram[1, :, 1], gram[0, :, 1] = (
                (squares @ (x * y)).reshape(m, m, -1) for x, y in ((q, q), (u, u), (q, u))
            )
            gram[1, :, 0] = np.swapaxes(gram[0, :, 1], 0, 1)
            data = np.stack([self.freq.T @ (x * i) for x in (q, u)])
            if self.basis.shape[1]:
                taken = np.stack([(onto @ x).reshape(-1, m, len(some)) for x in (q, u)], axis=1)
                gram -= np.einsum("kspn,ktqn->sptqn", taken, taken)
                data -= np.einsum("kspn,kn->spn", taken, self.basis.T @ i)
            yield some, gram.reshape(2 * m, 2 * m, -1), data.reshape(2 * m, -1)

    def _equations(self) -> tuple[Float, Float]:
        """Normal matrices (G, K, K) and right sides (G, K) of all patches: template and frequency first, place last."""
        n, m = self.place.shape[1], 2 * self.freq.shape[1]
        matrices, sides = [], []
        for some, gram, data in self._by_patch():
            place, normal = self.place[some], np.empty((m, n, m, n))
            for a in range(m):
                for b in range(a, m):
                    normal[a, :, b] = place.T @ (gram[a, b, :, None] * place)
                    normal[b, :, a] = normal[a, :, b].T
            matrices.append(normal.reshape(m * n, m * n))
            sides.append((data @ place).ravel())
        return np.array(matrices), np.array(sides)

    def solved(self) -> tuple[Float, Float, int]:
        """Coefficients (K,), their covariance (K, K) by leaving out each patch in turn, and how many are determined."""
        matrices, sides = self._equations()
        total = matrices.sum(axis=0)
        values, vectors = np.linalg.eigh(total)
        use = values > FLOOR * values[-1]
        white = vectors[:, use] / np.sqrt(values[use])  # the sum of all matrices becomes the identity
        parts = sides @ white
        whole = parts.sum(axis=0)
        shares, axes = np.linalg.eigh(np.eye(white.shape[1]) - white.T @ matrices @ white)
        without = np.einsum("gji,gj->gi", axes, whole - parts) / np.maximum(shares, ALONE)
        moved = np.einsum("gij,gj->gi", axes, without) - whole
        count = len(parts)
        covariance = white @ (moved.T @ moved) @ white.T * (count - 1) / count
        return white @ whole, covariance, int(use.sum()) + int((np.diagonal(total) == 0).sum())  # a template of zeros

    def foreground(self, found: Float) -> tuple[Any, float]:
        """The foreground (C, Ny, Nx), and the rms of the leakage in it."""
        plane, q, u = (self.given[s] for s in ("I", "Q", "U"))
        shape, m = plane.shape[1:], self.freq.shape[1]
        entries = (found.reshape(2 * m, -1) @ self.place.T).reshape(2, m, *shape)
        out = np.empty(plane.shape, plane.dtype)
        for k, row in enumerate(self.freq):
            mq, mu = np.tensordot(row, entries, axes=(0, 1)).astype(plane.dtype)
            out[k] = mq * q[k] + mu * u[k]
        power = float(np.mean([np.square(x, dtype=float).sum() for x in out]) / max(self.good.sum(), 1))
        if self.basis.shape[1]:
            back, onto = self.basis / self.root[:, None], self.basis.T * self.root
            rest = np.tensordot(onto, plane - out, axes=1)
            out += np.tensordot(back, rest, axes=1).astype(out.dtype)
        return out, float(np.sqrt(power))

    def spread(self, covariance: Float) -> Float:
        """Covariance (C, C) of the leakage of a pixel, the mean over some of the pixels with data."""
        n, m = self.place.shape[1], self.freq.shape[1]
        pixels = np.flatnonzero(self.good)
        some = pixels[:: max(len(pixels) // SAMPLE, 1)]
        place = self.place[some]
        each = np.einsum("ni,aibj,nj->nab", place, covariance.reshape(2 * m, n, 2 * m, n), place, optimize=True)
        values, vectors = np.linalg.eigh(each)
        half = (vectors * np.sqrt(np.maximum(values, 0.0))[:, None]).reshape(-1, 2, m, 2 * m)
        templates = [self.given[s].reshape(len(self.given), -1)[:, some, None].astype(float) for s in ("Q", "U")]
        error = sum(x * np.einsum("cp,npk->cnk", self.freq, half[:, s]) for s, x in enumerate(templates))
        flat = np.asarray(error).reshape(len(self.given), -1)
        return np.asarray(flat @ flat.T) / len(some)


def _root_weights(given: StokesMaps) -> Float:
    """One over the noise of each channel (C,), of mean 1; all 1 where it cannot be measured."""
    try:
        noise = given.noise()
    except InputError:
        return np.ones(len(given))
    if not noise.min() > 0:
        return np.ones(len(given))
    return np.asarray((1 / noise) / (1 / noise).mean())


def _patches(given: StokesMaps) -> Int:
    """Which patch each pixel is in (N,): squares of three beams, or larger."""
    beam = given.psf.major_rad if given.psf is not None else np.zeros(1)
    wide = float(np.nanmedian(beam)) / given.pixel_rad if np.isfinite(beam).any() else 0.0
    which = []
    for count in given.plane.shape[1:]:
        along = int(np.clip(count / (BEAMS * max(wide, 1.0)), LEAST, SIDE))
        which.append(np.arange(count) * along // count)
    return np.asarray((which[0][:, None] * SIDE + which[1]).ravel())
