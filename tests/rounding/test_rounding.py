"""Rounding decides nothing: inputs moved by one ulp, orders permuted, 1 and 2 threads; numbers by their own tolerance.

Two draws of each in the default run; `pytest -m rounding` makes 30. The tolerances are those that the tests of each
part hold the same numbers to (named beside them): what does not survive a change of the last bit is no number.
"""

import warnings

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from threadpoolctl import threadpool_limits

import instrument
from instrument import (
    Analyzer,
    Chain,
    FeedTerm,
    GainTerm,
    Imager,
    InstrumentWarning,
    Observation,
    Outcome,
    PointSky,
    Scene,
    SelfCal,
    StokesCube,
)  # fmt: skip
from instrument.analyze.sources.photometry import ForcedPhotometry
from instrument.conformance.foregrounds import foreground_cube

pytestmark = pytest.mark.rounding
CENTRE = SkyCoord("08h13m36.0s +48d13m03s")
STATIONS = ["CS001HBA0", "CS003HBA1", "CS011HBA0", "CS101HBA0", "CS302HBA1", "RS106HBA", "RS205HBA", "RS508HBA"]


@pytest.fixture
def draws(request):
    """Seeds of the draws, on 1 and 2 threads in turn: 30 of them where `-m rounding` asks for all, else 2."""

    def each():
        for seed in range(30 if "rounding" in (request.config.option.markexpr or "") else 2):
            with threadpool_limits(1 + seed % 2):
                yield seed

    return each()


def ulp(values, seed):
    """Every number moved by one ulp, up or down; complex ones in both parts."""
    values = np.ascontiguousarray(values)
    if values.dtype.kind == "c":
        return ulp(values.view(values.real.dtype), seed).view(values.dtype)
    way = np.where(np.random.default_rng(seed).random(values.shape) < 0.5, -np.inf, np.inf)
    return np.nextafter(values, way.astype(values.dtype))


# Cubes -----------------------------------------------------------------------------------------------------------


def as_cube(data, freq):
    return StokesCube(data, freq * u.Hz, 8 * u.arcmin, "K")


def variants(data, seed):
    """Cubes of the same content, the order of their channels, and the way back for maps (N, Ny, Nx)."""
    order = np.random.default_rng(seed).permutation(len(data))
    yield ulp(data[order], seed), order, lambda x: x
    yield (
        np.ascontiguousarray(data[:, :, ::-1].swapaxes(2, 3)),
        np.arange(len(data)),
        lambda x: x.swapaxes(1, 2)[:, ::-1],
    )


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("gmca", {}), ("gmca", {"mode": "threshold"}), ("pca", {}), ("polynomial", {}), ("faraday-filter", {}),
        ("gpr", {}),
    ],
    ids=str,
)  # fmt: skip
def test_residuals_of_removers(name, settings, draws):
    cube = foreground_cube()[0]
    remover = instrument.load("foregrounds", name, **settings)
    first = remover.split(cube)
    for seed in draws:
        for data, order, back in variants(cube.data, seed):
            found = remover.split(as_cube(data, cube.freq_hz[order]))
            assert found.outcome is first.outcome
            # of 1 K; conformance holds every remover to 1e-6 in another order of channels
            assert np.abs(back(found.residual.data[np.argsort(order), 0]) - first.residual.data[:, 0]).max() < 1e-6


@pytest.mark.parametrize("name", ["gmca", "pca", "polynomial"])
def test_residuals_of_removers_in_single_precision(name, draws):
    cube = foreground_cube()[0]
    data = cube.data.astype(np.float32)
    remover = instrument.load("foregrounds", name)
    first = remover.split(as_cube(data, cube.freq_hz)).residual.data[:, 0]
    for seed in draws:
        for moved, order, back in variants(data, seed):
            found = remover.split(as_cube(moved, cube.freq_hz[order])).residual.data[np.argsort(order), 0]
            # one ulp of 1.8 K is 1e-7; the extreme cases hold float32 to 1e-4
            assert np.abs(back(found) - first).max() < 3e-6


def test_spectra_of_cubes(draws):
    cube = foreground_cube()[0]
    options = {"stokes": "I", "bins": 6, "bins_par": 6}
    first = Analyzer(cube).cylindrical(**options).power
    for seed in draws:
        for data, order, _ in variants(cube.data, seed):
            found = Analyzer(as_cube(data, cube.freq_hz[order])).cylindrical(**options).power
            # of the brightest bin; the definition is met to 1e-10 of it
            assert np.nanmax(np.abs(found - first)) < 1e-10 * np.nanmax(first)


def test_faraday_depths(draws):
    freq = 134e6 + 1e6 * np.arange(33)
    rng = np.random.default_rng(5)
    p = np.exp(2j * (0.3 + np.multiply.outer((299792458.0 / freq) ** 2, rng.uniform(-20, 20, (6, 7)))))
    data = np.zeros((33, 4, 6, 7))
    data[:, 1], data[:, 2] = p.real, p.imag
    data += 0.05 * rng.normal(size=data.shape)
    depths = np.arange(-30, 30.1, 0.25) * u.rad / u.m**2
    first = Analyzer(as_cube(data, freq)).rm_synthesis(depths)
    for seed in draws:
        for moved, order, back in variants(data, seed):
            found = Analyzer(as_cube(moved, freq[order])).rm_synthesis(depths)
            # of 1; the plain sum is met to 1e-12
            assert np.abs(back(found.data) - first.data).max() < 1e-12


