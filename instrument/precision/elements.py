"""The contests of element beams: each by its formula and on tables, against its formula; and as LOFAR's own dipole."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from instrument.errors import RefusedError
from instrument.jones.base import ElementBeam
from instrument.observe.directions import EarthFrame
from instrument.observe.layout import Layout
from instrument.observe.sampling import Sampling
from instrument.precision import peers
from instrument.precision.contest import UNSET, Contest, Entry, Form, Trial
from instrument.precision.truth import geometry, has_truth, matrix, of_term, product
from instrument.registry import names, plugin_class
from instrument.units import Complex, Direction, Float

DIRECTIONS = (2000, 20000)  # of the quick form and of the full one
STEEPEST, EDGE = 70.0, 75.0  # deg from the zenith: of what is asked, and of the tables
SPACINGS = (15.0, 7.5, 5.0, 3.0, 2.5, 1.5, 1.0, 0.5)  # deg, parts of 75 and of 360
FREE_HZ = 150e6  # for an element that has no band of its own
AXES = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # p, q, r of a station whose zenith is ITRF x


def contests(elements: dict[str, Any], form: Form) -> list[Contest]:
    """One for each element, of its formula and of tables of it; and for both bands of LOFAR's dipole one of all."""
    found = [_sampled(name, cls, form) for name, cls in elements.items()]
    if "hamaker" in names("elements"):
        found += [_stand_in(band, elements, form) for band in ("hba", "lba")]
    return found


def towards(freq_hz: float, angle: Float, azimuth: Float) -> Sampling:
    """One station that sees directions (S,) at zenith angles and azimuths (p to q), rad, and points at its zenith."""
    p, q, r = np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)
    layout = Layout(names=("s",), positions_m=np.array([[6.4e6, 0.0, 0.0]]), axes=AXES[None])
    return Sampling(
        layout=layout, earth=EarthFrame(np.eye(3)[None], np.zeros((1, 3))), slots_s=np.array([4.86e9]),
        freq_hz=np.array([freq_hz]), ra_rad=np.arctan2(p, r), dec_rad=np.arcsin(q), centre=Direction(0.0, 0.0),
    )  # fmt: skip


def distance(found: Any, truth: Any) -> Trial:
    """Largest error of matrices (..., 2, 2) over the largest true one (Frobenius); that of their leakage."""
    size, apart = (np.sqrt((np.abs(x) ** 2).sum((-2, -1))) for x in (truth, found - truth))
    leaked = np.abs(leakage(found) - leakage(truth))
    error, rms = float(apart.max() / size.max()), float(np.sqrt(np.mean(leaked**2)))
    return Trial(error, rms, user_max=float(leaked.max()))


def leakage(jones: Any) -> Any:
    """Intrinsic cross-polarization (k - 1)/(k + 1) = IXR^-1/2, k the condition of matrices (..., 2, 2).

    The difference of the singular values over their sum, |a -+ w d*|^2 + |b +- w c*|^2 with w the phase of the
    determinant: without the cancellation of |J|^2 - 2 |det J|, which keeps 8 of 16 digits where there is no leakage.
    """
    a, b, c, d = (np.asarray(jones[..., i, j], np.clongdouble) for i in range(2) for j in range(2))
    det = a * d - b * c
    size = np.abs(det)
    w = np.where(size > 0, det / np.where(size > 0, size, 1), 1)
    less, more = (np.abs(a - s * w * d.conj()) ** 2 + np.abs(b + s * w * c.conj()) ** 2 for s in (1, -1))
    return np.sqrt(less / np.where(more > 0, more, 1))


# Its own formula, and tables of it ---------------------------------------------------------------------------------


