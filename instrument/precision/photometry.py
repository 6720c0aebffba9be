"""Contests of photometry: fluxes that were put in, from part of a noisy night, and without noise by iterations."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.analyze.sources.fluxes import SourceFluxes
from instrument.analyze.sources.photometry import ForcedPhotometry
from instrument.errors import Outcome
from instrument.image.dirty import Imager
from instrument.observe.observation import Observation
from instrument.precision.contest import RIGHT, UNSET, WRONG, Contest, Entry, Form, Trial
from instrument.registry import load
from instrument.scene import Scene
from instrument.sky.points import PointSky
from instrument.units import Float
from instrument.visibilities import Visibilities

# stations, integrations, sources
SIZES = ((16, 32, 30), (40, 256, 160))
PIXELS, FIELD_DEG = 512, 7.0
STEPS = 10.0  # times the accuracy asked for and the condition, above which a solution that says converged is wrong


def contests(form: Form) -> list[Contest]:
    """Two a size: sources within 3 deg, one of 100 Jy beside others of 0.1 to 10, without beams."""
    return [made for size in (SIZES[:1] if form.quick else SIZES) for made in _pair(form, *size)]


def _pair(form: Form, stations: int, times: int, count: int) -> list[Contest]:
    from astropy import units as u

    clean, sky = _observed(stations, times, count)
    noisy = clean.with_noise(sefd=2820 * u.Jy, seed=3)
    put = np.asarray(sky.stokes_jy)
    every = tuple(float(2**k) for k in range(times.bit_length() - 2))
    seen = every[::2] if form.quick else every
    rng = np.random.default_rng(4)
    uneven = clean.weighted(rng.uniform(0.5, 2, (1, 1, len(clean.antenna1))))
    condition = _condition(uneven, sky)

    def judge(found: Any, asked: float) -> Trial:
        return _trial(found, put)

    def judge_iterated(found: SourceFluxes, asked: float) -> Trial:
        trial = _trial(found, put)
        return trial._replace(outcome=WRONG) if trial.error > STEPS * condition * asked else trial

    common: dict[str, Any] = {
        "kind": "photometry",
        "error": "rms error of I, Q, U, V of the sources, over the rms flux of all but the brightest",
        "error_user": "bias of a flux: mean error of I of all sources, over their mean I",
        "truth": "the fluxes put in",
        "size": float(count),
        "size_word": "sources",
    }
    return [
        Contest(
            name=f"fluxes of {count} sources in noise",
            knob="every n-th time",
            values=seen,
            entries=(
                Entry("joint photometry", lambda n: ForcedPhotometry(every=int(n)).measure(noisy, sky)),
                Entry("pixels of the dirty image", lambda n: _pixels(noisy, sky), (UNSET,)),
            ),
            judge=judge,
            family="fluxes in noise",
            **common,
        ),
        Contest(
            name=f"fluxes of {count} sources by iterations",
            knob="accuracy",
            values=tuple(10.0**-k for k in (range(2, 13, 2) if form.quick else range(2, 13))),
            entries=(Entry("conjugate gradients", lambda a: ForcedPhotometry(accuracy=a).measure(uneven, sky)),),
            judge=judge_iterated,
            family="fluxes by iterations",
            **common,
        ),
    ]


def _trial(found: Any, put: Float) -> Trial:
    """Of fluxes (S, 4), or of `SourceFluxes` of one channel."""
    ended = RIGHT
    if isinstance(found, SourceFluxes):
        ended = RIGHT if found.outcome[0] is Outcome.CONVERGED else found.outcome[0].name
        found = found.stokes_jy[0]
    apart = found - put
    faint = np.argsort(put[:, 0])[:-1]
    scale = float(np.sqrt(np.mean(put[faint] ** 2)))
    bias = abs(float(apart[:, 0].mean()))
    worst = float(np.abs(apart[:, 0]).max())
    level = float(put[:, 0].mean())
    return Trial(float(np.sqrt(np.mean(apart**2))) / scale, bias / level, ended, worst / level)


def _pixels(data: Visibilities, sky: PointSky) -> Float:
    """Values (S, 4) of the dirty image at the pixels next to the sources: what side lobes add is in them."""
    from astropy import units as u
    from astropy.coordinates import SkyCoord

    cube = Imager(pixels=PIXELS, pixel=FIELD_DEG / PIXELS * u.deg, accuracy=1e-4).image(data)
    where = SkyCoord(sky.ra_rad * u.rad, sky.dec_rad * u.rad)
    x, y = (np.round(v).astype(int) for v in cube.wcs.celestial.world_to_pixel(where))
    return np.asarray(cube.data[0][:, y, x].T)


def _condition(data: Visibilities, sky: PointSky) -> float:
    """Condition number of the PSF matrix of the sources, from two integrations."""
    from instrument.observe.directions import LIGHT, lmn
    from instrument.units import unit_vectors

    at = lmn(unit_vectors(sky.ra_rad, sky.dec_rad), data.at.centre)
    uvw = data.uvw_m[:: max(len(data.uvw_m) - 1, 1)].reshape(-1, 3) * (data.freq_hz[0] / LIGHT)
    fringes = np.exp(-2j * np.pi * (uvw @ at.T))
    return float(np.linalg.cond((fringes.conj().T @ fringes).real))


def _observed(stations: int, times: int, count: int) -> tuple[Visibilities, PointSky]:
    """Sources seen by an array over 8 hours, one of 100 Jy among them, linearly polarized by a tenth."""
    from astropy import units as u
    from astropy.coordinates import SkyCoord

    rng, centre = np.random.default_rng(1), SkyCoord("08h13m36.0s +48d13m03s")
    east, north = rng.uniform(-3, 3, (2, count)) * u.deg
    flux = 10 ** rng.uniform(-1, 1, (count, 1)) * np.concatenate(
        [np.ones((count, 1)), rng.uniform(-0.1, 0.1, (count, 3))], axis=1
    )
    flux[0] = 100.0, 0.0, 0.0, 0.0
    sky = PointSky.at(centre.spherical_offsets_by(east, north), flux)
    names = load("telescopes", "lofar-hba", beam=None).layout().names[:stations]
    night = Observation(
        phase_centre=centre, transit="2012-12-07", duration=8 * u.hour, interval=8 * u.hour / times,
        frequencies=[150] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    array = load("telescopes", "lofar-hba", beam=None, stations=names)
    return Scene(instrument=array, sky=sky, observation=night).plan().run(), sky
