"""Every registered plugin keeps its contract, and every claim of the contract can fail."""

import subprocess
import sys
from dataclasses import replace
from typing import Annotated, Any, ClassVar

import numpy as np
import pytest
from astropy import units as u
from pydantic import PlainSerializer, PrivateAttr

import instrument
from instrument import (
    Chain,
    Composed,
    FeedTerm,
    GainTerm,
    Parallactic,
    PointSky,
    ScalarTerm,
    Simplified,
    StationBeam,
    Towards,
)
from instrument.component import Component
from instrument.conformance import Report, check
from instrument.conformance.bench import bench, hard_places, lofar_like, random_sky
from instrument.errors import InputError, InstrumentError, Outcome, RefusedError
from instrument.experiments.many_directions import ManyDirections
from instrument.foreground.base import ForegroundRemover
from instrument.foreground.linear import projection
from instrument.jones.base import ElementBeam, JonesTerm
from instrument.jones.station import ArrayFactor, Level
from instrument.mat2 import IDENTITY
from instrument.model import Instrument
from instrument.predict.base import Blockwise, Work
from instrument.predict.direct import Direct, DirectImages
from instrument.registry import KINDS, available, load

PLACES = [[3826577.1, 461022.9, 5064892.8], [3826653.1, 461098.9, 5064828.8], [3826703.1, 460922.9, 5064803.8]]
OF_FILES = (("stages", "data"), ("stages", "into"))
SETTINGS: dict[tuple[str, ...], list[dict[str, Any]]] = {
    ("elements", "airy"): [{"diameter": 25 * u.m}],
    ("elements", "dipole"): [{"height": 0.5 * u.m, "x_azimuth": 30 * u.deg}],
    ("elements", "gaussian"): [{"fwhm": 4 * u.deg}, {"fwhm": 4 * u.deg, "frequency": 150 * u.MHz}],
    ("elements", "hamaker"): [{"band": "hba"}, {"band": "lba"}],
    ("telescopes", "lofar-hba"): [
        {},
        {"tiles": "ideal", "reference_frequency": 150 * u.MHz},
        {"beam": "array-factor"},
        {"beam": "element", "phase": "everybeam"},
        {"beam": "element", "gain": GainTerm(rms=0.1), "feed": FeedTerm(rms=0.1)},
        {"beam": None, "gain": GainTerm(rms=0.1)},
    ],
    ("telescopes", "array"): [
        {"stations": ("A", "B", "C"), "positions_m": PLACES},
        {"stations": ("A", "B", "C"), "positions_m": PLACES, "element": {"kind": "dipole", "height": "1.5 m"}},
    ],
    ("telescopes", "lofar-lba"): [{}, {"antennas": "inner", "phase": "everybeam"}],
    ("foregrounds", "gmca"): [{}, {"paper": True, "stokes": "Q"}],
    ("foregrounds", "gmca", "long"): [{"mode": "threshold"}, {"noise": "white"}],
    ("foregrounds", "pca"): [{}, {"components": 0}, {"stokes": "V"}],
    ("foregrounds", "polynomial"): [{}, {"terms": 1}],
    ("foregrounds", "faraday-filter"): [{}, {"depth": 5 * u.rad / u.m**2}],
    ("skies", "grid"): [{}, {"shape": (4, 3), "polarization": (0.1, 0.2, 0.05), "spectral_index": -0.7}],
    ("terms", "table"): [
        {"values": np.full((1, 1, 1, 2, 2), 0.5j), "slots_s": np.zeros(1), "freq_hz": np.zeros(1)},
    ],
    ("terms", "gain"): [{}, {"rms": 0.1}],
    ("calibrators", "selfcal"): [{}],
    ("imagers", "dirty"): [
        {"pixels": 64, "pixel": 6 * u.arcmin},
        {"pixels": 64, "pixel": 6 * u.arcmin, "weighting": "briggs", "robust": 0.5, "accuracy": 1e-4},
    ],
    ("imagers", "beam"): [{"pixels": 32, "pixel": 8 * u.arcmin}],
    ("imagers", "clean"): [{"pixels": 32, "pixel": 8 * u.arcmin, "cycles": 4}],
    ("imagers", "clean", "long"): [{"peaks": "joint"}, {"terms": 1}, {"algorithm": "multiscale", "peaks": "I"}],
    ("stages", "noise"): [{"sefd": 100 * u.Jy, "seed": 1}],
    ("stages", "calibrate"): [{"calibrator": instrument.SelfCal(tolerance=1e-8)}],
    ("stages", "calibrate.incomplete-model"): [{"laboratory": instrument.IncompleteModel(models=(1, 3))}],
    ("stages", "calibrate.many-directions"): [
        {"laboratory": ManyDirections(clusters=2, calibrator=instrument.DirectionalCal(tolerance=1e-6))}
    ],
    ("stages", "image"): [{"imager": instrument.Imager(pixels=32, pixel=10 * u.arcmin)}],
    ("stages", "analyze"): [{}, {"products": ("leakage", "spectrum-2d")}],
    ("skies", "galaxy"): [
        {
            "pixels": 8,
            "pixel": 40 * u.arcmin,
            "screens": {"uv_range": (5, 800)},
            "noise": 1 * u.K,
            "discs": 2,
            "disc": 1 * u.deg,
        }
    ],
    ("skies", "synchrotron"): [{"pixels": 8, "pixel": 40 * u.arcmin}],
    ("skies", "signal-21cm"): [{"pixels": 8, "pixel": 1 * u.deg, "band": (112.5 * u.MHz, 175 * u.MHz), "channels": 6}],
    ("skies", "sum"): [
        {"near": {"kind": "grid", "shape": (2, 2)}, "far": {"kind": "faraday", "count": 9}},
        {"stars": {"kind": "random", "count": 7}, "both": {"kind": "sum", "a": {"kind": "grid", "shape": (3, 1)}}},
    ],
    ("skies", "random"): [{"polarization": 0.3, "circular": 0.1, "scatter": 0.2, "seed": 5}],
    ("skies", "mock-3c196"): [{"components": True, "scatter": 0.1}],
    ("skies", "catalogue"): [{"path": "3c196_pandey.skymodel"}, {"path": "mock_150mhz.csv", "brightest": 50}],
}
REGISTERED = [
    (kind, name, settings)
    for kind in KINDS
    for name in available(kind)
    for settings in SETTINGS.get((kind, name), [{}])
    # scikit-learn is needed, below; files, in tests/accuracy/test_skies_of_files.py and tests/unit/test_on_data.py
    if (kind, name) not in (("foregrounds", "ica"), *[("skies", name) for name in ("image", "healpix")], *OF_FILES)
]