def _sampled(name: str, cls: Any, form: Form) -> Contest:
    count = DIRECTIONS[0] if form.quick else DIRECTIONS[1]
    rng = np.random.default_rng(5)
    angle, azimuth = np.deg2rad(STEEPEST) * np.sqrt(rng.uniform(1e-4, 1, count)), rng.uniform(0, 2 * np.pi, count)
    state: dict[str, Any] = {}

    def ready() -> tuple[ElementBeam, Sampling]:
        """The element and where it is asked, made when first needed: what fails is a line of the table."""
        if not state:
            element = made(cls)
            state["at"] = at = towards(within(element), angle, azimuth)
            at.zenith_angle, at.azimuth_cos_sin  # noqa: B018  all get the angles for nothing
            state["truth"] = truth_of(element, at)
            state["element"] = element
        return state["element"], state["at"]

    def formula(asked: float) -> Complex:
        element, at = ready()
        if not has_truth(element):
            raise RefusedError("it gives no truth(at, geometry) in extended precision: its tables alone are judged")
        return element.jones(at)[0, 0, 0]

    def table(degree: int) -> Callable[[float], Complex]:
        def answer(spacing: float) -> Complex:
            element, at = ready()
            key = f"{degree}, {spacing}"
            if key not in state:
                state[key] = _splines(element, float(at.freq_hz[0]), spacing, degree)
            return np.stack([s.ev(angle, azimuth) + 1j * t.ev(angle, azimuth) for s, t in state[key]], -1).reshape(
                -1, 2, 2
            )

        return answer

    entries = [
        Entry(name, formula, (0.0,)),
        Entry(f"{name}, table, linear", table(1)),
        Entry(f"{name}, table, cubic", table(3)),
    ]
    if form.peers and name == "hamaker":
        entries += peers.hamaker(within(ready()[0]), angle, azimuth)
    return Contest(
        name=f"element {name}, {count} directions",
        kind="elements",
        knob="spacing of the table, deg",
        values=SPACINGS[1:6:2] if form.quick else SPACINGS,
        entries=tuple(entries),
        peers=peers.EVERYBEAM if name == "hamaker" else (),
        judge=lambda found, asked: distance(found, state["truth"]),
        error=f"largest error of a matrix within {STEEPEST:g} deg of the zenith, over the largest matrix",
        error_user="rms error of the intrinsic leakage, 1/sqrt(IXR)",
        truth="the formula of the element in extended precision, where it gives one; else the element itself",
    )


