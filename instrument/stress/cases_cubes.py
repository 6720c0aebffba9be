"""Cases of Faraday depth and of power spectra: bands and cubes that trip sums over channels up."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.analyze.analyzer import Analyzer
from instrument.analyze.faraday.band import FaradayBand
from instrument.image.cube import StokesCube
from instrument.observe.directions import LIGHT
from instrument.stress.bench import points, references
from instrument.stress.case import Answer, both, case, claim, held, not_there
from instrument.units import Complex, Float

BAND: Float = 134e6 + 1e6 * np.arange(33.0)
EVEN: Float = 150e6 + 0.4e6 * np.arange(64.0)
DEPTHS = np.linspace(-50, 50, 201)


def cube(planes: dict[str, Float], freq_hz: Float) -> StokesCube:
    """A cube of some Stokes parameters (F, Ny, Nx), pixels of 2 arcmin; the others are zero."""
    from astropy import units as u

    shape = next(iter(planes.values())).shape
    data = np.zeros((shape[0], 4, *shape[1:]))
    for name, plane in planes.items():
        data[:, "IQUV".index(name)] = plane
    return StokesCube(data, u.Quantity(freq_hz, "Hz"), 2 * u.arcmin, "K", constants="data")


def _faraday(p: Complex, freq_hz: Float, depths: Float = DEPTHS, **settings: Any) -> Any:
    planes: dict[str, Any] = {"Q": p.real[:, None, None], "U": p.imag[:, None, None]}
    return Analyzer(cube(planes, freq_hz)).rm_synthesis(depths, precision="double", **settings)


def _squares(freq_hz: Float) -> Float:
    return np.asarray((LIGHT / freq_hz) ** 2)


def _screens(depths: Float, flux: Float) -> complex:
    """Q + iU at 150 MHz of points in one place with these rotation measures, angle 0 at infinite frequency."""
    far = 1e15  # lambda^2 of 9e-14 m2
    stokes = np.zeros((len(depths), 4))
    stokes[:, 1] = flux
    reference = {"reference_hz": np.full(len(depths), far), "rotation_measure": depths}
    found = points(np.zeros(len(depths)), 0.0, stokes, **reference).stokes(np.array([150e6]))
    total = np.asarray(found).reshape(-1, 4).sum(axis=0)
    return complex(total[1], total[2])


@case("51", "faraday-depth", "a Burn slab of 8 rad/m2 at 150 MHz", "sin(x)/x, x = phi lambda^2, to 1e-11")
def burn(_: None) -> Answer:
    """64 screens at the nodes of Gauss and Legendre."""
    x, weight = np.polynomial.legendre.leggauss(64)
    return held(abs(_screens(4 * (x + 1), weight / 2)), abs(references()["burn"]), 1e-11, scale=1.0)


@case("55", "faraday-depth", "rotation measures scattered by 0.1 rad/m2", "exp(-2 sigma^2 lambda^4), to 1e-11")
def scatter(_: None) -> Answer:
    """40 screens at the nodes of Gauss and Hermite."""
    x, weight = np.polynomial.hermite.hermgauss(40)
    found = abs(_screens(np.sqrt(2) * 0.1 * x, weight / np.sqrt(np.pi)))
    return held(found, references()["scatter"], 1e-11)


@case("52", "faraday-depth", "two channels", "every phi + n pi / d(lambda^2) is listed, at height 1, to 1e-6")
def two_channels(_: None) -> Answer:
    """150 and 151 MHz: depths come back after 59 rad/m2."""
    from astropy import units as u

    freq = np.array([150e6, 151e6])
    turn = np.pi / abs(np.diff(_squares(freq))[0])
    found = sorted(depth for depth, height in FaradayBand.of(freq * u.Hz).aliases(5.5 * turn) if height > 0.99)
    positive = [d for d in found if d > 0]
    if len(positive) != 5:
        return claim(False, f"{len(positive)} aliases of 5: {', '.join(f'{d:.4g}' for d in found)}")
    return held(positive, turn * np.arange(1, 6), 1e-6)


@case("54", "faraday-depth", "constant Q = epsilon I", "exactly epsilon R(phi), to 1e-12")
def instrumental(_: None) -> Answer:
    """What does not turn with lambda^2."""
    found = _faraday(np.full(len(BAND), 0.01 + 0j), BAND)
    due = 0.01 * np.exp(-2j * np.outer(DEPTHS, _squares(BAND) - found.lambda2_0)).mean(axis=1)
    return both(held(found.data[:, 0, 0], due, 1e-12), held(0.01 * found.rmsf_at(DEPTHS), due, 1e-12))


@case("RM1", "faraday-depth", "one channel", "abs(F) = abs(P) at every depth, RMSF 1, FWHM infinite")
def one_channel(_: None) -> Answer:
    """No band at all."""
    found = _faraday(np.array([3 - 4j]), BAND[:1])
    sizes = both(held(np.abs(found.data), 5.0, 1e-13), held(found.rmsf_at(DEPTHS), 1.0, 1e-13))
    return both(sizes, claim(not np.isfinite(found.fwhm), f"FWHM {found.fwhm:.3g}"))


@case("RM2", "faraday-depth", "a channel of NaN, and one of weight 0", "the cube without it, to 1e-12, lambda^2_0 too")
def no_channel(_: None) -> Answer:
    """Channel 7 of a source at 20 rad/m2."""
    p = np.exp(2j * 20 * _squares(BAND))
    holed = p.copy()
    holed[7] = np.nan
    weight = np.ones(len(BAND))
    weight[7] = 0
    due = _faraday(np.delete(p, 7), np.delete(BAND, 7))
    found = [_faraday(holed, BAND), _faraday(p, BAND, weights=weight)]
    middle = [held(f.lambda2_0, due.lambda2_0, 1e-14) for f in found]
    return both(*(held(f.data, due.data, 1e-12) for f in found), *middle)


@case("RM3", "faraday-depth", "1 beside 1e6 in one spectrum", "the weak one within 1e-9 of itself, side lobes included")
def beside(_: None) -> Answer:
    """1e6 at -30 and 1 at 20 rad/m2: against the plain sum in extended precision."""
    x = _squares(BAND).astype(np.longdouble)
    p = 1e6 * np.exp(-60j * x) + np.exp(40j * x)
    found = _faraday(p.astype(complex), BAND)
    at = 140  # 20 rad/m2
    due = (p * np.exp(-2j * DEPTHS[at] * (x - np.longdouble(found.lambda2_0)))).mean()
    return held(found.data[at, 0, 0], complex(due), 1e-9, scale=1.0, condition=1e6)


@case("RM4", "faraday-depth", "depths and channels in any order, one depth", "the same F at the same phi, to 1e-12")
def any_order(_: None) -> Answer:
    """The order of a sum is not its value."""
    p = np.exp(2j * 7.5 * _squares(BAND))
    due = _faraday(p, BAND).data[:, 0, 0]
    order = np.random.default_rng(1).permutation(len(DEPTHS))
    answers = [held(_faraday(p, BAND, DEPTHS[o]).data[:, 0, 0], due[o], 1e-12) for o in (order, order[:1])]
    back = _faraday(p[::-1], BAND[::-1], DEPTHS[::-1]).data[::-1, 0, 0]
    return both(*answers, held(back, due, 1e-12))


# Power spectra ------------------------------------------------------------------------------------------------------


def _noise(shape: tuple[int, ...] = (64, 16, 16), seed: int = 0) -> Float:
    return np.random.default_rng(seed).normal(size=shape)


def _tone(delay_bins: float, waves: int = 3) -> Float:
    """A wave of so many turns over the band and over the image."""
    f, x = np.arange(64) / 64, np.arange(16) / 16
    return np.cos(2 * np.pi * (delay_bins * f[:, None, None] + waves * x)) * np.ones((1, 16, 1))


@case("56", "spectra", "a tone between two bins of delay", "below the side lobes of the taper (-92 dB) 6 bins away")
def between_bins(_: None) -> Answer:
    """10.5 turns over 64 channels, Blackman-Harris."""
    made = [Analyzer(cube({"I": _tone(t)}, EVEN)).cylindrical(log=False, bins=4) for t in (10.0, 10.5)]
    whole, power = (np.nansum(m.power, axis=0) for m in made)
    turns = np.round(made[0].k_par / made[0].k_par[1]).astype(int)
    far = np.abs(turns - 10.5) > 6
    return Answer(float(power[far].max() / whole.max()), 10**-9.2)


@case("57", "spectra", "noise split in two, one half across the other", "mean 0 within 3 sigma, chi^2 1 +- 0.1")
def split_noise(_: None) -> Answer:
    """Cells of white noise: the variance of the real part is half the square of the power, a mode."""
    halves = [cube({"I": _noise((64, 32, 32), seed)}, EVEN) for seed in (1, 2)]
    same: dict[str, Any] = {"taper": None, "log": False, "bins": 8}
    auto = Analyzer(halves[0]).cylindrical(**same)
    crossed = Analyzer(halves[0]).cylindrical(cross=halves[1], **same)
    level = float(np.nansum(auto.power * auto.count) / auto.count.sum())
    with np.errstate(invalid="ignore"):
        modes = (auto.power / auto.sigma) ** 2
        pull = crossed.power / level * np.sqrt(2 * modes)
    use = np.isfinite(pull) & (modes > 4)
    mean, chi2 = float(pull[use].mean() * np.sqrt(use.sum())), float((pull[use] ** 2).mean())
    return claim(abs(mean) < 3 and abs(chi2 - 1) < 0.1, f"mean {mean:.2f} sigma, chi^2 {chi2:.3f}", f"chi^2 {chi2:.3f}")


@case("58", "spectra", "a point source on the horizon", "on the line of the wedge at 90 deg, within a delay bin")
def on_the_horizon(_: None) -> Answer:
    """The fringe of one baseline: u wavelengths at mid-band, a delay of u / nu0."""
    from astropy import units as u

    side = 256 * np.deg2rad(2 / 60)
    waves = 12
    middle = EVEN.mean()
    delay = waves / side / middle  # s
    turns = delay * (EVEN[1] - EVEN[0]) * 64
    f, x = np.arange(64) / 64, np.arange(256) / 256
    field = np.cos(2 * np.pi * (turns * f[:, None, None] + waves * x)) * np.ones((1, 256, 1))
    found = Analyzer(cube({"I": field}, EVEN)).cylindrical(log=False, bins=64)
    power = np.nan_to_num(found.power)
    i, j = np.unravel_index(int(power.argmax()), power.shape)
    step = found.k_par[1] - found.k_par[0]
    wedge = found.wedge(90 * u.deg)[i]
    return claim(abs(wedge - found.k_par[j]) <= step, f"k_par {found.k_par[j]:.4g}, the wedge has {wedge:.4g} /Mpc")


@case("59", "spectra", "channels reversed", "the same P, to 1e-12")
def backwards(_: None) -> Answer:
    """Noise of 64 channels."""
    field = _noise()
    one, other = (Analyzer(cube({"I": x}, f)).cylindrical() for x, f in ((field, EVEN), (field[::-1], EVEN[::-1])))
    return held(np.nan_to_num(other.power), np.nan_to_num(one.power), 1e-12)


@case("60", "spectra", "30 % of the channels missing", "refused: no spectrum of what is not there", refusal=True)
def gaps(_: None) -> Answer:
    """Without an infill asked for."""
    keep = np.random.default_rng(2).random(64) > 0.3
    Analyzer(cube({"I": _noise()[keep]}, EVEN[keep])).cylindrical()
    return claim(False, "a spectrum came out")


@case("PS1", "spectra", "white noise", "Parseval: sum of P over all cells is the variance, to 1e-12")
def parseval(_: None) -> Answer:
    """No taper, all cells but k = 0."""
    field = _noise((32, 15, 16))
    found = Analyzer(cube({"I": field}, EVEN[:32])).cylindrical(taper=None, log=False)
    frame = found.frame
    volume = (frame.distance_mpc * np.deg2rad(2 / 60)) ** 2 * frame.depth_mpc_per_hz * 0.4e6
    total = float(np.nansum(found.power * found.count)) / volume / field.size
    counted = claim(found.count.sum() == field.size, f"{found.count.sum()} of {field.size} cells counted")
    return both(held(total, field.var(), 1e-12), counted)


@case("PS2", "spectra", "a cube of zeros", "power 0, not NaN, wherever a bin has cells")
def zeros(_: None) -> Answer:
    """Nothing is nothing."""
    found = Analyzer(cube({"I": np.zeros((64, 16, 16))}, EVEN)).cylindrical()
    return claim(bool((found.power[found.count > 0] == 0).all()), "NaN, or more than nothing")


@case("PS3", "spectra", "1e12 in one voxel", "flat: A^2 V_cell / N in every cell, to 1e-12")
def one_voxel(_: None) -> Answer:
    """The transform of an impulse."""
    field = np.zeros((32, 16, 16))
    field[5, 3, 11] = 1e12
    found = Analyzer(cube({"I": field}, EVEN[:32])).cylindrical(taper=None)
    power = found.power[found.count > 0]
    frame = found.frame
    volume = (frame.distance_mpc * np.deg2rad(2 / 60)) ** 2 * frame.depth_mpc_per_hz * 0.4e6
    return held(power, np.full(power.shape, 1e24 * volume / field.size), 1e-12)


MISSING = (
    not_there("53", "faraday-depth", "two components 0.7 FWHM apart", "called unresolved", "peaks are of one source"),
    not_there(
        "60b", "spectra", "30 % gaps filled in, 1e5:1 foreground", "the floor is stated", "infill states no floor"
    ),
)