@pytest.mark.parametrize(("kind", "name", "settings"), REGISTERED, ids=lambda x: x if isinstance(x, str) else "")
def test_every_registered_plugin_keeps_its_contract(kind, name, settings):
    found = load(kind, name, **settings)
    if kind == "telescopes" and "stations" in type(found).model_fields and name != "array":
        names = found.layout().names
        found = load(kind, name, **settings, stations=[*names[:3], names[-1]])
    report = check(found)
    assert report.passed, str(report)


@pytest.mark.long
@pytest.mark.parametrize("settings", SETTINGS["foregrounds", "gmca", "long"])
def test_the_other_ways_of_gmca_keep_their_contract(settings):
    report = check(load("foregrounds", "gmca", **settings))
    assert report.passed, str(report)


@pytest.mark.long
@pytest.mark.parametrize("settings", SETTINGS["imagers", "clean", "long"])
def test_the_other_ways_of_clean_keep_their_contract(settings):
    report = check(load("imagers", "clean", pixels=32, pixel=8 * u.arcmin, cycles=6, **settings))
    assert report.passed, str(report)


@pytest.mark.peer
def test_independent_components_keep_their_contract():
    pytest.importorskip("sklearn")
    report = check(load("foregrounds", "ica"))
    assert report.passed, str(report)


class Alternating(JonesTerm):
    """A table per station for arrays of two: fits a sampling that is given."""

    maps: ClassVar[Any] = ("feed", "feed")

    def jones(self, at):
        if len(at.layout) != 2:
            raise InputError("this term is for two stations")
        return np.array([1.0, 2.0]).reshape(1, 1, 2, 1, 1, 1) * IDENTITY


OFFSETS = np.random.default_rng(0).uniform(-10, 10, (1, 4, 3))