def made(cls: Any, band: str = "", turned: float | None = None) -> Any:
    """An element of a class, its knob turned, or set to the middle of its values; of a band, where it has bands."""
    settings: dict[str, Any] = {}
    if band and "band" in cls.model_fields:
        settings["band"] = band
    if cls.knob is not None:
        field, unit, values = cls.knob
        value = values[len(values) // 2] if turned is None else turned
        settings[field] = f"{value!r} {unit}" if unit else value
    return cls(**settings)


def within(element: ElementBeam) -> float:
    """The middle of the band of an element, Hz."""
    low, high = element.band_hz()
    return (low + high) / 2 if np.isfinite(high) else max(2 * low, FREE_HZ)


def truth_of(element: ElementBeam, at: Sampling) -> Any:
    """Matrices (S, 2, 2) of one station at one time and channel, in extended precision where they can be had."""
    found = of_term(element, at, geometry(at)) if has_truth(element) else element.jones(at)
    return np.broadcast_to(found, (*at.shape, 2, 2))[0, 0, 0].astype(np.clongdouble)


def _splines(element: ElementBeam, freq_hz: float, spacing: float, degree: int) -> list[tuple[Any, Any]]:
    """Splines of the real and imaginary parts of each entry over zenith angle and azimuth."""
    from scipy.interpolate import RectBivariateSpline

    # 1e-9: at the zenith itself there is no azimuth, and the field along e_theta turns with it
    angle = np.maximum(np.deg2rad(spacing * np.arange(round(EDGE / spacing) + 1)), 1e-9)
    around = np.deg2rad(spacing) * np.arange(-degree, round(360 / spacing) + degree + 1)
    at = towards(freq_hz, np.repeat(angle, len(around)), np.tile(around, len(angle)))
    found = np.broadcast_to(element.jones(at), (*at.shape, 2, 2)).reshape(len(angle), len(around), 4)
    return [
        tuple(RectBivariateSpline(angle, around, part, kx=degree, ky=degree) for part in (x.real, x.imag))
        for x in np.moveaxis(found, -1, 0)
    ]


# As a model of LOFAR's dipole --------------------------------------------------------------------------------------


def _stand_in(band: str, elements: dict[str, Any], form: Form) -> Contest:
    """Elements with their knobs turned, as models of LOFAR's: what is wrong once calibrated near the zenith."""
    count = DIRECTIONS[0] if form.quick else DIRECTIONS[1]
    rng = np.random.default_rng(6)
    angle, azimuth = np.arccos(rng.uniform(np.cos(np.deg2rad(60)), 1, count)), rng.uniform(0, 2 * np.pi, count)
    angle, azimuth = (
        np.append(np.deg2rad(5), angle),
        np.append(0.3, azimuth),
    )  # the first is the direction calibrated on
    lofar = plugin_class("elements", "hamaker")(band=band)
    at = towards(within(lofar), angle, azimuth)
    at.zenith_angle, at.azimuth_cos_sin  # noqa: B018
    truth = differential(truth_of(lofar, at))

    def entry(name: str, cls: Any) -> Entry:
        @cache
        def element(asked: float) -> ElementBeam:
            one: ElementBeam = made(cls, band, asked)
            if turns(one, within(lofar)):
                raise RefusedError("its receptors turn with their mount, LOFAR's stand still: it is another antenna")
            return one

        def answer(asked: float) -> Complex:
            return np.broadcast_to(element(asked).jones(at), (*at.shape, 2, 2))[0, 0, 0]

        values = (UNSET,) if cls.knob is None else cls.knob[2]
        label = name if cls.knob is None else f"{name} ({cls.knob[0]}{', ' * bool(cls.knob[1])}{cls.knob[1]})"
        few = values[:1] if _is_another(cls, band, lofar) else values[::3] if form.quick else values
        return Entry(label, answer, few)

    return Contest(
        name=f"a model of LOFAR's {band.upper()} dipole, {count} directions",
        kind="elements",
        knob="own setting",
        values=(UNSET,),
        entries=tuple(entry(name, cls) for name, cls in elements.items()),
        judge=lambda found, asked: distance(differential(found.astype(np.clongdouble)), truth),
        error=f"largest error within 60 deg of the zenith, {within(lofar) / 1e6:g} MHz, once calibrated 5 deg from it",
        error_user="rms error of its leakage, 1/sqrt(IXR)",
        truth="the polynomials that Hamaker (2011) fitted to a simulation of the antenna, in extended precision",
    )


def _is_another(cls: Any, band: str, lofar: ElementBeam) -> bool:
    """Whether a class is known to turn with its mount; one that cannot be made fails when it is asked."""
    try:
        return turns(made(cls, band), within(lofar))
    except Exception:  # a stranger's may fail in any way
        return False


def differential(jones: Any) -> Any:
    """inv(J(first)) @ J of matrices (S, 2, 2), in their own precision."""
    return product(inverse(jones[:1]), jones)


def inverse(jones: Any) -> Any:
    """J^-1 of matrices (..., 2, 2), in their own precision."""
    a, b, c, d = (jones[..., i, j] for i in range(2) for j in range(2))
    return matrix(d, -b, -c, a) / (a * d - b * c)[..., None, None]


def turns(element: ElementBeam, freq_hz: float) -> bool:
    """Whether the receptors turn with the azimuth of what they see: an antenna that stands still has one zenith."""
    azimuth = np.arange(4) * np.pi / 2
    at = towards(freq_hz, np.full(4, 1e-3), azimuth)
    found = np.broadcast_to(element.jones(at), (*at.shape, 2, 2))[0, 0, 0]
    cos, sin = np.cos(azimuth), np.sin(azimuth)
    ground = found @ np.moveaxis(np.array([[cos, sin], [-sin, cos]]), -1, 0)
    return bool(np.abs(ground - ground[0]).max() > 0.5 * np.abs(ground[0]).max())
