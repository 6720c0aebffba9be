"""The contest of foreground removers on one cube: leaked polarization, noise, and a 21-cm signal that must stay."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from instrument.analyze.power.signal import Signal21cm
from instrument.errors import InstrumentWarning
from instrument.foreground.loss import signal_loss
from instrument.image.cube import StokesCube
from instrument.image.mocks import leaked, noise_cube, polarized_screens
from instrument.precision.contest import RIGHT, Contest, Entry, Form, Trial
from instrument.sky.screens import FINE

PIXELS = (48, 96)  # of the quick form and of the full one
LEAKED, NOISE = 7.1e-3, 10e-3  # K, rms of a voxel in Stokes I
KNOBS = {  # field of a remover -> its values; the first that a remover has is its knob
    "components": tuple(map(float, range(1, 11))),
    "terms": tuple(map(float, range(1, 11))),
    "order": tuple(map(float, range(9))),
    "depth": (0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0),
}
SCREENS = FINE.with_fields(width=0.5, floor=0.05, slope=3.5, uv_range=(10.0, 800.0))


def contests(removers: dict[str, Any], form: Form) -> list[Contest]:
    """One: Faraday screens that leak into I, 7.1 mK, under noise of 10 mK, 161 channels from 134 to 166 MHz."""
    from astropy import units as u

    pixels = PIXELS[0] if form.quick else PIXELS[1]
    screens = leaked(polarized_screens(pixels=pixels, pixel=0.5 * u.arcmin, screens=SCREENS, seed=196))
    data = np.array(screens.data)
    data[:, 0] *= np.float32(LEAKED / screens.data[:, 0].std())
    truth = screens.with_data(data)
    cube = truth.with_data(truth.data + noise_cube(truth, NOISE * u.K, True, 1).data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InstrumentWarning)  # scales outside the table get no power
        signal = Signal21cm.table().cube(pixels, 0.5 * u.arcmin, truth.freq_hz * u.Hz, seed=21)

    def judge(split: Any, asked: float) -> Trial:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InstrumentWarning)
            score = split.score(foreground=truth).value
            loss = signal_loss(split.remover, cube, signal)
        kept, _ = loss.within((0.06, 1.0), (0.02, 0.5))
        across, along = (loss.k_perp >= 0.02) & (loss.k_perp < 0.5), (loss.k_par >= 0.06) & (loss.k_par < 1)
        worst = float(np.nanmax(np.abs(1 - loss.transfer[np.ix_(across, along)])))
        ended = RIGHT if split.outcome.name == "CONVERGED" else split.outcome.name
        return Trial(float(score), float(abs(1 - kept)), ended, worst)

    return [
        Contest(
            name="remove leaked polarization",
            kind="foregrounds",
            knob="own setting",
            values=(0.0,),
            entries=tuple(_entry(name, cls, cube, form.quick) for name, cls in removers.items()),
            judge=judge,
            error="power of what the removal got wrong over that of the foreground (1: nothing gained)",
            error_user="21-cm signal lost, 0.06 < k_par < 1 and 0.02 < k_perp < 0.5 1/Mpc",
            truth="the foreground and the signal of which the cube was made",
        )
    ]


def _entry(name: str, cls: Any, cube: StokesCube, quick: bool) -> Entry:
    fields = cls.model_fields
    knob = next((field for field in KNOBS if field in fields), None)
    whole = knob != "depth"

    def answer(asked: float) -> Any:
        settings = {} if knob is None else {knob: int(asked) if whole else asked}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InstrumentWarning)
            split = cls(**settings).split(cube)
            split.residual  # noqa: B018  worked out when it is asked for
        return split

    if knob is None:
        return Entry(name, answer, (0.0,))
    return Entry(f"{name} ({knob})", answer, KNOBS[knob][1::3] if quick else KNOBS[knob])