@pytest.mark.parametrize(
    "term",
    [
        GainTerm(),
        GainTerm(rms=0.1),
        GainTerm(values=np.full((1, 1, 1, 2), 2j)),
        FeedTerm(),
        FeedTerm(rms=0.1),
        Parallactic(),
        ArrayFactor(levels=(Level(offsets_m=OFFSETS),)),
        Towards(chain=Chain(ArrayFactor(levels=(Level(offsets_m=OFFSETS),)))),
        StationBeam(element=load("elements", "dipole", height=1 * u.m), levels=(Level(offsets_m=OFFSETS),)),
    ],
    ids=lambda term: type(term).__name__,
)
def test_the_terms_of_the_framework_keep_their_contract(term):
    report = check(term)
    assert report.passed, str(report)


def test_a_term_that_fits_one_array_is_checked_where_it_fits():
    assert not check(Alternating()).passed
    check(Alternating(), at=bench(layout=lofar_like().select(["S0", "S6"]))).raise_if_failed()


# Broken on purpose: each class breaks one claim ------------------------------------------------------------------


class Fine(ElementBeam):
    """The element that the broken ones below deviate from."""

    def jones(self, at):
        return self.up(at)[:, None, ..., None, None] * IDENTITY

    def up(self, at):
        return (at.zenith_angle < np.pi / 2) * np.cos(at.zenith_angle)


class UnknownWords(Fine):
    per_station: ClassVar[Any] = "sometimes"


class FiveAxes(Fine):
    def jones(self, at):
        return super().jones(at)[:, 0]


class NotComplex(Fine):
    def jones(self, at):
        return super().jones(at).real


class OneStationForAll(Fine):
    def jones(self, at):
        return super().jones(at)[:, :, :1]


class FirstTimeForAll(Fine):
    def jones(self, at):
        return super().jones(at)[:1]


class OneChannelForAll(Fine):
    def jones(self, at):
        return at.freq_hz[0] / 1e8 * super().jones(at)


class ScaledByItsLargest(Fine):
    def jones(self, at):
        found = super().jones(at)
        return found / max(np.abs(found).max(), 1e-9)


class NearlyScalar(Fine):
    structure: ClassVar[Any] = "scalar"

    def jones(self, at):
        return super().jones(at) * [[1, 0], [0, 0.9]]

    def scalar(self, at):
        return super().jones(at)[..., 0, 0]


class NearlyDiagonal(Fine):
    structure: ClassVar[Any] = "diagonal"

    def jones(self, at):
        return super().jones(at) @ np.array([[1, 1e-9], [0, 1]])


class CountsStations(Fine):
    def jones(self, at):
        return super().jones(at) * (1 + np.arange(len(at.layout)))[:, None, None, None]


class SaysShared(Fine):
    per_station: ClassVar[Any] = "shared"


class SaysReal(Fine):
    real: ClassVar[bool] = True

    def jones(self, at):
        return super().jones(at) * (1 + 1e-9j)


class SaysOneDirection(Fine):
    directional: ClassVar[bool] = False


class SeesTheGround(Fine):
    def up(self, at):
        return np.abs(np.cos(at.zenith_angle))


class NanAtTheZenith(Fine):
    def up(self, at):
        rho = np.hypot(at.local[..., 0], at.local[..., 1])
        with np.errstate(invalid="ignore"):
            return rho / rho * super().up(at)


class ChangesTheSampling(Fine):
    def jones(self, at):
        found = super().jones(at)
        at.itrf[...] = 0.0
        return found


class KeepsItsResult(Fine):
    _kept: dict[Any, Any] = PrivateAttr(default_factory=dict)

    def jones(self, at):
        return self._kept.setdefault(id(at), super().jones(at))


class DiffersEveryTime(Fine):
    _rng: Any = PrivateAttr(default_factory=np.random.default_rng)

    def jones(self, at):
        return super().jones(at) * self._rng.random()


class ForgetsAPart(Fine):
    def parts(self):
        return (GainTerm(), Fine())

    def jones(self, at):
        return 2 * super().jones(at)


class PartsThatDoNotMeet(Fine):
    def parts(self):
        return (self, GainTerm())


class OtherScalar(ScalarTerm):
    maps: ClassVar[Any] = ("feed", "feed")

    def scalar(self, at):
        return np.full((1, 1, 1, 1), 2.0 + 0j)

    def jones(self, at):
        return 3 * IDENTITY[None, None, None, None]


