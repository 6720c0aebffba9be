"""Cases of foreground removers: what looks like a foreground, equal eigenvalues, no noise, one voxel of 1e12."""

from __future__ import annotations

import numpy as np

from instrument.errors import InputError, Outcome
from instrument.foreground.base import ForegroundRemover
from instrument.foreground.loss import signal_loss
from instrument.foreground.maps import Usable
from instrument.image.cube import StokesCube
from instrument.stress.case import Answer, Unfit, both, case, claim, held
from instrument.units import Float

FREQ = np.linspace(134e6, 166e6, 41)


def _cube(remover: ForegroundRemover, maps: Float) -> StokesCube:
    """A cube that holds maps (F, Ny, Nx) in the Stokes parameter of a remover; noise of 1e-3 in the others."""
    from astropy import units as u

    data = np.random.default_rng(9).normal(0, 1e-3, (len(maps), 4, *maps.shape[1:]))
    data[:, "IQUV".index(remover.stokes)] = maps
    return StokesCube(data, u.Quantity(FREQ, "Hz"), 2 * u.arcmin, "K", constants="data")


def _plane(remover: ForegroundRemover, maps: Float) -> Float:
    split = remover.split(_cube(remover, maps))
    if split.outcome is not Outcome.CONVERGED:
        raise Unfit(f"{split.outcome.name}: {split.remark}")
    return np.asarray(split.residual.data[:, "IQUV".index(remover.stokes)])


def _smooth(sizes: tuple[float, ...] = (1.0, 0.3), shape: tuple[int, int] = (20, 22)) -> Float:
    """Power laws of random maps of these sizes, (F, Ny, Nx)."""
    images = np.random.default_rng(0).standard_normal((len(sizes), *shape))
    laws = [(FREQ / 150e6) ** (-2.55 + 0.7 * k) for k in range(len(sizes))]
    return np.asarray(sum(a * np.multiply.outer(law, m) for a, law, m in zip(sizes, laws, images, strict=True)))


def _noise(scale: float) -> Float:
    return np.random.default_rng(1).normal(0, scale, (len(FREQ), 20, 22))


def _takes_smooth(remover: ForegroundRemover) -> Float:
    """Smooth foregrounds with noise of 1e-3; a remover that leaves them has another aim."""
    maps = _smooth() + _noise(1e-3)
    if _plane(remover, maps).std() > 0.1 * maps.std():
        raise Unfit("it does not take smooth foregrounds away")
    return maps


@case("61", "foregrounds", "a signal shaped like the foreground", "loss 1.0 is reported, to 0.01")
def alike(remover: ForegroundRemover) -> Answer:
    """The first component again, a tenth as strong."""
    maps = _takes_smooth(remover)
    like = _cube(remover, 0.1 * _smooth((1.0,)))
    loss = signal_loss(remover, _cube(remover, maps), like, taper=None)
    transfer, _ = loss.within((0.0, 1e3), (0.0, 1e3))
    return Answer(abs(transfer), 0.01)


@case(
    "62", "foregrounds", "two eigenvalues 1e-12 apart", "the same cube is left, to 1e-6, whichever vectors were found"
)
def equal_values(remover: ForegroundRemover) -> Answer:
    """Two orthogonal spectra and maps of one size; and the second larger by 1e-12 and channels in another order."""
    rng = np.random.default_rng(4)
    spectra = np.linalg.qr(np.stack([(FREQ / 150e6) ** -2.55, (FREQ / 150e6) ** -2.0], axis=1))[0]
    images = np.linalg.qr(rng.standard_normal((440, 2)))[0].T.reshape(2, 20, 22) * 100
    found = []
    for more in (1.0, 1 + 1e-12):
        maps = np.multiply.outer(spectra[:, 0], images[0]) + more * np.multiply.outer(spectra[:, 1], images[1])
        found.append(_plane(remover, maps + _noise(1e-3)))
    return held(found[1], found[0], 1e-6, scale=float(np.abs(maps).max()))


@case("63", "foregrounds", "noise going to 0", "at most 1e-3 left; a Gaussian process states its jitter")
def no_noise(remover: ForegroundRemover) -> Answer:
    """Smooth foregrounds alone."""
    _takes_smooth(remover)
    split = remover.split(_cube(remover, _smooth()))
    left = split.residual.data[:, "IQUV".index(remover.stokes)]
    if split.outcome is not Outcome.CONVERGED:
        raise Unfit(f"{split.outcome.name}: {split.remark}")
    given = Usable.of(_cube(remover, _smooth()), remover.stokes, remover.planes).maps
    inverts = remover.separate(given).covariance is not None  # a Gaussian process
    told = claim("jitter" in split.remark or not inverts, f"no jitter in '{split.remark}'")
    return both(Answer(float(np.abs(left).max() / np.abs(_smooth()).max()), 1e-3), told)


