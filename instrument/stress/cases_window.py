"""Cases of the 21-cm signal: fields of a tabulated spectrum, the EoR window by hand, channels filled in."""

from __future__ import annotations

import warnings

import numpy as np

from instrument.analyze.analyzer import Analyzer
from instrument.analyze.power import cylinders
from instrument.analyze.power.channel_grid import infill_operator
from instrument.analyze.power.signal import Signal21cm
from instrument.image.psf import Psf
from instrument.stress.case import Answer, both, case, claim, held
from instrument.stress.cases_power import FREQ, STEP, cube_of, kelvin, mpc


@case(
    "PS7",
    "spectra",
    "21-cm fields of a tabulated spectrum",
    "their mean power is the table's, to 4 sigma; tables by hand",
)
def signal(_: None) -> Answer:
    """ln-ln between points; K^2 Mpc^3; 20 periodic cubes, and one cut out of a larger field; average over cells."""
    from astropy import units as u

    model = Signal21cm.table()
    k = model.k
    middle = np.sqrt(k[3] * k[4])
    steep = Signal21cm("steep", 9.0, np.array([1e-3, 100.0]), np.array([1.0, 1e5**1.5]))
    answers = [
        held(model.delta2(k), model.delta2_mk2, 1e-12),
        held(model.delta2(middle), np.sqrt(model.delta2_mk2[3] * model.delta2_mk2[4]), 1e-12),
        held(model.power(k[5]), 2 * np.pi**2 * model.delta2_mk2[5] * 1e-6 / k[5] ** 3, 1e-12),
        held(model.cylindrical(0.3, 0.4)[0, 0], model.delta2(0.5) * 0.3**2 * 0.4 / (2 * 0.5**3), 1e-12),
        claim(bool(model.inside(k[0])) and bool(model.inside(k[-1])) and not model.inside(k[-1] * 1.1), "its ends"),
    ]
    ratio, sigma = [], np.zeros(4)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for seed in range(20):
            made = steep.cube((14, 15), 4 * u.arcmin, FREQ[:16] * u.Hz, seed, periodic=seed < 16)
            found = Analyzer(made).spherical(bins=4, taper=None, log=False)
            ratio.append(found.power / found.average(steep.power_or_nan) if seed < 16 else np.ones(4))
            sigma = found.sigma / found.power
    mean = np.mean(ratio[:16], axis=0)
    use = np.isfinite(mean)
    answers.append(Answer(float(np.abs((mean - 1)[use] / (sigma[use] / 4)).max()), 4.0, graded=False))
    return both(*answers)


@case("PS8", "spectra", "the EoR window of four bins by hand", "open, area, reach, removal needed: exactly")
def window(_: None) -> Answer:
    """A noise cube and a signal: where power (1 - removed)^2 + noise is below it, above the wedge; brute force."""
    from astropy import units as u

    rng = np.random.default_rng(3)
    leak, noise = 0.03 * rng.normal(size=(24, 15, 16)), 0.001 * rng.normal(size=(24, 15, 16))
    model = Signal21cm("flat", 8.5, np.array([1e-3, 100.0]), np.array([60.0, 60.0]))
    found = Analyzer(cube_of(leak)).eor_window(
        model, noise=cube_of(noise), wedge=10 * u.deg, k_par_min=0.08, bins=4, bins_par=5
    )
    power, level, due = found.leakage.power, found.noise, found.signal
    line = np.nan_to_num(found.leakage.wedge(10 * u.deg))[:, None]
    counts = np.isfinite(power) & ~((found.leakage.k_par < line) | (found.leakage.k_par < 0.08))
    area = np.outer(np.diff(np.log(found.leakage.perp_edges)), np.diff(np.log(found.leakage.par_edges)))
    answers = [claim(np.array_equal(found.counts, counts), "bins that count")]
    for removed in (0.0, 0.5, 0.9):
        total = power * (1 - removed) ** 2 + level
        mask = counts & (np.nan_to_num(total, nan=np.inf) < due)
        answers += [
            claim(np.array_equal(found.mask(removed), mask), f"the mask at {removed}"),
            held(found.area(removed), [area[mask].sum(), area[mask].sum() / area[counts].sum()], 1e-12),
        ]
        rows = [m for m in range(5) if counts[:, m].any()]
        full = [m for m in rows if mask[:, m].sum() >= counts[:, m].sum()]
        reach = found.reach(removed)
        if full == list(range(full[0], full[-1] + 1)) if full else False:
            answers.append(
                held(reach, [found.leakage.par_edges[full[0]], found.leakage.par_edges[full[-1] + 1]], 1e-12)
            )
        elif not full:
            answers.append(claim(np.isnan(reach[0]), f"reach {reach}"))
    top = found.removal_needed(0.5)
    use = counts & (found.leakage.k_par <= 0.5)
    answers.append(held(top, max(0.0, float((1 - np.sqrt((due - level)[use] / power[use])).max())), 1e-9))
    _z, distance, per_hz = mpc(FREQ)
    answers.append(held(found.leakage.frame.horizon_slope, distance / ((FREQ[0] + FREQ[-1]) / 2 * per_hz), 1e-7))
    less = found.leakage.less(found.leakage)
    answers.append(held(np.nan_to_num(less.power), 0 * np.nan_to_num(power), 0.0, scale=1.0))
    answers.append(held(np.nan_to_num(cylinders.ratio(found.leakage, found.leakage)), np.isfinite(power) * 1.0, 1e-15))
    return both(*answers)


@case(
    "60c",
    "spectra",
    "channels filled in",
    "sinusoids within the delay asked for come back to 1e-5; the PSF divided out",
)
def filled(_: None) -> Answer:
    """3 of 40 channels missing, delays to 200 ns; and cells divided by |DFT(PSF)|."""
    from astropy import units as u

    freq = 150e6 + 0.2e6 * np.arange(40.0)
    here = np.ones(40, bool)
    here[[7, 20, 21]] = False
    operator = infill_operator(freq, here, 300e-9)
    tone = np.exp(2j * np.pi * np.outer(freq - freq[0], [0.0, 1e-7, -2e-7]))
    psf = np.zeros((24, 15, 16))
    psf[:, 7, 8], psf[:, 7, 7] = 1.0, 0.25
    x = np.random.default_rng(1).normal(size=(24, 15, 16))
    blurred = np.fft.ifft2(np.fft.fft2(x) * np.fft.fft2(np.fft.ifftshift(psf, axes=(1, 2)))).real
    beam = Psf(psf, *(np.full(24, v) for v in (1e-3, 1e-3, 0.0, 0.0)))
    omega = np.pi / (4 * np.log(2)) * 1e-6
    data = np.zeros((24, 4, 15, 16))
    data[:, 0] = blurred
    corrected = Analyzer(kelvin(data, psf=beam)).cylindrical(psf_corrected=True, bins=3)
    plain = Analyzer(cube_of(x)).cylindrical(bins=3)
    holed = np.repeat(np.cos(2 * np.pi * 5e-8 * (freq - freq[0]))[:, None, None], 15, 1) * x[0][None, :15]
    some = holed.copy()
    some[[7, 20, 21]] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        back = Analyzer(cube_of(some, freq)).cylindrical(infill=300 * u.ns, bins=3)
    whole = Analyzer(cube_of(holed, freq)).cylindrical(bins=3)
    return both(
        held(operator @ tone[here], tone[~here], 1e-5),
        held(corrected.power * (STEP**2 / omega) ** 2, plain.power, 1e-9),
        held(back.power, whole.power, 1e-4),
    )