class LeavesItselfOut(Fine):
    def simplify(self, at, tolerance):
        return Simplified(None, "small", 0.0)


class PromisesTooMuch(Fine):
    def simplify(self, at, tolerance):
        return Simplified(None, "small", tolerance) if tolerance else Simplified(self, "", 0.0)


class LooseBound(Fine):
    def simplify(self, at, tolerance):
        return Simplified(self, "", 2 * tolerance)


class LosesDigits(Fine):
    tilt: Annotated[float, PlainSerializer(lambda value: round(value, 3), when_used="json")] = 0.12345


BROKEN_TERMS = [
    (UnknownWords(), "its declarations are known words"),
    (FiveAxes(), "its shape is times channels stations directions 2 2"),
    (NotComplex(), "its shape is times channels stations directions 2 2"),
    (OneStationForAll(), "an axis of length 1 is constant"),
    (FirstTimeForAll(), "an axis of length 1 is constant"),
    (OneChannelForAll(), "an axis of length 1 is constant"),
    (ScaledByItsLargest(), "a block equals the slice of the whole"),
    (NearlyScalar(), "its structure is true"),
    (NearlyScalar(), "its scalar agrees with its jones"),
    (NearlyDiagonal(), "its structure is true"),
    (CountsStations(), "its per station is true"),
    (SaysShared(), "its per station is true"),
    (SaysReal(), "its structure is true"),
    (SaysOneDirection(), "a term that is not directional has one direction"),
    (SeesTheGround(), "blindness below the horizon is exact"),
    (NanAtTheZenith(), "it is finite at zenith horizon nadir and pole"),
    (ChangesTheSampling(), "a call has no side effects"),
    (KeepsItsResult(), "a call has no side effects"),
    (DiffersEveryTime(), "a call has no side effects"),
    (ForgetsAPart(), "its parts multiply to its jones"),
    (PartsThatDoNotMeet(), "its parts multiply to its jones"),
    (OtherScalar(), "its scalar agrees with its jones"),
    (LeavesItselfOut(), "what simplify leaves keeps its bound"),
    (PromisesTooMuch(), "what simplify leaves keeps its bound"),
    (LooseBound(), "what simplify leaves keeps its bound"),
    (LosesDigits(), "a round trip through json gives an equal object"),
]


class Telescope(Instrument):
    """Takes its chain from a name, so that every way of being broken is one line."""

    how: str

    def layout(self):
        return lofar_like()

    def chain(self):
        rng = np.random.default_rng()
        return {
            "random": lambda: Chain(GainTerm(values=rng.random((1, 1, 1, 2)))),
            "no parallactic": lambda: Chain(Fine()),
            "starts at the horizon": lambda: Chain(Parallactic()),
            "nan": lambda: Chain(GainTerm(values=np.full((1, 1, 1, 2), 0.0))),
            "zero": lambda: Chain(GainTerm(values=np.zeros((1, 1, 1, 2)))),
            "other stations": lambda: Chain(GainTerm(values=np.ones((1, 1, 3, 2)))),
            "other factors": lambda: Chain(OtherScalar()),
            "changes the sampling": lambda: Chain(ChangesTheSampling(), Parallactic()),
            "bad term": lambda: Chain(SeesTheGround(), Parallactic()),
        }[self.how]()


BROKEN_TELESCOPES = [
    ("random", "its layout and chain are the same every time"),
    ("no parallactic", "its chain runs from sky to feed"),
    ("starts at the horizon", "its chain runs from sky to feed"),
    ("nan", "its chain is finite and not zero where risen"),
    ("zero", "its chain is finite and not zero where risen"),
    ("zero", "its differential beam is one at the pointing"),
    ("other stations", "its chain is finite and not zero where risen"),
    ("other factors", "the factors of its chain multiply to its jones"),
    ("changes the sampling", "a call of its chain has no side effects"),
    ("bad term", "SeesTheGround: blindness below the horizon is exact"),
]


class FineSky(PointSky):
    """A sky that the broken ones below deviate from."""


def a_sky(cls, **fields):
    inner = random_sky(bench().centre, polarized=True, gaussian=True)
    return cls(**{name: getattr(inner, name) for name in PointSky.model_fields}, **fields)


