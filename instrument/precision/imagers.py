"""The contest of imagers: accuracy against the plain sum of cosines in extended precision, corners included."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import instrument.registry as registry
from instrument.observe.observation import Observation
from instrument.precision import cleaning, corrected
from instrument.precision.contest import UNSET, Contest, Entry, Form, Trial
from instrument.precision.cube_peers import IMAGERS, imager_peers
from instrument.precision.truth import LIGHT, cis, real
from instrument.scene import Scene
from instrument.sky.points import PointSky
from instrument.units import Float, Int
from instrument.visibilities import Visibilities

# stations, integrations, pixels
SIZES = ((20, 10, 128), (24, 40, 512))
FULL = tuple(10.0 ** (-k / 8) for k in range(16, 97))  # eight a decade, 1e-2 to 1e-12
SHORT = tuple(10.0**-k for k in range(2, 13))
ACROSS = 17  # pixels along a side at which the truth is worked out, both ends among them
PIXEL_RAD = float(np.deg2rad(1.5 / 60))


def contests(imagers: dict[str, Any], form: Form) -> list[Contest]:
    """One a size: 40 unpolarized sources behind LOFAR's beams, which leak into Q and U; those of CLEAN and of beams."""
    sums = {name: cls for name, cls in imagers.items() if not cls.restores}
    made = [contest(sums, *size, form) for size in (SIZES[:1] if form.quick else SIZES)] if sums else []
    return [*made, *cleaning.contests(imagers, form), *corrected.contests(imagers, form)]


def contest(imagers: dict[str, Any], stations: int, times: int, pixels: int, form: Form = Form()) -> Contest:  # noqa: B008
    """That of one size, of classes of imagers by name."""
    from astropy import units as u

    data, pixel = seen(stations, times), PIXEL_RAD
    rows, columns = _places(pixels)
    due = plain_sum(data, pixel * (pixels // 2 - columns), pixel * (rows - pixels // 2))
    weight = np.broadcast_to(data.whole_weight, data.data.shape[:3])[:, 0]
    scale = np.einsum("tb,tbk->k", weight, np.abs(data.stokes()[:, 0]))[:, None] / weight.sum()
    peak = float(np.abs(due[0]).max())

    def judge(planes: Float, asked: float) -> Trial:
        apart = np.abs(planes[:, rows, columns] - due)
        leaked = apart[1:3] / peak
        rms = float(np.sqrt(np.mean(leaked**2)))
        return Trial(float((apart / scale).max()), rms, user_max=float(leaked.max()))

    common = {"pixels": pixels, "pixel": pixel * u.rad}
    entries = [Entry(name, _answer(cls, data, common), _values(cls)) for name, cls in imagers.items()]
    if form.peers:
        entries += imager_peers(data, pixels, pixel, SHORT)
    return Contest(
        name=f"image {pixels} x {pixels} pixels",
        kind="imagers",
        knob="accuracy",
        values=SHORT if form.quick else FULL,
        entries=tuple(entries),
        judge=judge,
        error=f"largest error at {len(rows)} pixels, corners among them, over the mean |V| of I, Q, U or V",
        error_user="error of Q and U, rms, over the peak of I",
        truth="the sum of cosines over the visibilities in extended precision, from its formula",
        honoured=True,
        family="image",
        size=pixels,
        size_word="pixels a side",
        peers=IMAGERS,
    )


def _values(cls: Any) -> tuple[float, ...]:
    """Those of the contest, or none to ask for of an imager that has no accuracy."""
    return () if "accuracy" in cls.model_fields else (UNSET,)


def _answer(cls: Any, data: Visibilities, common: dict[str, Any]) -> Callable[[float], Float]:
    fields = {"weighting": "natural"} if "weighting" in cls.model_fields else {}

    def answer(accuracy: float) -> Float:
        asked = {} if np.isnan(accuracy) else {"accuracy": max(accuracy, 1e-12)}  # 10**-12 is a rounding below 1e-12
        return np.asarray(cls(**common, **fields, **asked).image(data).data[0])

    return answer


def seen(stations: int, times: int) -> Visibilities:
    """What stations of LOFAR's core see of 40 sources of 1 to 10 Jy within 3.5 deg, over 4 hours at 150 MHz."""
    from astropy import units as u
    from astropy.coordinates import SkyCoord

    rng, count = np.random.default_rng(196), 40
    centre = SkyCoord("08h13m36.0s +48d13m03s")
    east, north = rng.uniform(-3.5, 3.5, (2, count)) * u.deg
    flux = np.zeros((count, 4))
    flux[:, 0] = rng.uniform(1, 10, count)
    names = registry.load("telescopes", "lofar-hba", beam=None).layout().names[:stations]
    night = Observation(
        phase_centre=centre, transit="2012-12-07", duration=4 * u.hour, interval=4 * u.hour / times,
        frequencies=[150] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    sky = PointSky.at(centre.spherical_offsets_by(east, north), flux)
    lofar = registry.load("telescopes", "lofar-hba", stations=names)
    return Scene(instrument=lofar, sky=sky, observation=night).plan().run()


def _places(pixels: int) -> tuple[Int, Int]:
    """Rows and columns of pixels (P,): every so many, the first and the last among them, as if on a chess board."""
    side = np.unique(np.linspace(0, pixels - 1, ACROSS).round().astype(int))
    rows, columns = np.meshgrid(side, side, indexing="ij")
    return rows.ravel(), columns.ravel()


def plain_sum(data: Visibilities, l: Any, m: Any) -> Float:
    """sum w V exp(2 pi i (u l + v m + w (n - 1))) / sum w of I, Q, U, V of the first channel at (P,) places, (4, P)."""
    scale = real(data.freq_hz[0]) / LIGHT
    uvw = real(data.uvw_m.reshape(-1, 3)) * scale
    weight = real(np.broadcast_to(data.whole_weight, data.data.shape[:3])[:, 0].ravel())
    values = data.stokes()[:, 0].reshape(-1, 4).T * weight
    out = np.empty((4, len(l)))
    for k, (x, y) in enumerate(zip(real(l), real(m), strict=True)):
        less = -(x**2 + y**2) / (1 + np.sqrt(1 - x**2 - y**2))
        turned = cis(uvw[:, 0] * x + uvw[:, 1] * y + uvw[:, 2] * less)
        out[:, k] = (values.real * turned.real - values.imag * turned.imag).sum(axis=1) / weight.sum()
    return out
