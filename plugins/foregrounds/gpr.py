"""Gaussian process regression along frequency: foreground and the rest told apart by their coherence in frequency."""

from __future__ import annotations

import numpy as np

from instrument.errors import Outcome
from instrument.foreground.base import ForegroundRemover, Separation
from instrument.foreground.linear import covariance, one_thread
from instrument.foreground.maps import StokesMaps
from instrument.units import Count, Float

# lengths in Hz of smooth emission, mode mixing and 21-cm signal (after Mertens et al. 2018, MNRAS 478, 3640)
LENGTHS = ((10e6, 300e6), (1e6, 10e6), (0.2e6, 1.5e6))
START = (50e6, 3e6, 0.6e6)
VARIANCES = (1e-10, 1e3)  # of the mean variance of a channel
NOISE = (1e-9, 3.0)
JITTER = 1e-9


class GaussianProcess(ForegroundRemover):
    """Foreground K_fg K^-1 X of K = RBF + Matern-3/2 (both foreground) + exponential (signal) + noise.

    Variances, lengths and noise, seven numbers, maximise the marginal likelihood of all lines of sight. It needs the
    maps only as C = X X^T / p: -2 ln L / p = ln det K + tr(K^-1 C), one Cholesky a step. It is known to take signal
    with the foreground: see the loss by injection (`signal_loss`), and `covariance` of the separation, the posterior
    covariance K_fg - K_fg K^-1 K_fg of a line of sight. Smooth emission may have lengths of 10 to 300 MHz, mode
    mixing 1 to 10, the signal 0.2 to 1.5.
    """

    iterations: Count = 200

    def separate(self, given: StokesMaps) -> Separation:
        """Posterior mean of the foreground."""
        maps, freq_hz = given.plane, given.freq_hz
        from scipy.linalg import cho_factor, cho_solve
        from scipy.optimize import minimize

        f = len(maps)
        if f < 2:
            return Separation.nothing(maps, Outcome.REFUSED, "one channel has no spectrum to tell a foreground by")
        found = covariance(maps)
        scale = float(np.trace(found)) / f
        found = found / scale
        apart = np.abs(freq_hz[:, None] - freq_hz)
        evaluations = 0

        def cost(theta: Float) -> tuple[float, Float]:
            nonlocal evaluations
            evaluations += 1
            parts, slopes = _kernels(theta, apart)
            total = sum(parts) + (np.exp(theta[6]) + JITTER) * np.eye(f)
            factor = cho_factor(total, lower=True)
            inverse = cho_solve(factor, np.eye(f))
            fit = inverse @ found
            inner = inverse - fit @ inverse
            gradient = [(inner * d).sum() for pair in zip(parts, slopes, strict=True) for d in pair]
            gradient.append(float(np.trace(inner)) * np.exp(theta[6]))
            return float(2 * np.log(np.diagonal(factor[0])).sum() + np.trace(fit)), np.array(gradient)

        bounds = [np.log(b) for lengths in LENGTHS for b in (VARIANCES, lengths)] + [np.log(NOISE)]
        options = {"maxiter": self.iterations, "ftol": 1e-14, "gtol": 1e-7}
        with one_thread():
            # from signal and noise of a tenth and from what the weakest spectra hold: noise of 1 mK beside 1 K is a
            # millionth, and from 0.1 the search ended at a hundredth of it, or not, by the last bit
            weakest = float(np.clip(np.median(np.linalg.eigvalsh(found)[: max(f // 4, 1)]), NOISE[0], 0.1))
            starts = [[v for length in START for v in (0.3, length)] + [0.1],
                      [0.3, START[0], 0.1 * (0.3 * weakest) ** 0.5, START[1], weakest, START[2], weakest]]  # fmt: skip
            ends = [minimize(cost, np.log(s), jac=True, method="L-BFGS-B", bounds=bounds, options=options)
                    for s in starts]  # fmt: skip
            done = min(ends, key=lambda end: end.fun)
            parts, _ = _kernels(done.x, apart)
            fg = parts[0] + parts[1]
            total = fg + parts[2] + (np.exp(done.x[6]) + JITTER) * np.eye(f)
            gain = np.linalg.solve(total, fg).T
        # status 2 is a line along which nothing but rounding of the likelihood is left
        outcome = Outcome.ITERATION_LIMIT if done.status == 1 else Outcome.CONVERGED
        rms = np.sqrt(scale * np.exp(done.x[[0, 2, 4, 6]]))
        text = "rms smooth {:.3g}, mixing {:.3g}, signal {:.3g}, noise {:.3g}".format(*rms)
        rms_jitter = np.sqrt(scale * JITTER)
        none = np.zeros((0, *maps.shape[1:]), maps.dtype)
        return Separation(
            outcome, f"{text}; {evaluations} likelihoods; jitter {rms_jitter:.1g}", np.zeros((f, 0)), none,
            operator=gain, covariance=scale * (fg - gain @ fg),
        )  # fmt: skip


def _kernels(theta: Float, apart: Float) -> tuple[list[Float], list[Float]]:
    """RBF, Matern-3/2 and exponential kernels (F, F), each also its derivative to its ln variance; and to ln length."""
    v, x = np.exp(theta[[0, 2, 4]]), [apart / np.exp(t) for t in theta[[1, 3, 5]]]
    root3 = np.sqrt(3.0) * x[1]
    rbf, mixing, signal = np.exp(-0.5 * x[0] ** 2), np.exp(-root3), np.exp(-x[2])
    parts = [v[0] * rbf, v[1] * (1 + root3) * mixing, v[2] * signal]
    return parts, [parts[0] * x[0] ** 2, v[1] * root3**2 * mixing, parts[2] * x[2]]