class Wanders(FineSky):
    _rng: Any = PrivateAttr(default_factory=np.random.default_rng)

    def about(self, centre):
        return self.with_fields(ra_rad=self.ra_rad + 1e-3 * self._rng.random())


class OffTheSphere(FineSky):
    def directions(self):
        return self.ra_rad, self.dec_rad + np.pi


class FourAxes(FineSky):
    def brightness(self, at):
        return super().brightness(at)[0]


class NanBrightness(FineSky):
    def brightness(self, at):
        return super().brightness(at) * np.nan


class NotHermitian(FineSky):
    def brightness(self, at):
        return super().brightness(at) @ np.array([[1, 0.1j], [0, 1]])


class BlockwiseSky(FineSky):
    def brightness(self, at):
        return super().brightness(at) * at.freq_hz.mean() / 1e8


class Amplifies(FineSky):
    def envelope(self, at, uvw_lambda):
        return 2 * super().envelope(at, uvw_lambda)


class HidesFlux(FineSky):
    def total_jy(self, freq_hz):
        return 0.99 * super().total_jy(freq_hz)


class KnowsNoV(FineSky):
    def nonzero(self, freq_hz):
        return (True, True, True, False)


class LosesARest(FineSky):
    def parts(self, most, freq_hz):
        return list(super().parts(most, freq_hz))[:-1]


class ChangesFrequencies(FineSky):
    def brightness(self, at):
        found = super().brightness(at)
        at.freq_hz[...] *= 2
        return found


BROKEN_SKIES = [
    (Wanders, "about a phase centre its directions are fixed"),
    (OffTheSphere, "about a phase centre its directions are fixed"),
    (FourAxes, "its brightness is times channels directions 2 2"),
    (NanBrightness, "its brightness is times channels directions 2 2"),
    (NotHermitian, "its brightness is hermitian"),
    (BlockwiseSky, "a block of its brightness equals the slice of the whole"),
    (Amplifies, "its envelope takes nothing off a baseline of zero"),
    (HidesFlux, "its total is that of its brightness"),
    (KnowsNoV, "stokes parameters that it says are zero are zero"),
    (LosesARest, "its parts are the whole"),
    (ChangesFrequencies, "a call of its brightness has no side effects"),
]


class RefusesAll(Direct):
    def refuses(self, problem):
        return "not today"


class RefusesSilently(Direct):
    def refuses(self, problem):
        return "" if problem.sky.kind == "other" else None


class TurnsFringes(Direct):
    def sums(self, problem):
        return super().sums(problem).conj()


class IgnoresTheOrderOfBaselines(Direct):
    def sums(self, problem):
        first, second = np.sort([problem.antenna1, problem.antenna2], axis=0)
        return super().sums(problem.between(first, second))


class ForgetsShapes(Direct):
    def sums(self, problem):
        points = dict.fromkeys(("major_rad", "minor_rad", "angle_rad"))
        sky = problem.sky.with_fields(**points) if problem.sky.kind == "points" else problem.sky
        return super().sums(type(problem)(**{**vars(problem), "sky": sky}))


class FirstTimeOnly(Direct):
    def sums(self, problem):
        one = super().sums(problem.block(slice(0, 1), slice(None)))
        return np.repeat(one, problem.shape[0], axis=0)


class OneSource(Direct):
    """Serves one problem of the bench: quick."""

    def refuses(self, problem):
        return None if problem.sky.count == 1 else "one source only"


class KnowsNoPairs(OneSource):
    def prepare(self, problem, tolerance):
        return _AllBaselines(self, problem)


class _AllBaselines(Blockwise):
    def sums(self, times, channels, pairs=None):
        found = super().sums(times, channels)
        return found if pairs is None else found[:, :, : len(pairs[0])]


class ConjugateAdjoint(Direct):
    def refuses(self, problem):
        return None if problem.sky.kind == "image" else "images only"

    def prepare(self, problem, tolerance):
        return _Conjugate(self, problem)


class _Conjugate(DirectImages):
    def adjoint(self, data, times, channels, pairs=None):
        return super().adjoint(data.conj(), times, channels, pairs)


class Drifting(OneSource):
    """Wrong by up to 3e-7, in a way that comes back with every atom of two times, and says so: sound."""

    claimed: tuple[int, int] = (2, 1)
    bound: float = 1e-6

    def prepare(self, problem, tolerance):
        if tolerance < self.bound:
            raise RefusedError(f"drifts by {self.bound:g}: give a tolerance of that")
        return _Drift(self, problem, self.bound, self.claimed)


