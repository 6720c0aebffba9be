"""Random scenes for the bounds of a plan: telescopes, chains and skies of every kind, seeded."""

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from instrument_plugins.elements.dipole import CrossedDipole
from instrument_plugins.elements.dish import Airy, Gaussian
from instrument_plugins.elements.hamaker import Hamaker

import instrument
from instrument import (
    Chain,
    Composed,
    FeedTerm,
    GainTerm,
    JonesTerm,
    Layout,
    Level,
    Observation,
    Parallactic,
    PointSky,
    ScalarTerm,
    Scene,
    StationBeam,
    mat2,
)
from instrument.precision.truth import LIGHT, I, matrix, real

TOLERANCES = (0, 0, 1e-12, 1e-10, 1e-8, 1e-6, 1e-4, 1e-3, 1e-2, 1e-1)
BANDS = {"lofar-hba": (120e6, 240e6), "lofar-lba": (10e6, 100e6)}


class Turn(JonesTerm):
    """An ionosphere that is the same everywhere: rotation by RM lambda^2, (1, F, 1, 1, 2, 2)."""

    maps = ("sky", "sky")
    per_station = "shared"
    directional = False
    rm: float = 0.0

    def jones(self, at):
        angle = self.rm * (299792458.0 / at.freq_hz) ** 2
        return mat2.pack(np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle))[None, :, None, None]

    def rounding(self, at):
        return np.array([4 * np.finfo(float).eps * (1 + abs(self.rm) * (299792458.0 / at.freq_hz.min()) ** 2)])

    def truth(self, at, g):
        angle = real(self.rm) * (LIGHT / real(at.freq_hz)) ** 2
        return matrix(np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle))[None, :, None, None]


class Screen(ScalarTerm):
    """A phase screen of one gradient, which grows from station to station, (1, 1, A, S)."""

    maps = ("feed", "feed")
    slope: float = 1.0

    def peak(self, at):
        return 1.0

    def rounding(self, at):
        return np.array([8 * np.finfo(float).eps * (1 + 2 * abs(self.slope) * len(at.layout))])

    def scalar(self, at):
        phase = self.slope * np.arange(len(at.layout))[:, None] * (at.lmn[:, 0] + at.lmn[:, 1])
        return np.exp(1j * phase)[None, None]

    def truth(self, at, g):
        phase = real(self.slope) * np.arange(len(at.layout))[:, None] * (g.lmn[:, 0] + g.lmn[:, 1])
        z = (np.cos(phase) + I * np.sin(phase))[None, None]
        return matrix(z, 0, 0, z)


def scene(seed):
    """A scene and a tolerance; some scenes are impossible, and a plan refuses them."""
    rng = np.random.default_rng([seed, 9])
    kind = str(rng.choice(["lofar-hba", "lofar-lba", "dish", "dipole", "phased", "bare"]))
    frequencies = 10 ** rng.uniform(7, 10, rng.integers(1, 4))
    if kind in BANDS:
        if rng.random() < 0.7:
            frequencies = rng.uniform(*BANDS[kind], rng.integers(1, 4))
        telescope, latitude = _lofar(rng, kind), 52.9
    else:
        latitude = float(rng.uniform(-89, 89))
        telescope = _composed(rng, kind, latitude)
    pole = np.sign(latitude) * 90 if rng.random() < 0.1 else np.clip(latitude + 30 * rng.normal(), -90, 90)
    dec = float(np.clip(rng.uniform(-90, 90) if rng.random() < 0.1 else pole, -90, 90))
    centre = SkyCoord(rng.uniform(0, 360) * u.deg, dec * u.deg)
    start = f"20{rng.integers(10, 25)}-0{rng.integers(1, 9)}-1{rng.integers(0, 9)}T{rng.integers(10, 23)}:00:00"
    interval, count = 3000.0, int(rng.integers(1, 4))
    other = np.random.default_rng([seed, 10])  # what is drawn above and below stays what it was
    if other.random() < 0.4:
        interval, count = 10 ** other.uniform(0.3, 2.3), int(other.integers(4, 40))
    observation = Observation(
        phase_centre=centre,
        start=start,
        duration=count * interval * u.s,
        interval=interval * u.s,
        frequencies=np.unique(frequencies) * u.Hz,
        channel_width=1e3 * u.Hz,
    )
    made = Scene(name=kind, instrument=telescope, sky=_sky(rng, centre), observation=observation)
    return made, float(TOLERANCES[rng.integers(len(TOLERANCES))])


def _receivers(rng):
    gain = feed = None
    if rng.random() < 0.6:
        size = 10 ** rng.uniform(-3, 3)
        fixed = size * (rng.normal(size=(1, 1, 1, 2)) + 1j * rng.normal(size=(1, 1, 1, 2)))
        drawn = {"rms": 10 ** rng.uniform(-3, 0.5), "seed": int(rng.integers(100))}
        gain = GainTerm(values=fixed) if rng.random() < 0.5 else GainTerm(**drawn)
    if rng.random() < 0.4:
        feed = FeedTerm(rms=10 ** rng.uniform(-3, 0), seed=int(rng.integers(100)))
    return gain, feed


