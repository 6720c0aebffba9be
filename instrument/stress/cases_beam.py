"""Cases of beams: elements at their singular points, phased stations, matrices at the ends of what they can be."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np

from instrument import mat2
from instrument.errors import InputError, InstrumentWarning
from instrument.jones import mueller
from instrument.jones.base import ElementBeam
from instrument.jones.chain import Chain
from instrument.jones.feed import FeedTerm
from instrument.jones.gain import GainTerm
from instrument.jones.parallactic import Parallactic
from instrument.jones.station import ArrayFactor, Level, StationBeam
from instrument.jones.table import JonesTable
from instrument.model import Instrument
from instrument.not_modelled import not_modelled
from instrument.observe.directions import LIGHT, EarthFrame
from instrument.predict.direct import Direct
from instrument.stress.bench import fringe, points, problem, references, seen, still, towards
from instrument.stress.case import Answer, both, case, claim, held, not_there
from instrument.units import Complex, Float


def _within(element: ElementBeam) -> float:
    """A frequency within the band of an element, Hz."""
    low, high = element.band_hz()
    high = high if np.isfinite(high) else max(2 * low, 250e6)
    return 0.5 * (low + high)


def _across(azimuth: Float) -> Complex:
    """From (p, q) to (e_theta, e_phi) at the zenith, seen from an azimuth, (S, 2, 2)."""
    return mat2.pack(np.cos(azimuth), np.sin(azimuth), -np.sin(azimuth), np.cos(azimuth))


@case("11", "elements", "elevations of +-1e-12 deg and 0", "one half-open rule: 0 below, of one kind on the horizon")
def horizon(element: ElementBeam) -> Answer:
    """Twelve azimuths; 1e-12 deg is 1.7e-14 rad, 80 ulp of a zenith angle of pi/2."""
    azimuth = 2 * np.pi * np.arange(12) / 12
    size = []
    for up in (1.7e-14, 0.0, -1.7e-14):
        local = np.stack([np.cos(azimuth), np.sin(azimuth), np.full(12, up)], axis=-1)
        size.append(np.abs(element.jones(seen(_within(element), local)))[0, 0, 0].max(axis=(-2, -1)))
    above, on, below = (np.broadcast_to(s, 12) for s in size)
    near = np.abs(element.jones(towards(_within(element), np.pi / 2 - 1e-11, azimuth)))[0, 0, 0].max(axis=(-2, -1))
    one_kind = bool(np.all(on == 0) or np.allclose(on, above, rtol=1e-6, atol=1e-12))
    continuous = bool(np.allclose(above, near, rtol=1e-6, atol=1e-8))
    told = f"{above.max():.1e} above, {on.max():.1e} on it, {below.max():.1e} below"
    return claim(not below.any() and one_kind and continuous, told, told)


@case("18", "elements", "the zenith from every azimuth",
      "one J in the frame of the antenna (its mount), to 1e-12; or a published seam, as large as stated")  # fmt: skip
def zenith(element: ElementBeam) -> Answer:
    """24 azimuths, 1e-13 rad from the zenith; an alt-azimuth mount turns the receptors with it.

    An element whose published model is no single field there says so (`zenith_seam`, 1e-2 at most), and so does the
    plan of a direction near it, with the number found here; case 18b holds its J there to the published formula.
    """
    azimuth = 2 * np.pi * np.arange(24) / 24
    mount = element.jones(towards(_within(element), 1e-13, azimuth))[0, 0, 0]
    ground = mat2.mul(mount, _across(azimuth))
    found = min((held(j, np.broadcast_to(j[:1], j.shape), 1e-12) for j in (ground, mount)), key=lambda a: a.error)
    if found.right or not element.zenith_seam:
        return found
    terms = (element.in_chain(), Parallactic())
    given = problem([(3, 4, 0), (0, 0, 0)], points(0.0, 0.0, [1, 0, 0, 0]), *terms, freq_hz=_within(element))
    said = " ".join(item.reason for item in not_modelled(given, 1.0) if item.name == "zenith")
    if f"{found.error:.1e}" not in said:
        return claim(False, f"J depends on the azimuth by {found.error:.1e}, and the plan says: '{said}'")
    return found._replace(limit=min(element.zenith_seam, 1e-2), remark=said)


@case("13", "elements", "a polarized source at the celestial pole", "as 1e-11 rad beside it, at any RA, to 1e-7")
def pole(element: ElementBeam) -> Answer:
    """The pole 30 deg from the zenith; Q at RA 0 is -Q at RA 90 deg there: x is north along the source's meridian."""
    c, s = np.cos(np.pi / 3), np.sin(np.pi / 3)
    earth = EarthFrame(np.array([[[c, 0, s], [0, 1, 0], [-s, 0, c]]]), np.zeros((1, 3)))
    found = []
    for ra, dec, q in ((0.0, np.pi / 2, 1.0), (0.0, np.pi / 2 - 1e-11, 1.0), (np.pi / 2, np.pi / 2 - 1e-11, -1.0)):
        terms = (element.in_chain(), Parallactic())
        given = problem([(3, 4, 0), (0, 0, 0)], points(ra, dec, [1, q, 0, 0]), *terms, freq_hz=_within(element))
        found.append(Direct().sums(replace(given, at=replace(given.at, earth=earth)))[0, 0, 0])
    return held(found, np.broadcast_to(found[1], (3, 2, 2)), 1e-7)