class _Drift(Blockwise):
    def sums(self, times, channels, pairs=None):
        found = super().sums(times, channels, pairs)
        return found * (1 + 3e-7 * (np.arange(len(found)) % 2))[:, None, None, None, None]


class CostsNothing(Direct):
    def work(self, problem):
        return Work(0.0, 0.0, 1.0, 1.0)


class OtherInterval(Direct):
    def prepare(self, problem, tolerance):
        return _Seconds99(self, problem)


class _Seconds99(Blockwise):
    def predict(self, times, channels):
        return replace(super().predict(times, channels), interval_s=99.0)


class SortsAntennas(Direct):
    def sums(self, problem):
        found = super().sums(problem)
        problem.antenna1[...] = problem.antenna2
        return found


BROKEN_ENGINES = [
    (RefusesAll(), "it serves some problem and refuses others in a sentence"),
    (RefusesSilently(), "it serves some problem and refuses others in a sentence"),
    (TurnsFringes(), "it agrees with direct: one source"),
    (IgnoresTheOrderOfBaselines(), "it agrees with direct: an image, phased stations"),
    (ForgetsShapes(), "it agrees with direct: points and Gaussians, phased stations"),
    (FirstTimeOnly(), "a block of whole atoms equals the slice of the whole"),
    (KnowsNoPairs(), "some pairs of antennas have the sums they have among all"),
    (ConjugateAdjoint(), "its adjoint is that of its sums: an image, phased stations"),
    (Drifting(claimed=(1, 1)), "a block of whole atoms equals the slice of the whole"),
    (Drifting(bound=1e-8), "it agrees with direct: one source"),
    (CostsNothing(), "its work is positive and grows with the problem"),
    (OtherInterval(), "its visibilities carry their coordinates"),
    (SortsAntennas(), "a call of its sums has no side effects"),
]


class FineRemover(ForegroundRemover):
    """The remover that the broken ones below deviate from: four Legendre polynomials of frequency."""

    def separate(self, given):
        x = (given.freq_hz - 147.8e6) / 7.8e6
        basis = np.polynomial.legendre.legvander(x, 3)
        return projection(given.plane, basis, Outcome.CONVERGED, "four polynomials", adapted=False)


class OwnWords(FineRemover):
    def separate(self, given):
        return replace(super().separate(given), outcome="fine")


class TouchesOthers(FineRemover):
    def split(self, cube):
        return super().split(cube.with_data(cube.data * np.array([1, 1, 2, 1])[:, None, None]))


class AddsForeground(FineRemover):
    def separate(self, given):
        found = super().separate(given)
        return replace(found, mixing=-found.mixing, operator=-found.operator, basis=None)


class FillsHoles(FineRemover):
    def split(self, cube):
        return super().split(cube.with_data(np.nan_to_num(cube.data, posinf=0)))


class KnowsKelvin(FineRemover):
    def separate(self, given):
        found = super().separate(given)
        return replace(found, foreground=np.tanh(found.of(given.plane)), operator=None)


class CountsChannels(FineRemover):
    def separate(self, given):
        return super().separate(replace(given, freq_hz=np.linspace(140e6, 155.6e6, len(given))))


class FillsZeros(FineRemover):
    def split(self, cube):
        return super().split(cube if cube.data.any() else cube.with_data(cube.data + 1))


class WorksInPlace(FineRemover):
    def separate(self, given):
        maps = given.plane
        maps.setflags(write=True)
        maps *= 1.001
        return super().separate(given)


class ForgetsFields(FineRemover):
    _secret: int = PrivateAttr(0)

    def __eq__(self, other):
        return self is other

    __hash__ = None


BROKEN_REMOVERS = [
    (OwnWords(), "its separation is of known words and shapes"),
    (TouchesOthers(), "foreground and residual make up the cube"),
    (AddsForeground(), "it does not make a bright smooth foreground worse"),
    (FillsHoles(), "what has no data comes back as nan and changes nothing else"),
    (KnowsKelvin(), "it scales with the cube"),
    (CountsChannels(), "the order of channels does not matter"),
    (FillsZeros(), "a cube of zeros stays zero"),
    (WorksInPlace(), "a call of split has no side effects"),
    (ForgetsFields(), "a round trip through json gives an equal object"),
]

