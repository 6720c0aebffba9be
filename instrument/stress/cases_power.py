"""Cases of power spectra beside those of the list: every bin summed by hand, their scatter."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from instrument.analyze.analyzer import Analyzer
from instrument.analyze.power import spectra
from instrument.image.cube import StokesCube
from instrument.observe.directions import LIGHT
from instrument.stress.case import Answer, both, case, claim, held
from instrument.units import Float

FREQ: Float = 150e6 + 0.4e6 * np.arange(24.0)
STEP = np.deg2rad(4 / 60)


def kelvin(data: Float, freq: Float = FREQ, unit: Any = "K", **more: Any) -> StokesCube:
    """A cube in K of 4 arcmin pixels."""
    from astropy import units as u

    return StokesCube(data, freq * u.Hz, 4 * u.arcmin, unit, constants="data", **more)


def cube_of(field: Float, freq: Float = FREQ, other: Float | None = None) -> StokesCube:
    """Stokes I (F, Ny, Nx), and Q + iU, as a cube."""
    data = np.zeros((len(field), 4, *field.shape[1:]))
    data[:, 0] = field
    if other is not None:
        data[:, 1], data[:, 2] = other.real, other.imag
    return kelvin(data, freq)


def mpc(freq: Float, z: float | None = None) -> tuple[float, float, float]:
    """Redshift, transverse Mpc per rad and Mpc per Hz, by astropy's H(z) and distances."""
    from astropy.cosmology import Planck15

    z = 1420405751.768 / ((freq.min() + freq.max()) / 2) - 1 if z is None else z
    distance = float(Planck15.comoving_transverse_distance(z).value)
    per_hz = LIGHT * (1 + z) ** 2 / (float(Planck15.H(z).to_value("m / (s Mpc)")) * 1420405751.768)
    return float(z), distance, per_hz


def cells_of(x: Any, freq: Float, window: Float, along: Float, z: float | None = None) -> tuple[Float, Float, Float]:
    """P of every cell of the whole transform by numpy, and k_perp and k_par (F, Ny, Nx)."""
    _z, distance, per_hz = mpc(freq, z)
    volume = (distance * STEP) ** 2 * per_hz * (freq[1] - freq[0])
    square = (window**2).mean() * (along**2).mean()
    power = np.abs(np.fft.fftn((x - x.mean()) * window * along[:, None, None])) ** 2 * volume / x.size / square
    f, ny, nx = x.shape
    k_par = 2 * np.pi * np.fft.fftfreq(f, (freq[1] - freq[0]) * per_hz)[:, None, None] + np.zeros(x.shape)
    across = np.hypot(*np.meshgrid(*(2 * np.pi * np.fft.fftfreq(n, STEP * distance) for n in (ny, nx)), indexing="ij"))
    return power, across + np.zeros(x.shape), np.abs(k_par)