@case("23", "elements", "a station of one dipole, and of none", "the element exactly; no parts are refused")
def one_dipole(element: ElementBeam) -> Answer:
    """One part at the centre of the station."""
    at = towards(_within(element), [0.0, 0.4, 1.2], [0.3, 2.0, 4.0])
    inner = element.in_chain()
    found = StationBeam(element=inner, levels=(Level(offsets_m=np.zeros((1, 1, 3))),)).jones(at)
    try:
        Level(offsets_m=np.zeros((1, 0, 3)))
        refused = False
    except InputError:
        refused = True
    return both(held(found, inner.jones(at), 0.0), claim(refused, "a station without parts is taken"))


@case("20", "jones", "J = [[1, d], [d*, 1]] and [[1, d], [-d*, 1]]", "IXR 1/abs(d)^2, and infinite")
def ixr(_: None) -> Answer:
    """A Hermitian leakage, and one that is a rotation."""
    d = 0.25 - 0.125j
    found = mueller.ixr_jones(np.array([[1, d], [np.conj(d), 1]]))
    answers = [held(found, references()["ixr_hermitian"], 1e-13)]
    rng = np.random.default_rng(1)
    for e in (d, *(rng.uniform(-1, 1, (20, 2)) @ [1, 1j])):
        answers.append(claim(np.isinf(mueller.ixr_jones(np.array([[1, e], [-np.conj(e), 1]]))), f"d = {e:.3g}: finite"))
    return both(*answers)


@case("21", "jones", "a Jones matrix of rank 1", "IXR 1, forward finite, its inverse refused or flagged")
def rank_one(_: None) -> Answer:
    """[[1, 2], [2, 4]], whose determinant is exactly 0; and a product of two vectors of irrational numbers."""
    x = np.array([np.sqrt(2), np.pi * 1j])
    answers = []
    for j in (np.array([[1, 2], [2, 4]], complex), np.outer(x, x.conj()[::-1])):
        forward = mat2.sandwich(j, np.eye(2, dtype=complex), j)
        answers.append(held(mueller.ixr_jones(j), 1.0, 1e-13))
        told = not np.isfinite(mat2.inverse(j)).any() and bool(np.isfinite(forward).all())
        answers.append(claim(told, "it has an inverse", condition=float(mat2.condition(j))))
    return both(*answers)


@case("22", "jones", "condition of a Mueller matrix", "that of a kron conj(b): kappa_a kappa_b, to 1e-13")
def kron(_: None) -> Answer:
    """Two matrices of eighths, whose singular values are known in 40 digits."""
    a = np.array([[1, 0.5 + 0.25j], [0.125, 2]])
    b = np.array([[1 - 1j, 0.5], [-0.25, 3]])
    due = references()["kron_condition"]
    whole = float(np.linalg.cond(mueller.mueller(a, b)))
    parts = float(mat2.condition(a) * mat2.condition(b))
    return both(held(whole, due, 1e-13, condition=due), held(parts, due, 1e-13))