BROKEN = [
    *BROKEN_TERMS,
    *((Telescope(how=how), claim) for how, claim in BROKEN_TELESCOPES),
    *((a_sky(cls), claim) for cls, claim in BROKEN_SKIES),
    *BROKEN_ENGINES,
    *BROKEN_REMOVERS,
]


@pytest.mark.parametrize(("broken", "claim"), BROKEN, ids=lambda x: type(x).__name__ if not isinstance(x, str) else x)
def test_what_breaks_a_claim_is_caught_by_it(broken, claim):
    report = check(broken)
    assert claim in [line.claim for line in report.failed], str(report)


@pytest.mark.parametrize(
    "sound", [Fine(), a_sky(FineSky), Direct(), Drifting(), FineRemover()], ids=lambda x: type(x).__name__
)
def test_what_the_broken_ones_deviate_from_passes(sound):
    check(sound).raise_if_failed()


def test_every_claim_can_fail():
    telescope = Composed(stations=lofar_like(), terms=Chain(Fine(), Parallactic()))
    sound = (Fine(), telescope, a_sky(FineSky), Direct(), FineRemover())
    # "GainTerm: a claim" and "a claim: of which problem" are that claim
    claimed = [set(line.claim.split(": ")) for obj in sound for line in check(obj).lines]
    caught = {part for _, claim in BROKEN for part in claim.split(": ")}
    assert [parts for parts in claimed if not parts & caught] == []


# The report ------------------------------------------------------------------------------------------------------


def test_a_report_has_one_line_per_claim_and_says_what_failed():
    report = check(SeesTheGround())
    assert isinstance(report, Report)
    assert not report.passed
    assert [line.claim for line in report.failed] == ["blindness below the horizon is exact"]
    head, *rows = str(report).splitlines()
    assert head == "SeesTheGround: 14 claims, 1 failed"
    assert len(rows) == len(report.lines) == 14
    with pytest.raises(InstrumentError, match="SeesTheGround breaks its contract: blindness below the horizon"):
        report.raise_if_failed()


@pytest.mark.parametrize("thing", [Fine, 3, lofar_like()], ids=["class", "number", "layout"])
def test_what_has_no_contract_is_refused(thing):
    with pytest.raises(
        InputError, match=r"there is no contract for .*: give an object of one of JonesTerm, Instrument"
    ):
        check(thing)


class Exploding(Fine):
    def jones(self, at):
        raise ZeroDivisionError("boom")


def test_a_plugin_that_raises_fails_its_claims_and_nothing_else():
    report = check(Exploding())
    assert "ZeroDivisionError: boom" in str(report)
    assert next(line for line in report.lines if line.claim.startswith("a round trip")).passed


def test_the_hard_places_are_where_they_say():
    at = hard_places(bench())
    # station 0: 7 places; the last one, with the axes of the Earth, is exact
    np.testing.assert_array_equal(at.zenith_angle[0, -1, 7:12], [0, np.pi / 2, np.pi / 2, np.pi / 2, np.pi])
    np.testing.assert_allclose(at.zenith_angle[0, 0, [0, 1, 4]], [0, np.pi / 2, np.pi], atol=1e-7)
    # the inverse of aberration and rotation gives the directions back: 1e-15, a few roundings
    np.testing.assert_allclose(at.earth.itrf(at.vectors), at.itrf, atol=1e-15)
    assert abs(at.dec_rad[-1]) == np.pi / 2


def test_the_bench_stands_25_degrees_from_the_zenith_of_its_first_station():
    at = bench()
    np.testing.assert_allclose(at.at_centre().zenith_angle[0, 0, 0], 0.44, atol=1e-12)


def test_conformance_needs_no_plugins():
    script = (
        "import sys; sys.modules['instrument_plugins'] = None\n"
        "import instrument\n"
        "instrument.conformance.check(instrument.Parallactic()).raise_if_failed()\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True)


def test_a_composed_instrument_keeps_the_contract():
    layout = lofar_like()
    check(Composed(stations=layout, terms=Chain(GainTerm(rms=0.1), Fine(), Parallactic()))).raise_if_failed()
    assert issubclass(Composed, Component)
    assert instrument.conformance.check is check
