"""Fits of elliptical Gaussians to places in an image: many single ones at once, and those of an island together."""

from __future__ import annotations

import time

import numpy as np

from instrument.units import Bool, Float, Int

STEPS = 40  # damped Gauss-Newton, of which a clean source takes 6 to 10
DONE = 1e-7  # change of the parameters, relative, at which a fit has ended


def gaussian(p: Float, y: Float, x: Float) -> Float:
    """A exp(-(a dy2 + 2 b dy dx + c dx2) / 2) of parameters (n, 6): A, y0, x0, a, b, c, at places (n, m)."""
    dy, dx = y - p[:, 1:2], x - p[:, 2:3]
    power = p[:, 3:4] * dy**2 + 2 * p[:, 4:5] * dy * dx + p[:, 5:6] * dx**2
    return p[:, :1] * np.exp(-0.5 * np.clip(power, -1.0, None))


def slopes(p: Float, y: Float, x: Float) -> Float:
    """Derivatives of `gaussian` by its parameters, (n, m, 6)."""
    dy, dx = y - p[:, 1:2], x - p[:, 2:3]
    g = gaussian(p, y, x)
    a, b, c = p[:, 3:4], p[:, 4:5], p[:, 5:6]
    unit = g / np.where(p[:, :1] == 0, 1.0, p[:, :1])
    each = (unit, g * (a * dy + b * dx), g * (b * dy + c * dx), -0.5 * g * dy**2, -g * dy * dx, -0.5 * g * dx**2)
    return np.stack(each, axis=-1)


def fit_many(start: Float, values: Float, y: Float, x: Float, use: Bool, free: int) -> tuple[Float, Bool]:
    """Least-squares parameters (n, 6) of n Gaussians, each in a window of its own (n, m), and which have converged.

    `use` (n, m) are the pixels that count. Of the parameters the first `free` are fitted: 3 for flux and place, 6 with
    the shape too; the others stay as they are.
    """
    p, damping = np.array(start, float), np.full(len(start), 1e-3)
    weight = use.astype(float)
    cost = (weight * (values - gaussian(p, y, x)) ** 2).sum(axis=1)
    done = np.zeros(len(p), bool)
    for _ in range(STEPS):
        todo = np.flatnonzero(~done)
        if not len(todo):
            break
        j = slopes(p[todo], y[todo], x[todo])[..., :free] * weight[todo, :, None]
        left = values[todo] - gaussian(p[todo], y[todo], x[todo])
        normal, right = np.einsum("nmi,nmj->nij", j, j), np.einsum("nmi,nm->ni", j, left)
        scale = np.einsum("nii->ni", normal)
        scale = np.where(scale > 0, scale, 1.0)
        damped = normal + damping[todo, None, None] * scale[:, :, None] * np.eye(free)
        step = np.linalg.solve(damped, right[..., None])[..., 0]
        new = p[todo].copy()
        new[:, :free] += step
        better = (weight[todo] * (values[todo] - gaussian(new, y[todo], x[todo])) ** 2).sum(axis=1)
        shaped = (new[:, 3] > 0) & (new[:, 3] * new[:, 5] > new[:, 4] ** 2)
        good = (better <= cost[todo]) & shaped
        small = np.abs(step) <= DONE * np.maximum(np.abs(p[todo, :free]), 1e-3)
        p[todo[good]], cost[todo[good]] = new[good], better[good]
        damping[todo] = np.where(good, damping[todo] / 5, damping[todo] * 8)
        done[todo] = small.all(axis=1) | (damping[todo] > 1e8)
    return p, done & (damping <= 1e8) | (cost == 0)


def fit_together(start: Float, values: Float, y: Float, x: Float, free: int, seconds: float) -> tuple[Float, bool]:
    """The same of n Gaussians that overlap, in the same pixels (m,); `False` where it took longer than `seconds`."""
    p, damping, began = np.array(start, float), 1e-3, time.perf_counter()
    places = np.broadcast_to(y, (len(p), len(y))), np.broadcast_to(x, (len(p), len(x)))
    cost, wanted = float(((values - gaussian(p, *places).sum(axis=0)) ** 2).sum()), len(p) * free
    for _ in range(4 * STEPS):
        if time.perf_counter() - began > seconds:
            return p, False
        j = np.moveaxis(slopes(p, *places)[..., :free], 0, 1).reshape(len(y), wanted)
        normal, right = j.T @ j, j.T @ (values - gaussian(p, *places).sum(axis=0))
        diagonal = normal.diagonal()
        damped = normal + damping * np.diag(np.where(diagonal > 0, diagonal, 1.0))
        step = np.linalg.lstsq(damped, right, rcond=None)[0].reshape(len(p), free)
        new = p.copy()
        new[:, :free] += step
        better = float(((values - gaussian(new, *places).sum(axis=0)) ** 2).sum())
        if better <= cost and np.all(new[:, 3] > 0) and np.all(new[:, 3] * new[:, 5] > new[:, 4] ** 2):
            small = bool(np.all(np.abs(step) <= DONE * np.maximum(np.abs(p[:, :free]), 1e-3)))
            p, cost, damping = new, better, damping / 5
            if small:
                break
        else:
            damping *= 8
            if damping > 1e8:
                break
    return p, True


def shares(p: Float, values: Float, y: Float, x: Float) -> Float:
    """Amplitudes (n, K) that Gaussians of unit height and these shapes (n, 6) take in K images (K, m), all at once."""
    one = p.copy()
    one[:, 0] = 1.0
    places = np.broadcast_to(y, (len(p), len(y))), np.broadcast_to(x, (len(p), len(x)))
    return np.asarray(np.linalg.lstsq(gaussian(one, *places).T, values.T, rcond=None)[0])


def windows(places: Int, half: int) -> tuple[Int, Int]:
    """Rows and columns (n, m) of square windows about places (n, 2)."""
    step = np.arange(-half, half + 1)
    y, x = (a.ravel() for a in np.meshgrid(step, step, indexing="ij"))
    return places[:, :1] + y, places[:, 1:] + x
