"""Cases of what foreground removers share: covariances, noise, projections, scores, loss."""

from __future__ import annotations

import numpy as np

from instrument.foreground.linear import covariance, leading, pinv, principal, projection
from instrument.foreground.loss import SignalLoss
from instrument.foreground.maps import Usable
from instrument.foreground.noise import delay, noise_power
from instrument.foreground.score import Cut, estimated_score, true_score
from instrument.stress.case import Answer, both, case, claim, held
from instrument.stress.cases_power import STEP, cube_of, mpc, taper_of
from instrument.units import Float

# What removers share ------------------------------------------------------------------------------------------------


def _maps(
    seed: int = 0, size: float = 1.0, shape: tuple[int, int] = (24, 26), channels: int = 81
) -> tuple[Float, Float, Float]:
    """Frequencies, a foreground of two power laws and white noise of 0.01 (F, Ny, Nx)."""
    rng = np.random.default_rng(seed)
    freq = np.linspace(134e6, 166e6, channels)
    laws = np.stack([(freq / 150e6) ** -2.55, (freq / 150e6) ** -2.0])
    fields = np.cumsum(np.cumsum(rng.normal(size=(2, *shape)), axis=1), axis=2)
    fields /= fields.std(axis=(1, 2), keepdims=True)
    return freq, size * np.einsum("kf,kyx->fyx", laws, fields), 0.01 * rng.normal(size=(channels, *shape))


@case(
    "FG1",
    "spectra",
    "covariances, eigenvectors, projections of maps",
    "numpy's of the voxels, to 1e-10; 1e-6 beside 1 found",
)
def algebra(_: None) -> Answer:
    """Holes count nowhere; a component of 1e-6; equal columns; the foreground of a projection on two laws."""
    from instrument.errors import Outcome

    freq, smooth, noise = _maps()
    maps = smooth + noise
    maps[:, 4:6, 7] = 0
    x = maps.reshape(81, -1)[:, maps.any(axis=0).ravel()]
    found = covariance(maps)
    values, vectors = np.linalg.eigh(found)
    one, spectra_ = leading(found, 3)
    rng = np.random.default_rng(5)
    basis = np.linalg.qr(rng.normal(size=(81, 3)))[0]
    faint = np.einsum("fk,k,kyx->fyx", basis, [1.0, 1e-3, 1e-6], rng.normal(size=(3, 24, 26)))
    power, seen = principal(faint, 3)
    inside = np.linalg.norm(seen.T @ basis[:, 2])
    columns = np.stack([(freq / 150e6) ** -2.55, (freq / 150e6) ** -2.0, 2 * (freq / 150e6) ** -2.0], 1)
    split = projection(maps, columns, Outcome.CONVERGED, "")
    q = np.linalg.qr(columns[:, :2])[0]
    due = np.einsum("fk,gk,gyx->fyx", q, q, maps)
    matrix = rng.normal(size=(5, 5))
    square = matrix @ matrix.T
    mixed = np.einsum("fk,kyx->fyx", split.mixing, split.components)
    size = (np.asarray(split.components) ** 2).sum(axis=(1, 2))
    return both(
        held(found, x @ x.T / x.shape[1], 1e-12),
        held(covariance(maps, q), (np.eye(81) - q @ q.T) @ found @ (np.eye(81) - q @ q.T), 1e-10),
        held(one, values[::-1][:3], 1e-11),
        held(np.abs((spectra_ * vectors[:, ::-1][:, :3]).sum(axis=0)), 1.0, 1e-9),
        claim(inside > 1 - 1e-6 and np.all(np.diff(power) <= 0), f"the faint one: {inside}"),
        held(split.of(maps), due, 1e-9),
        held(pinv(square), np.linalg.inv(square), 1e-9),
        held(mixed, due, 1e-8),
        claim(bool((np.diff(size) <= 1e-9 * size[0]).all()), "their order"),
        claim(bool((split.mixing.sum(axis=0) > 0).all()), "their sign"),
        held((split.mixing**2).sum(axis=0), 1.0, 1e-12),
    )