def taper_of(n: int) -> Float:
    """Blackman and Harris' four terms about the pixel n // 2, periodic in n."""
    phase = 2 * np.pi * (np.arange(n) - n // 2) / n
    return np.asarray(sum(a * np.cos(i * phase) for i, a in enumerate((0.35875, 0.48829, 0.14128, 0.01168))))


def _binned(value: Float, k: Float, edges: Float, use: Any) -> tuple[Float, Float]:
    """Means and numbers of cells in bins [low, high), the last closed."""
    means, counts = [], []
    for j in range(len(edges) - 1):
        top = (k < edges[j + 1] * (1 - 1e-12)) if j < len(edges) - 2 else (k <= edges[j + 1] * (1 + 1e-12))
        inside = use & (k >= edges[j] * (1 - 1e-12)) & top
        counts.append(inside.sum())
        means.append(value[inside].mean() if inside.any() else np.nan)
    return np.array(means), np.array(counts)


@case("PS4", "spectra", "every bin of a cylindrical spectrum", "sums over numpy's cells, odd and even sizes, to 1e-10")
def cylinder(_: None) -> Answer:
    """24 x 15 x 16 and 23 x 16 x 15; tapered; a cut of baselines; Q + iU; delta^2; wedge; the paper's axis."""
    from astropy import units as u

    answers = []
    for shape in ((24, 15, 16), (23, 16, 15)):
        rng = np.random.default_rng(1)
        freq = FREQ[: shape[0]]
        x, p = rng.normal(size=shape), rng.normal(size=(*shape, 2)).view(complex)[..., 0]
        cube, flat, along = cube_of(x, freq, p), np.ones(shape[1:]), taper_of(shape[0])
        _z, distance, per_hz = mpc(freq)
        for stokes, field in (("I", x), ("P", p)):
            power, across, par = cells_of(field, freq, flat, along)
            for how in ({"log": False, "bins": 4}, {"bins": 5}, {"bins": 3, "uv_range": (60.0, 200.0)}):
                found = Analyzer(cube).cylindrical(stokes, **how)  # type: ignore[arg-type]
                step = 2 * np.pi / (shape[0] * (freq[1] - freq[0]) * per_hz)
                row = np.rint(par / step).astype(int)
                cut = how.get("uv_range")
                ends = np.array(cut) * 2 * np.pi / distance if cut else None
                use = (across >= ends[0]) & (across <= ends[1]) if ends is not None else across >= 0
                rows = range(0 if how.get("log") is False else 1, shape[0] // 2 + 1)
                for j, m in enumerate(rows):
                    due, count = _binned(power, across, found.perp_edges, use & (row == m))
                    mean, _c = _binned(across, across, found.perp_edges, use & (row == m))
                    some = count > 0
                    answers += [
                        held(found.power[some, j], due[some], 1e-9),
                        held(found.count[:, j], count, 0.0),
                        held(found.k_perp[some], mean[some], 1e-9),
                        held(found.k_par[j], m * step, 1e-9),
                    ]
                k = np.hypot(found.k_perp[:, None], found.k_par)
                square = found.k_perp[:, None] ** 2 * found.k_par * found.power / (2 * np.pi) ** 2
                answers += [
                    held(np.nan_to_num(found.delta2), np.nan_to_num(square), 1e-13),
                    held(
                        np.nan_to_num(found.delta2_standard), np.nan_to_num(k**3 * found.power / (2 * np.pi**2)), 1e-13
                    ),
                    held(
                        np.nan_to_num(found.wedge(30 * u.deg)),
                        np.nan_to_num(0.5 * found.k_perp * distance / ((freq[0] + freq[-1]) / 2 * per_hz)),
                        1e-7,
                    ),
                    claim(
                        bool(cut) or found.count.sum() + sum(found.left_out.values()) == x.size,
                        f"cells: {found.left_out}",
                    ),
                ]
    return both(*answers)


@case(
    "PS4b",
    "spectra",
    "the paper's axis, to 1 / dnu; Mpc per Hz",
    "a mirror image beyond Nyquist; the derivative of D(z)",
)
def paper_axis(_: None) -> Answer:
    """24 and 23 channels, no taper."""
    answers = []
    for shape in ((24, 15, 16), (23, 16, 15)):
        cube = cube_of(np.random.default_rng(1).normal(size=shape), FREQ[: shape[0]])
        paper = Analyzer(cube).cylindrical(taper=None, paper_axis=True, bins=3)
        plain = Analyzer(cube).cylindrical(taper=None, bins=3)
        n = plain.power.shape[1]
        answers += [
            held(paper.power[:, :n], plain.power, 1e-12),
            held(paper.k_par[-1], (shape[0] - 1) * plain.k_par[0], 1e-12),
            held(paper.power[:, -1], plain.power[:, 0], 1e-12),
        ]
    from astropy.cosmology import Planck15

    z, distance, _per_hz = mpc(FREQ)
    apart = float((Planck15.comoving_distance(z * (1 + 1e-5)) - Planck15.comoving_distance(z * (1 - 1e-5))).value)
    slope = apart / (2e-5 * z) * (1 + z) ** 2 / 1420405751.768
    frame = Analyzer(cube_of(np.random.default_rng(0).normal(size=(24, 6, 6)))).cylindrical(bins=1).frame
    answers += [
        held(frame.depth_mpc_per_hz, slope, 1e-6),
        held([frame.redshift, frame.distance_mpc], [z, distance], 1e-12),
    ]
    return both(*answers)


@case(
    "PS5",
    "spectra",
    "every bin of a spherical spectrum",
    "sums over numpy's cells, to 1e-10; wedges left out",
)
def sphere(_: None) -> Answer:
    """Linear and log bins, a wedge of 20 deg and k_par above 0.1."""
    from astropy import units as u

    rng = np.random.default_rng(2)
    x = rng.normal(size=(24, 15, 16))
    cube, along = cube_of(x), taper_of(24)
    power, across, par = cells_of(x, FREQ, np.ones((15, 16)), along)
    k = np.hypot(across, par)
    _z, distance, per_hz = mpc(FREQ)
    slope = distance / ((FREQ[0] + FREQ[-1]) / 2 * per_hz)
    answers = []
    for how, keep in (
        ({"log": False, "bins": 5}, k > 0),
        ({"bins": 6}, k > 0),
        (
            {"bins": 4, "wedge": 20 * u.deg, "k_par_min": 0.1},
            (par >= 0.1) & (across * slope * np.sin(np.deg2rad(20)) <= par * (1 + 1e-12)),
        ),
    ):
        found = Analyzer(cube).spherical(**how)
        due, count = _binned(power, k, found.edges, keep)
        mean, _c = _binned(k, k, found.edges, keep)
        some = count > 0
        answers += [
            held(found.power[some], due[some], 1e-9),
            held(found.count, count, 0.0),
            held(found.k[some], mean[some], 1e-9),
            held(found.delta2[some], found.k[some] ** 3 * due[some] / (2 * np.pi**2), 1e-9),
            claim(found.count.sum() + sum(found.left_out.values()) == x.size, f"cells: {found.left_out}"),
            held(
                found.average(lambda q: q**-2)[some],
                _binned(np.where(k > 0, k, 1) ** -2.0, k, found.edges, keep)[0][some],
                1e-9,
            ),
        ]
    return both(*answers)


@case("PS5b", "spectra", "every bin of the spectrum of an image", "sums over numpy's cells, to 1e-10")
def flat(_: None) -> Answer:
    """With a hole; with a taper; with a cut of baselines."""
    rng, answers = np.random.default_rng(2), []
    image = rng.normal(size=(15, 16))
    image[3:5, 7] = np.nan
    data = np.zeros((1, 4, 15, 16))
    data[0, 0] = image
    one = kelvin(data, FREQ[:1])
    z, distance, _h = mpc(FREQ[:1])
    hann = np.multiply.outer(*(0.5 + 0.5 * np.cos(2 * np.pi * (np.arange(n) - n // 2) / n) for n in (15, 16)))
    has = np.isfinite(image)
    for how, w in (
        ({"bins": 4}, has * 1.0),
        ({"bins": 4, "taper": "hann", "log": False}, has * hann),
        ({"bins": 2, "uv_range": (40.0, 200.0)}, has * 1.0),
    ):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            got = Analyzer(one).spectrum_2d(**how)
        y = np.where(has, image - image[has].mean(), 0) * w
        cells = np.abs(np.fft.fft2(y)) ** 2 * (distance * STEP) ** 2 / y.size / (w**2).mean()
        uv = np.hypot(*np.meshgrid(*(np.fft.fftfreq(n, STEP) for n in (15, 16)), indexing="ij"))
        cut: Any = how.get("uv_range", (0.0, np.inf))
        low, high = cut
        due, count = _binned(cells, uv * 2 * np.pi / distance, got.edges, (uv > 0) & (uv >= low) & (uv <= high))
        some = count > 0
        answers += [
            held(got.power[some], due[some], 1e-9),
            held(got.count, count, 0.0),
            held(got.redshift, z, 1e-13),
            held(got.uv[some] * 2 * np.pi / distance, got.k_perp[some], 1e-9),
            held(got.missing, 2 / 240, 1e-12),
            held(got.delta2[some], got.k_perp[some] ** 2 * due[some] / (2 * np.pi), 1e-9),
            held(spectra.ratio(got, got)[some], 1.0, 1e-15),
        ]
    return both(*answers)
