"""The slips of the paper: each printed form computed beside the right one; that they differ is what is to be shown."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from instrument.analyze.faraday.band import FaradayBand
from instrument.analyze.ixr import leakage_of_ixr
from instrument.jones.mueller import (
    TO_LINEAR,
    TO_STOKES,
    brightness,
    di_errors,
    ixr_jones,
    ixr_mueller,
    leakage,
    mueller,
)
from instrument.observe.directions import LIGHT
from instrument.paper.bench import Bench
from instrument.paper.errata_power import BAND_HZ, distance, nyquist, tone, volume
from instrument.paper.finding import Finding, near, slip
from instrument.paper.ixr import corrected, station
from instrument.paper.patch import around, from_transit, rings, zenith
from instrument.registry import load
from instrument.report.style import BLUE, ORANGE, styled
from instrument.units import Complex, Float

PAIR = ("CS001HBA0", "CS001HBA1")
RADII = np.arange(0.5, 4.01, 0.5)  # deg


def run(bench: Bench) -> list[Finding]:
    """The thirteen in the order of docs/paper.md; nothing but the noise of 9 and the errors of 2 is drawn."""
    rng = np.random.default_rng(196 if bench.seed is None else bench.seed)
    from instrument.pipeline.scene_file import parse

    scene = parse(bench.tables("mock-grid", f"instrument.stations={list(PAIR)}")).scene()
    false_v, first = _circular(scene), _first_order(rng)
    found = [
        *_conjugate(false_v), *_order(first), *_half(), *_element(scene), *_resolution(), *_convolution(), *nyquist(),
        *distance(), *volume(rng), *_channels(), *_decibel(), *_psf(bench), *_density(bench),
    ]  # fmt: skip
    bench.draw("slips", _draw(false_v, first), "Slips 1, 2, 5 and 7: the printed form and the right one.", wide=True)
    return found


def _percent(printed: float, ours: float) -> str:
    return f"{100 * (printed / ours - 1):+.3g} %"


def _circular(scene: Any) -> dict[str, Float]:
    """I to V in % by radius, worst direction, at transit: with conj(J_b), and with J_b^H as printed."""
    from astropy import units as u

    centre = scene.observation.phase_centre
    where = around(centre, *rings(RADII, np.arange(0.0, 360.0, 10.0)))
    when = from_transit(scene.observation, scene.instrument.layout(), [0.0])
    jones = scene.instrument.beam(where, when, 150 * u.MHz, pointing=centre.skycoord, state="differential")[0, 0]
    a, b = jones
    printed = np.einsum("sij,skl->sikjl", a, np.conj(np.swapaxes(b, -1, -2))).reshape(-1, 4, 4)
    both = {"conj": mueller(a, b), "printed": TO_STOKES @ printed @ TO_LINEAR}
    return {key: 100 * leakage(m)[1].reshape(len(RADII), -1).max(1) for key, m in both.items()}


def _conjugate(false_v: dict[str, Float]) -> list[Finding]:
    found = []
    for deg in (1, 2, 3, 4):
        at = int(np.argmin(np.abs(RADII - deg)))
        right, wrong = float(false_v["conj"][at]), float(false_v["printed"][at])
        text = f"with J_b^H it is {wrong:.1f} %"
        what = f"1. I to V {deg} deg from the centre, transit, worst direction"
        # at transit LOFAR makes no more of I into V than 0.003 %, by the paper itself
        found.append(slip(what, right, "%", "J_a kron J_b^H", wrong, text, (0.0, 0.003)))
    return found


def _first_order(rng: Any) -> dict[str, Float]:
    """Rms error of the first-order Mueller matrix at some sizes of errors: right, and without the i as printed."""
    unit = rng.normal(size=(2, 500, 2, 2)) + 1j * rng.normal(size=(2, 500, 2, 2))
    size = np.logspace(-4, -1, 7)
    out: dict[str, list[float]] = {"right": [], "printed": []}
    for delta in size:
        a, b = np.eye(2) + delta * unit / np.sqrt(2)
        exact, right = mueller(a, b), di_errors(a, b).first_order_mueller()
        printed = right.copy()
        printed[..., 3, 1] /= 1j
        for key, matrix in (("right", right), ("printed", printed)):
            out[key].append(float(np.sqrt(np.mean(np.abs(matrix - exact) ** 2))))
    return {"size": size, **{key: np.array(values) for key, values in out.items()}}


def _order(first: dict[str, Float]) -> list[Finding]:
    low, high = (int(np.argmin(np.abs(first["size"] - x))) for x in (1e-3, 1e-2))
    right, wrong = (float(first[key][high] / first[key][low]) for key in ("right", "printed"))
    excess = float(first["printed"][low] / first["right"][low])
    text = f"without the i in row V, column Q it grows {wrong:.1f} times; at 1e-3 it is {excess:.0f} times as large"
    what = "2. error of the first-order matrix at errors of 1e-2, over that at 1e-3"
    return [slip(what, right, "", "delta_QV, no i", wrong, text, near(100.0, 0.05))]  # what is left is second order


def _half() -> list[Finding]:
    one = np.array([1.0, 0.0, 0.0, 0.0])
    right, wrong = float(brightness(one)[0, 0].real), float((0.5 * TO_LINEAR @ one)[0].real)
    j = station(0.3)
    kron = np.kron(j, j.conj())
    apart = np.abs(np.linalg.inv(0.5 * TO_LINEAR) @ kron @ (0.5 * TO_LINEAR) - mueller(j, j)).max()
    text = f"S with its 1/2 gives {wrong:g}, B without one {right:g}; Mueller matrices of the two differ by {apart:.0e}"
    return [slip("3. correlation pp of 1 Jy of I", right, "Jy", "B without 1/2, S with", wrong, text, near(1.0))]


def _element(scene: Any) -> list[Finding]:
    """At the zenith a dipole cannot know the azimuth from which one comes there: the spread is to be small."""
    from astropy import units as u

    layout = scene.instrument.layout()
    when = from_transit(scene.observation, layout, [0.0])
    up = zenith(layout, when)
    where = around(up, *rings(np.array([0.5]), np.arange(0.0, 360.0, 15.0)))
    at = scene.instrument.sampling(where, when, 150 * u.MHz, up.skycoord)
    jones = load("elements", "hamaker").jones(at)[0, 0, 0]  # columns e_theta, e_phi
    cos, sin = (x[0, 0] for x in at.azimuth_cos_sin)
    level = np.moveaxis(np.array([[cos, sin], [-sin, cos]]), -1, 0)  # to p and q, the same for every azimuth
    right, wrong = (100 * _spread(jones @ np.diag([1.0, sign]) @ level) for sign in (1, -1))
    text = f"with -p_phi it is {wrong:.0f} %: the dipoles turn the wrong way; the minus is in the coefficients already"
    return [
        slip(
            "4. element half a degree from the zenith, spread over azimuth",
            right,
            "%",
            "-p_phi",
            wrong,
            text,
            (0.0, 1.0),
        )
    ]


def _spread(jones: Complex) -> float:
    mean = jones.mean(0)
    size = np.sqrt(np.mean(np.abs(jones) ** 2))
    return float(np.abs(jones - mean).max() / size)


def _faraday(depths: Float, lambda2: Float, weights: Float, signal: Complex) -> Complex:
    middle = np.average(lambda2, weights=weights)
    turns = np.exp(-2j * np.multiply.outer(depths, lambda2 - middle))
    return np.asarray(turns @ (weights * signal) / weights.sum())


def _resolution() -> list[Finding]:
    from astropy import units as u

    band = FaradayBand.of(BAND_HZ * u.Hz)
    depths = np.arange(-6.0, 6.0, 0.01)

    def peaks(apart: float) -> int:
        x = band.lambda2 - band.lambda2.mean()
        f = np.abs(_faraday(depths, band.lambda2, band.weights, 2 * np.cos(apart * x) + 0j))
        return int(np.sum((f[1:-1] > f[:-2]) & (f[1:-1] > f[2:]) & (f[1:-1] > f.max() / 2)))

    text = f"two screens 1 rad/m2 apart show {peaks(1.0)} peak, 2.5 apart {peaks(2.5)}"
    half = f"{text}; printed is {_percent(1.0, band.fwhm)} of the measured width"
    width = (LIGHT / 134e6) ** 2 - (LIGHT / 166e6) ** 2  # of the RMSF of even weights: 3.79 over it
    shown = "5. resolution, half height of the RMSF"
    return [
        slip("5. resolution, 2 sqrt(3) / width in lambda2", band.fwhm_nominal, "rad/m2", "1", 1.0, text,
              near(2 * np.sqrt(3) / width)),
        slip(shown, band.fwhm, "rad/m2", "1", 1.0, half, near(3.79 / width)),
    ]  # fmt: skip


def _convolution() -> list[Finding]:
    """A source of 1 at a depth; weights from 1 to 4. The period of the even channels makes the convolution exact."""
    n = 64
    lambda2 = np.linspace(LIGHT**2 / 166e6**2, LIGHT**2 / 134e6**2, n)
    step = lambda2[1] - lambda2[0]
    depths = np.arange(n) * np.pi / (n * step)
    weights, source = np.linspace(1.0, 4.0, n) / 2.5, depths[5]
    signal = np.exp(2j * source * lambda2)
    right = float(np.abs(_faraday(np.array([source]), lambda2, weights, signal))[0])
    turns = np.exp(-2j * np.multiply.outer(depths, lambda2))
    rmsf, integral = turns @ weights / weights.sum(), turns @ (weights * signal) * step
    folded = np.fft.ifft(np.fft.fft(rmsf) * np.fft.fft(integral)) * (depths[1] - depths[0])
    wrong = float(np.abs(folded[5]))
    even = np.pi  # what even weights of 1 give, exactly
    text = f"the printed convolution gives {wrong:.3g}: pi, and the weights once more ({_percent(wrong, even)})"
    return [slip("6. F of a source of 1, weights from 1 to 4", right, "", "RMSF * integral", wrong, text, near(1.0))]


def _channels() -> list[Finding]:
    right = 1e-6 * float(np.ptp(BAND_HZ))
    wrong = (len(BAND_HZ) - 1) * 0.19
    width = right / (len(BAND_HZ) - 1)
    text = f"160 steps of 0.19 MHz span {wrong:.1f} MHz; {right:.1f} MHz takes {width:.2f} MHz"
    return [slip("10. what 161 channels span", right, "MHz", "161 of 0.19", wrong, text, near(166.0 - 134.0))]


def _decibel() -> list[Finding]:
    before = station(float(leakage_of_ixr(25.0)))
    after = corrected(before, 0.3)
    right, other = (10 * np.log10(ixr(after) / ixr(before)) for ixr in (ixr_mueller, ixr_jones))
    text = f"25 dB and the step of IXR_J, {other:.1f} dB, are {25 + other:.1f} dB: {10 - right:.1f} dB too much"
    return [slip("11. IXR_M of 25 dB with 30 % of the leakage left", 25 + float(right), "dB", "35", 35.0, text,
                  near(25 - 10 * np.log10(0.3), 0.005))]  # fmt: skip


def _psf(bench: Bench) -> list[Finding]:
    from astropy import units as u

    from instrument.pipeline.scene_file import parse

    step = bench.choose("10 min", "2 min")
    settings = ("instrument.beam=none", "observation.duration=8 h", f"observation.interval={step}", "sky.shape=[1, 1]")
    visibilities = parse(bench.tables("mock-grid", *settings)).scene().plan().run()
    psf = load("imagers", "dirty", pixels=256, pixel=0.6 * u.arcmin, uv_range=(30, 800)).psf(visibilities)
    sizes = 60 * np.rad2deg([psf.major_rad[0], psf.minor_rad[0]])
    mean = float(np.sqrt(sizes.prod()))
    disc = 0.6 * 2 * np.sqrt(np.count_nonzero(psf.data[0] > 0.5 * psf.data[0].max()) / np.pi)  # of as many pixels
    text = f"{sizes[0]:.2f} x {sizes[1]:.2f} arcmin, natural weights, 30 to 800 wavelengths; the printed K per Jy/beam"
    found = []
    for where, printed in (("caption", "3"), ("table", "4.3")):
        wrong = float(printed)
        because = f"{text} is {_percent((mean / wrong) ** 2, 1)}"
        found.append(slip(f"12. PSF, beside the {where}", mean, "arcmin", printed, wrong, because, near(disc, 0.05)))
    return found


def _density(bench: Bench) -> list[Finding]:
    """Counts of Hopkins et al. (2003), AJ 125, 465, at 1.4 GHz, fluxes by an index of -0.75, in a disc of 5 deg."""
    from instrument.units import direction

    mock = load("skies", "mock-3c196").place(direction("08h13m36.0s +48d13m03s", "centre"))
    ours = np.sort(mock.stokes(np.array([150e6]))[0, :, 0])[::-1]
    shape = np.polynomial.Polynomial([0.859, 0.508, 0.376, -0.049, -0.121, 0.057, -0.008])

    flux = np.geomspace(0.027, ours[1], 4001) * (150 / 1400) ** 0.75  # Jy, up to the brightest but 3C196
    counts = 10 ** shape(np.log10(1000 * flux)) * flux**-2.5 * 2 * np.pi * (1 - np.cos(np.deg2rad(5)))  # per Jy
    count = float(np.trapezoid(counts, flux))
    total = float(np.trapezoid(counts * flux, flux)) * (1400 / 150) ** 0.75
    # TGSS at 150 MHz, Intema et al. (2017), A&A 598, A78: 623604 sources on 36900 deg2, most above 24.5 mJy (7 sigma),
    # where it has half of what there is
    tgss = 623604 / 36900 * 78.5
    what = "13. within 5 deg by published counts,"
    told = (
        f"counts of Hopkins et al. (2003), by an index of -0.75; the mock has {len(ours)}, {len(ours) / count:.2f} "
        f"times as many; the range is once to twice what TGSS found above 24.5 mJy, {tgss:.0f}: 623604 sources on "
        "36900 deg2, half of what there is at that flux (Intema et al. 2017)"
    )
    mock = float(ours[1:].sum())
    sources = slip(f"{what} sources above 27 mJy", count, "", "4567", 4567.0, told, (tgss, 2 * tgss))
    return [
        sources._replace(kept="the mock field follows the paper"),
        Finding(f"{what} flux without 3C196", total, "Jy", since=f"the paper: 713.6; the mock has {mock:.1f} Jy"),
    ]


@styled
def _draw(false_v: dict[str, Float], first: dict[str, Float]) -> Figure:
    from astropy import units as u

    figure = Figure(figsize=(11, 8), layout="constrained")
    (one, two), (five, seven) = figure.subplots(2, 2)
    for key, colour, label in (("conj", BLUE, "conj(J_b)"), ("printed", ORANGE, "J_b^H, printed")):
        one.semilogy(RADII, false_v[key], color=colour, label=label)
    one.set(title="1. I to V at transit", xlabel="from the centre (deg)", ylabel="%")
    for key, colour, label in (("right", BLUE, "with i"), ("printed", ORANGE, "without, printed")):
        two.loglog(first["size"], first[key], color=colour, label=label)
    two.set(title="2. error of the first-order matrix", xlabel="errors of the stations")
    band = FaradayBand.of(BAND_HZ * u.Hz)
    depths = np.arange(-4.0, 4.01, 0.02)
    five.plot(
        depths, np.abs(_faraday(depths, band.lambda2, band.weights, np.ones(161, complex))), color=BLUE, label="|RMSF|"
    )
    for width, colour, label in ((band.fwhm, BLUE, f"{band.fwhm:.2f}"), (1.0, ORANGE, "1, printed")):
        five.plot([-width / 2, width / 2], [0.5, 0.5], color=colour, marker="|", markersize=12, label=label)
    five.set(title="5. resolution", xlabel="Faraday depth (rad/m2)")
    k, power, at = tone()
    half = k <= k[-1] / 2 * 1.01
    seven.plot(k, power / power.max(), color=ORANGE, label="printed axis")
    seven.plot(k[half], power[half] / power.max(), color=BLUE, label="up to Nyquist")
    seven.set(title=f"7. a tone at {at:.2f} /Mpc", xlabel="k_par (/Mpc)")
    for ax in (one, two, five, seven):
        ax.legend(frameon=False)
    return figure