@case(
    "FG2", "spectra", "noise of maps beside a foreground 100 times as large", "of every channel to 20 %, of all to 3 %"
)
def quiet(_: None) -> Answer:
    """Noise of 0.5 to 1.5 over the band, holes, an uneven channel; delay of 0.3 /Mpc."""
    freq, smooth, noise = _maps(1, 100.0, (40, 41), 161)
    ramp = np.linspace(0.5, 1.5, 161)
    maps = smooth + 100 * ramp[:, None, None] * noise
    power, shape = noise_power(maps, freq)
    _z, _d, per_hz = mpc(freq)
    rms = Usable.of(cube_of(maps, freq), "I").maps.noise()
    middle = slice(10, -10)
    twice = np.full(power.shape[1], 2.0)
    twice[0] = 1
    total = (power @ twice).sum() / 1640**2
    return both(
        Answer(float(np.abs(rms[middle] / ramp[middle] - 1).max()), 0.2),
        held(shape.mean(), 1.0, 1e-12),
        Answer(abs(np.sqrt((rms**2).mean() / (ramp**2).mean()) - 1), 0.04),
        Answer(abs(total / (ramp**2).mean() - 1), 0.04),
        held(delay(freq, 0.3), 0.3 * per_hz / (2 * np.pi), 1e-9),
    )


@case(
    "FG3",
    "spectra",
    "the score of a removal",
    "by hand with the truth; without it pulls of 0.6 to 1.5",
)
def score(_: None) -> Answer:
    """A projection on one law of two, whole and 0.1 of it; 14 noises; low delays, k_perp within limits."""
    freq, smooth, _n = _maps(2, 0.01, (14, 15))
    law = (freq / 150e6) ** -2.3
    cut = Cut(freq, STEP / 2, 0.06, (0.02, 0.5), "blackman-harris")
    _z, distance, per_hz = mpc(freq)
    most = int(np.floor(0.06 * per_hz / (2 * np.pi) * 81 * (freq[1] - freq[0]) * (1 + 1e-9)))
    rows = [0, *range(1, most + 1), *range(-most, 0)]
    sides = np.meshgrid(np.fft.fftfreq(14, STEP / 2), np.fft.fftfreq(15, STEP / 2), indexing="ij")
    inside = (np.hypot(*sides) * 2 * np.pi / distance > 0.02) & (np.hypot(*sides) * 2 * np.pi / distance < 0.5)
    answers, told = [], []
    for share in (1.0, 0.1):
        operator, pulls = share * np.outer(law, law) / (law @ law), []

        def applied(maps: Float, by: Float = operator) -> Float:
            return np.asarray(np.einsum("fg,gyx->fyx", by, maps))

        for seed in range(14):
            maps = smooth + 0.05 * np.random.default_rng(seed).normal(size=smooth.shape)
            true = true_score(smooth, applied(maps), cut)
            guess = estimated_score(maps, applied(maps), operator, None, cut, 0)
            pulls.append((guess.value - true.value) / guess.sigma)
            if seed < 3:
                lost, whole = (
                    np.abs(np.fft.fftn(x * taper_of(81)[:, None, None])) ** 2 for x in (smooth - applied(maps), smooth)
                )
                answers.append(held(true.value, lost[rows][:, inside].sum() / whole[rows][:, inside].sum(), 1e-9))
                again = estimated_score(maps, applied(maps), operator, applied, cut, seed)
                answers.append(Answer(abs(again.value - guess.value) / again.sigma, 4.0, graded=False))
        told.append(float(np.sqrt(np.mean(np.square(pulls)))))
        answers.append(claim(0.6 < told[-1] < 1.5, f"pulls {told}", f"pulls {told}"))
    return both(*answers)


@case(
    "FG4", "spectra", "the loss of a signal by hand", "transfer and power ratio of given spectra, over all cells within"
)
def loss(_: None) -> Answer:
    """Two by two bins; one empty; one without signal."""
    k = np.array([0.1, 0.3])
    made = SignalLoss(
        "",
        k,
        k,
        np.array([[4, 2], [0, 6]]),
        np.array([[8.0, 2], [np.nan, 1e-12]]),
        np.array([[2.0, 2], [np.nan, 5]]),
        np.array([[4.0, 1.5], [np.nan, 3]]),
        "K",
        "I",
    )
    inside = made.within((0.0, 1.0))
    low = made.within((0.2, 1.0), (0.0, 0.2))
    total = 8 * 4 + 2 * 2 + 6e-12
    return both(
        held(made.transfer[0], [0.5, 0.75], 1e-14),
        held(made.power_ratio[0], [0.25, 1.0], 1e-14),
        claim(np.isnan(made.transfer[1]).all(), f"{made.transfer}"),
        held(inside, [(16 + 3 + 18) / total, (8 + 4 + 30) / total], 1e-13),
        held(low, [0.75, 1.0], 1e-14),
    )