@case("24", "jones", "a lattice at its pointing and at its grating lobe", "array factor 1, and 1, to 1e-12")
def grating(_: None) -> Answer:
    """5 parts one wavelength apart, pointed at the zenith: sin z = 1 is the lobe; between them 1/5 sum."""
    offsets = np.zeros((1, 5, 3))
    offsets[0, :, :] = np.arange(5)[:, None] * [0.0, 1.0, 0.0]
    at = still([[0, 0, 0]], LIGHT, [0.0, np.pi / 2, -np.pi / 2, 0.3], 0.0)
    found = ArrayFactor(levels=(Level(offsets_m=offsets),)).scalar(at)[0, 0, 0]
    middle = fringe(np.arange(5) * np.sin(0.3)).mean()
    return held(np.abs(found), [1, 1, 1, abs(middle)], 1e-12)


@case("26", "jones", "a table asked outside its times and channels", "refused", refusal=True)
def outside(_: None) -> Answer:
    """A day later, and an octave away."""
    at = still([[0, 0, 0]])
    values = np.ones((2, 2, 1, 2, 2), complex)
    slots, freq = at.slots_s[0] + np.array([0.0, 10.0]), LIGHT * np.array([1.0, 1.001])
    table = JonesTable(values=values, slots_s=slots, freq_hz=freq)
    taken = []
    for where in (replace(at, slots_s=at.slots_s + 86400), replace(at, freq_hz=at.freq_hz / 2)):
        try:
            table.jones(where)
            taken.append(True)
        except InputError:
            taken.append(False)
    if not any(taken):
        table.jones(replace(at, slots_s=at.slots_s + 86400))
    return claim(False, "it extrapolates")


@case("29", "jones", "phases of +-179 deg, averaged half-way", "180 deg and modulus 1, not 0")
def wrapped(_: None) -> Answer:
    """Linear interpolation of a table between two slots."""
    at = still([[0, 0, 0]])
    angle = np.deg2rad([179.0, -179.0])
    values = np.exp(1j * angle)[:, None, None, None, None] * np.eye(2)
    slots = at.slots_s[0] + np.array([-5.0, 5.0])
    table = JonesTable(values=values, slots_s=slots, freq_hz=at.freq_hz, interpolation="linear")
    return held(table.jones(at)[0, 0, 0, 0], -np.eye(2), 1e-12)


@case(
    "29b", "jones", "full matrices between two slots and two channels", "U0 (U0^H U1)^s ((1 - s) H0 + s H1), to 1e-12"
)
def turning(_: None) -> Answer:
    """Random matrices a third of a turn apart, 0.3 of the way, by scipy's polar form and power of a matrix."""
    from scipy.linalg import expm, fractional_matrix_power, polar

    at = still([[0, 0, 0]], LIGHT * np.array([1.0, 1.0003]))
    rng = np.random.default_rng(4)
    a, b = rng.normal(size=(2, 2, 2, 2)).view(complex)[..., 0] * 0.3
    first = np.eye(2) + a
    second = expm(1.1j * (b + b.conj().T)) @ first
    (u0, h0), (u1, h1) = polar(first), polar(second)
    due = u0 @ fractional_matrix_power(u0.conj().T @ u1, 0.3) @ (0.7 * h0 + 0.3 * h1)
    slots, freq = at.slots_s[0] + np.array([-3.0, 7.0]), LIGHT * np.array([1.0, 1.001])
    rows = np.stack([first, second])
    times = JonesTable(values=rows[:, None, None], slots_s=slots, freq_hz=freq[:1], interpolation="linear")
    channels = JonesTable(values=rows[None, :, None], slots_s=slots[:1], freq_hz=freq, interpolation="linear")
    found = channels.jones(at)[0, :, 0, 0]
    ends = JonesTable(values=rows[:, None, None], slots_s=slots, freq_hz=freq[:1]).jones(at)[0, 0, 0, 0]
    return both(held(times.jones(at)[0, 0, 0, 0], due, 1e-12), held(found, [first, due], 1e-10), held(ends, first, 0.0))