@case("64", "foregrounds", "an injection twice as large", "linear removers: the same loss, to 1e-9")
def twice(remover: ForegroundRemover) -> Answer:
    """The operators with and without the signal are compared first: one that adapts to it is not linear."""
    maps, signal = _smooth() + _noise(1e-3), _noise(0.1)[::-1]
    cubes = [_cube(remover, maps + k * signal) for k in (0, 1)]
    found = [remover.separate(Usable.of(c, remover.stokes, remover.planes).maps).operator for c in cubes]
    if found[0] is None or found[1] is None or not np.allclose(found[0], found[1], rtol=0, atol=1e-10):
        raise Unfit("it adapts to the data")
    losses = [signal_loss(remover, cubes[0], _cube(remover, k * signal)).transfer for k in (1, 2)]
    return held(np.nan_to_num(losses[1]), np.nan_to_num(losses[0]), 1e-9)


@case("FR1", "foregrounds", "a cube of zeros", "zeros are left, no NaN")
def zeros(remover: ForegroundRemover) -> Answer:
    """In the Stokes parameter of the remover."""
    left = remover.split(_cube(remover, np.zeros((41, 20, 22)))).residual.data[:, "IQUV".index(remover.stokes)]
    return claim(np.array_equal(left, np.zeros((41, 20, 22))), "more or less than nothing is left")


@case("FR2", "foregrounds", "times 2^20 and -2^-20", "what is left is scaled exactly, to 1e-10 at most")
def scaled(remover: ForegroundRemover) -> Answer:
    """All Stokes parameters."""
    cube = _cube(remover, _smooth() + _noise(1e-3))
    s = "IQUV".index(remover.stokes)
    due = remover.split(cube).residual.data[:, s]
    return both(
        *(
            held(remover.split(cube.with_data(cube.data * k)).residual.data[:, s] / k, due, 1e-10)
            for k in (2.0**20, -(2.0**-20))
        )
    )


@case("FR3", "foregrounds", "foreground of rank 1 and no noise", "at most 1e-6 of it left, no NaN")
def rank_one(remover: ForegroundRemover) -> Answer:
    """More components are asked for than there are; fixed spectra, of which none is a power law, have no rank."""
    if not hasattr(remover, "components"):
        raise Unfit("it has no number of components")
    _takes_smooth(remover)
    maps = _smooth((1.0,))
    return held(_plane(remover, maps), np.zeros(1), 1e-6, scale=float(np.abs(maps).max()))


@case("FR4", "foregrounds", "one voxel column of 1e12", "elsewhere not 10 % more is left than without it")
def bright(remover: ForegroundRemover) -> Answer:
    """A pixel that a mask would take; what is left elsewhere."""
    maps = _takes_smooth(remover)
    spoilt = maps.copy()
    spoilt[:, 4, 5] = 1e12 * (FREQ / 150e6) ** -2.55
    elsewhere = np.ones(maps.shape[1:], bool)
    elsewhere[4, 5] = False
    due, found = (float(_plane(remover, m)[:, elsewhere].std()) for m in (maps, spoilt))
    return Answer(max(found / due - 1, 0.0), 0.1, condition=1e15)


@case(
    "FR5", "foregrounds", "a signal that is white along frequency", "0.85 to 1.05 of it comes through beyond 0.15 /Mpc"
)
def eaten(remover: ForegroundRemover) -> Answer:
    """A hundredth of the foreground; noise of a thousandth: no smooth foreground reaches so far."""
    maps = _takes_smooth(remover)
    signal = np.random.default_rng(5).normal(0, 1e-2, maps.shape)
    loss = signal_loss(remover, _cube(remover, maps), _cube(remover, signal))
    transfer, _ = loss.within((0.15, 1e3))
    return claim(0.85 < transfer < 1.05, f"transfer {transfer:.3f}", f"transfer {transfer:.3f}")


@case(
    "FR6",
    "foregrounds",
    "a pixel of NaN, a channel of NaN, voxels beyond 1e200",
    "NaN there, the rest as ever; refused",
)
def holes(remover: ForegroundRemover) -> Answer:
    """The pixel and the channel cut out change what is left elsewhere by less than the noise."""
    maps = _smooth() + _noise(1e-3)
    spoilt = maps.copy()
    spoilt[:, 3, 4] = np.nan
    spoilt[17] = np.nan
    left, whole = _plane(remover, spoilt), _plane(remover, maps)
    blank = np.isnan(left[:, 3, 4]).all() and np.isnan(left[17]).all() and np.isnan(left).sum() == 41 + 439
    rest = np.delete(left - whole, 17, axis=0)
    moved = float(np.sqrt(np.nanmean(rest**2)) / max(1e-3, float(np.abs(whole).std())))
    told = []
    for sign in (1, -1):
        try:
            remover.split(_cube(remover, sign * np.abs(maps) * 1e200))
            told.append("taken")
        except InputError:
            told.append("refused")
    return claim(blank and moved < 0.5 and told == ["refused"] * 2, f"blank {blank}, moved {moved:.2g}, {told}")