# Visibilities ----------------------------------------------------------------------------------------------------


def scene(stations, sky=None, beam=False, slots=8):
    if sky is None:
        rng = np.random.default_rng(1)
        flux = rng.normal(size=(30, 4))
        flux[0] = 1e3, 0, 0, 0
        sky = PointSky.at(CENTRE.spherical_offsets_by(*rng.uniform(-4, 4, (2, 30)) * u.deg), flux)
    night = Observation(
        phase_centre=CENTRE, transit="2012-12-07", duration=8 * u.hour, interval=8 / slots * u.hour,
        frequencies=[150] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    kind = {} if beam else {"beam": None}
    return Scene(
        instrument=instrument.load("telescopes", "lofar-hba", stations=stations, **kind), sky=sky, observation=night
    )


def orders(seed):
    yield STATIONS
    yield list(np.random.default_rng(seed).permutation(STATIONS))


def by_names(vis, stations):
    """Data of every ordered pair of stations (T, F, A, A, 2, 2), stations in the order of STATIONS."""
    rank = np.array([STATIONS.index(name) for name in stations])
    out = np.zeros((*vis.data.shape[:2], len(rank), len(rank), 2, 2), complex)
    a, b = rank[vis.antenna1], rank[vis.antenna2]
    out[:, :, a, b] = vis.data
    out[:, :, b, a] = vis.data.conj().swapaxes(-1, -2)
    return out


def test_predictions(draws):
    plan = scene(STATIONS, beam=True).plan()
    first = by_names(plan.run(), STATIONS)
    for seed in draws:
        for stations in orders(seed):
            other = scene(stations, beam=True).plan()
            found = by_names(other.run(), stations)
            assert np.abs(found - first).max() <= 2 * max(plan.error_bound, other.error_bound) * plan.scale_jy


def test_fluxes_of_photometry(draws):
    for seed in draws:
        for stations in orders(seed):
            one = scene(stations)
            vis = one.plan().run()
            found = ForcedPhotometry(accuracy=1e-12).measure(vis.with_data(ulp(vis.data, seed)), one.sky)
            assert found.outcome == (Outcome.CONVERGED,)
            # Jy, beside a neighbour of 1000: as the tests of photometry ask
            assert np.abs(found.stokes_jy[0] - one.sky.stokes_jy).max() < 1e-6


def test_solutions_of_self_calibration(draws):
    sky = instrument.load("skies", "grid", shape=(5, 5), spacing=1 * u.deg, flux=5 * u.Jy)
    errors = Chain(GainTerm(rms=1e-2, seed=1), FeedTerm(rms=1e-2, seed=2))
    for seed in draws:
        for stations in orders(seed):
            truth = scene(stations, sky, slots=4).plan().run()
            data = truth.corrupted(errors)
            data = data.with_data(ulp(data.data, seed))
            solution = SelfCal().solve(data, truth)
            solution.check()
            left = data.corrected(solution.term).data - truth.data
            # as the tests of self-calibration ask
            assert np.sqrt((np.abs(left) ** 2).mean()) <= 1e-10 * np.sqrt((np.abs(truth.data) ** 2).mean())


def test_images(draws):
    imager = Imager(pixels=64, pixel=4 * u.arcmin, uv_range=(1, 150), accuracy=1e-10)
    first = imager.image(scene(STATIONS).plan().run()).data
    for seed in draws:
        for stations in orders(seed):
            vis = scene(stations).plan().run()
            found = imager.image(vis.with_data(ulp(vis.data, seed))).data
            # the accuracy that was asked for
            assert np.sqrt(((found - first) ** 2).mean()) <= 1e-10 * np.sqrt((first**2).mean())


def test_principal_components_beside_a_foreground(draws):
    """A rim of NaN moved the residual of 0.01 K by 2e-12 where one BLAS was another: noise at 1 % of the foreground."""
    rng = np.random.default_rng(0)
    freq = np.linspace(134e6, 166e6, 41)
    maps = sum(0.3**k * np.multiply.outer((freq / 150e6) ** (-2.55 + 0.7 * k), x)
               for k, x in enumerate(rng.standard_normal((3, 40, 44))))  # fmt: skip
    data = np.zeros((41, 4, 40, 44))
    data[:, 0] = maps + rng.normal(0, 0.01, maps.shape)
    remover = instrument.load("foregrounds", "pca")
    inner = remover.split(as_cube(data[:, :, 4:-4, 4:-4], freq)).residual.data[:, 0]
    for seed in draws:
        rim = ulp(data, seed)
        rim[:, :, :4] = rim[:, :, -4:] = rim[:, :, :, :4] = rim[:, :, :, -4:] = np.nan
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InstrumentWarning)
            found = remover.split(as_cube(rim, freq)).residual.data[:, 0, 4:-4, 4:-4]
        np.testing.assert_allclose(found, inner, atol=1e-12)