@case("38", "jones", "two full Jones terms in the other order, and two scalar ones", "differs by AB - BA; the same")
def order(_: None) -> Answer:
    """Feeds of 30 % before gains of 30 %; a phase before a gain."""
    at = still([[0, 0, 0], [3, 4, 0]])
    a, b = FeedTerm(rms=0.3, seed=1), GainTerm(rms=0.3, seed=2)
    ja, jb = a.jones(at), b.jones(at)
    apart = Chain(a, b).jones(at) - Chain(b, a).jones(at)
    due = ja @ jb - jb @ ja
    same = [GainTerm(values=np.full((1, 1, 1, 2), v)) for v in (0.5 - 2j, 1.25 + 0.5j)]
    scalar = Chain(*same).jones(at) - Chain(*same[::-1]).jones(at)
    return both(held(apart, due, 1e-14), claim(np.abs(due).max() > 0.01), held(scalar, np.zeros(1), 1e-15, scale=1.0))


# Telescopes ---------------------------------------------------------------------------------------------------------


def sight(telescope: Instrument) -> tuple[object, object, float]:
    """A time, the zenith of the first station then, and a frequency within the band."""
    from astropy import units as u
    from astropy.coordinates import SkyCoord
    from astropy.time import Time

    from instrument.conformance.bench import bench

    at = bench(telescope.chain().parts, telescope.layout())
    when = Time(at.slots_s[:1] / 86400, format="mjd", scale="utc")
    return when, SkyCoord(at.centre.ra_rad * u.rad, at.centre.dec_rad * u.rad), float(at.freq_hz[0])


@case("24b", "telescopes", "the differential beam at its own pointing", "the unit matrix, to 1e-12 times the condition")
def nominal(telescope: Instrument) -> Answer:
    """Of every station."""
    from astropy import units as u

    when, centre, freq = sight(telescope)
    raw = telescope.beam(centre, when, freq * u.Hz)
    worst = float(mat2.condition(raw).max())
    found = telescope.beam(centre, when, freq * u.Hz, state="differential")
    return held(found, np.broadcast_to(np.eye(2), found.shape), 1e-12 * worst, condition=worst)


@case("4b", "telescopes", "Mueller matrix of a baseline, antennas swapped", "conj(M) with its signs of V, to 1e-13")
def turned_baseline(telescope: Instrument) -> Answer:
    """V_ba = V_ab^H: Stokes parameters are conjugated, so M_ba = conj(M_ab)."""
    from astropy import units as u

    when, centre, freq = sight(telescope)
    names = telescope.layout().names
    pair = (names[0], names[-1])
    away = centre.directional_offset_by(30 * u.deg, 3 * u.deg)  # type: ignore[attr-defined]
    one, other = (telescope.mueller(away, when, freq * u.Hz, centre, baseline=p) for p in (pair, pair[::-1]))
    return held(other, np.conj(one), 1e-13)


@case("26b", "telescopes", "a frequency outside the band of the element", "refused, or a warning that names the band",
      refusal=True)  # fmt: skip
def outside_band(telescope: Instrument) -> Answer:
    """Twice its upper end, or half of its lower one; true of anything without a band."""
    from astropy import units as u

    when, centre, _ = sight(telescope)
    bands = [p.band_hz() for p in telescope.chain().parts if isinstance(p, ElementBeam)]
    ends = [(low, high) for low, high in bands if low > 0 or np.isfinite(high)]
    if not ends:
        return claim(True, told="its beam has no band")
    low, high = ends[0]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        telescope.beam(centre, when, (2 * high if np.isfinite(high) else low / 2) * u.Hz)
    words = " ".join(str(w.message) for w in said if issubclass(w.category, InstrumentWarning))
    told = f"{low / 1e6:g}" in words and "MHz" in words
    return claim(told, "it extrapolates in silence", words)


NO_TABLE = "no element is a table"
MISSING = (
    not_there("19", "jones", "the azimuth seam of a table of beams", "error <= 1.5 x the median", NO_TABLE),
    not_there("25", "jones", "a smooth beam between table channels", "ripple below the floor stated", NO_TABLE),
    not_there("27", "jones", "UVBeam: feeds swapped, mirrored", "caught by a labelled source", "UVBeam is not read"),
)