def _phase(rng):
    return ["fringe", "everybeam"][rng.spawn(1)[0].integers(2)]  # a child: what is drawn next stays what it was


def _lofar(rng, kind):
    names = instrument.load("telescopes", kind).stations
    gain, feed = _receivers(rng)
    elsewhere = SkyCoord(rng.uniform(0, 360) * u.deg, rng.uniform(20, 90) * u.deg)
    return instrument.load(
        "telescopes",
        kind,
        stations=[str(n) for n in rng.choice(names, rng.integers(2, 7), replace=False)],
        gain=gain,
        feed=feed,
        beam=[None, "full", "element", "array-factor", "full"][rng.integers(5)],
        beam_pointing=elsewhere if rng.random() < 0.3 else None,
        reference_frequency=150 * u.MHz if rng.random() < 0.3 else None,
        phase=_phase(rng),
    )


def _composed(rng, kind, latitude):
    count = int(rng.integers(2, 7))
    enu = rng.normal(size=(count, 3)) * 10 ** rng.uniform(0, 6.9) / 3
    enu -= enu[0]  # the site is the first station: a tangent plane far from its site stands on no ground
    enu[:, 2] = np.clip(enu[:, 2], -1e5, 1e6)  # nor does a station inside the Earth
    if rng.random() < 0.2:
        enu[1] = enu[0]
    names, place = [f"s{k}" for k in range(count)], {"latitude": latitude * u.deg, "height": 0 * u.m}
    layout = Layout.from_enu(names, enu * u.m, longitude=rng.uniform(-180, 180) * u.deg, **place)
    terms = [t for t in _receivers(rng) if t is not None]
    if kind == "dish":
        wide = Gaussian(fwhm=rng.uniform(0.01, 90) * u.deg, frequency=1e9 * u.Hz if rng.random() < 0.5 else None)
        terms += [Airy(diameter=10 ** rng.uniform(0, 2.5) * u.m) if rng.random() < 0.5 else wide, Parallactic()]
    elif kind == "dipole":
        terms += [
            CrossedDipole(height=10 ** rng.uniform(-1, 0.5) * u.m, x_azimuth=rng.uniform(0, 360) * u.deg),
            Parallactic(),
        ]
    elif kind == "phased":
        element = [CrossedDipole(height=0.5 * u.m), Hamaker(), Airy(diameter=5 * u.m)][rng.integers(3)]
        own = count if rng.random() < 0.5 else 1
        offsets = rng.normal(size=(own, int(rng.integers(1, 12)), 3)) * 10 ** rng.uniform(-1, 2)
        terms += [StationBeam(element=element, levels=(Level(offsets_m=offsets),), phase=_phase(rng)), Parallactic()]
    if rng.random() < 0.3:
        terms.insert(0, Screen(slope=rng.uniform(-30, 30)))
    if rng.random() < 0.3 and kind != "bare":
        terms.append(Turn(rm=10 ** rng.uniform(-3, 1)))
    if rng.random() < 0.3:
        for _ in range(rng.integers(1, 5)):
            terms.insert(0, GainTerm(values=np.exp(1j * rng.normal(size=(1, 1, count, 2)))))
    return Composed(stations=layout, terms=Chain(*terms))


def _sky(rng, centre):
    count = int(rng.integers(1, 14))
    if rng.random() < 0.5:
        reach = 10 ** rng.uniform(-6, 1) * rng.random(count)
        near = centre.directional_offset_by(rng.uniform(0, 360, count) * u.deg, reach * u.deg)
        ra, dec = near.ra.rad, near.dec.rad
    else:
        ra, dec = rng.uniform(0, 2 * np.pi, count), np.arcsin(rng.uniform(-1, 1, count))
    size = 10 ** rng.uniform(-6, 3, count) * np.where(rng.random(count) < 0.2, -1, 1)
    stokes = size[:, None] * rng.normal(size=(count, 4))  # more polarized than bright, as often as not
    stokes[rng.random((count, 4)) < 0.15] = 0
    if rng.random() < 0.2:
        stokes[:, 1:] = 0
    if not stokes.any():
        stokes[0, 0] = 1
    more = {}
    if rng.random() < 0.4:
        major = np.where(rng.random(count) < 0.5, 0, 10 ** rng.uniform(-7, -2, count))
        more = {"major_rad": major, "minor_rad": major * rng.random(count)}
        more["angle_rad"] = rng.uniform(0, 2 * np.pi, count)
    if rng.random() < 0.5:
        more["reference_hz"] = 10 ** rng.uniform(7, 10, count)
        if rng.random() < 0.6:
            more["spectral_terms"] = rng.normal(size=(count, int(rng.integers(1, 3))))
            more["logarithmic"] = rng.random(count) < 0.7
            more["polarization_follows_i"] = rng.random(count) < 0.5
        if rng.random() < 0.7:
            low, high = (0, 3) if rng.random() < 0.5 else (3, 5)
            more["rotation_measure"] = rng.choice([-1, 1], count) * 10 ** rng.uniform(low, high, count)
    return PointSky(names=tuple(f"s{k}" for k in range(count)), ra_rad=ra, dec_rad=dec, stokes_jy=stokes, **more)
