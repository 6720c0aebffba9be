"""The contract of calibrators: one claim per function, its name the sentence."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from instrument.calibrate.base import Calibrator, Solution
from instrument.conformance.bench import demand, demand_repeatable
from instrument.errors import InputError, Outcome
from instrument.jones.gain import GainTerm
from instrument.model import Composed
from instrument.observe.layout import Layout
from instrument.observe.observation import Observation
from instrument.scene import Scene
from instrument.sky.points import PointSky
from instrument.units import Complex, Float
from instrument.visibilities import Visibilities

STATIONS = 8
TIMES = 6
# A step of the size of the tolerance is left where a solve stops; one that halves its error in a step leaves as much,
# one that takes a tenth of it off nine times that. Below are the roundings of the sums.
STEPS, ROUNDED = 30.0, 1e-12


@cache
def _model() -> Visibilities:
    """Three polarized sources on eight stations over 1 km, six times, two channels, without errors."""
    from astropy import units as u

    rng = np.random.default_rng(1)
    enu = np.concatenate([rng.uniform(-500, 500, (STATIONS, 2)), np.zeros((STATIONS, 1))], axis=1)
    layout = Layout.from_enu([f"s{k}" for k in range(STATIONS)], enu * u.m, 0.12 * u.rad, 0.92 * u.rad, 50 * u.m)
    sky = PointSky(
        names=("a", "b", "c"), ra_rad=[2.15, 2.17, 2.14], dec_rad=[0.84, 0.85, 0.83],
        stokes_jy=[[9, 1, 0, 0], [3, 0, 0.5, 0], [1, 0, 0, 0.1]],
    )  # fmt: skip
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=TIMES * 10 * u.s, interval=10 * u.s,
        frequencies=[150, 151] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    return Scene(instrument=Composed(stations=layout), sky=sky, observation=night).plan(workers=1).run()


def _phases() -> tuple[Complex, GainTerm]:
    """A phase of each station up to 1 rad, the same for both receptors: what every solver knows, (1, 1, A, 2)."""
    gains = np.exp(1j * np.random.default_rng(2).uniform(-1, 1, STATIONS))
    return gains, GainTerm(values=np.repeat(gains[None, None, :, None], 2, axis=-1))


def _error(solution: Solution, truth: Complex) -> Float:
    """Largest error of any station (t, f), relative to its matrix of size 1, the gauge taken off; NaN is one of 1."""
    due = np.broadcast_to(truth[:, None, None] * np.eye(2), solution.jones.shape)
    apart = np.abs(solution.aligned(to=due).jones - due).max(axis=(-3, -2, -1))
    return np.asarray(np.where(np.isfinite(apart), apart, 1.0))


def it_finds_the_phases_of_stations_to_its_own_tolerance(calibrator: Calibrator) -> str:
    """Noiseless phases of up to 1 rad: every interval CONVERGED, within 30 times `tolerance` of the truth, but for what
    its gauge says is free.
    """
    gains, term = _phases()
    found = calibrator.solve(_model().corrupted(term), _model())
    demand(isinstance(found, Solution), f"solve gives a {type(found).__name__}")
    demand(bool(found.converged.all()), f"{int((~found.converged).sum())} of {found.outcome.size} did not converge")
    worst = float(_error(found, gains).max())
    limit = STEPS * calibrator.tolerance + ROUNDED
    demand(worst <= limit, f"off by {worst:.1e}, the tolerance is {calibrator.tolerance:.1e}; {found.gauge}")
    return f"off by {worst:.0e}; {found.gauge}"


def its_solution_fits_the_data_it_came_with(calibrator: Calibrator) -> str:
    """One outcome for each interval, NaN where it is not CONVERGED, stations by name, and what it leaves is true."""
    _, term = _phases()
    data = _model().corrupted(term)
    found = calibrator.solve(data, _model())
    shape = (*found.outcome.shape, STATIONS, 2, 2)
    demand(found.jones.shape == shape, f"jones {found.jones.shape}, outcomes {found.outcome.shape}")
    demand(all(isinstance(o, Outcome) for o in found.outcome.ravel()), f"outcome = {found.outcome.ravel()[0]!r}")
    demand(found.term.stations == data.layout.names, f"stations = {found.term.stations}")
    left = data.corrected(found.term) - _model()
    share = float(np.sqrt((np.abs(left.data) ** 2).mean() / (np.abs(_model().data) ** 2).mean()))
    demand(share <= STEPS * calibrator.tolerance + ROUNDED, f"corrected data are off by {share:.1e}")
    wanted = found.residual.shape == found.outcome.shape and np.all(found.residual <= 1e3 * calibrator.tolerance)
    demand(wanted, f"residual = {found.residual.max():.1e} of data that it fits")
    return f"corrected data off by {share:.0e}"


def data_that_it_did_not_fit_are_never_converged(calibrator: Calibrator) -> str:
    """Noise without a signal, a model of another sky, NaN throughout, a model that is not finite: none CONVERGED."""
    rng = np.random.default_rng(3)
    model = _times(_model(), slice(0, 1))
    noise = rng.normal(size=(*model.data.shape, 2)).view(complex)[..., 0]
    scrambled = model.data[:, :, rng.permutation(model.data.shape[2])]
    nan = np.full_like(model.data, np.nan)
    cases = {
        "noise": (noise, model.data), "another sky": (scrambled, model.data), "data of NaN": (nan, model.data),
        "a model of NaN": (model.data, nan),
    }  # fmt: skip
    for name, (data, against) in cases.items():
        try:
            found = calibrator.solve(model.with_data(data), model.with_data(against))
        except InputError:
            continue  # refused is right as well
        demand(not found.converged.any(), f"{name}: {int(found.converged.sum())} of {found.outcome.size} CONVERGED")
        demand(not np.isfinite(found.jones).any(), f"{name}: not converged, and yet it has matrices")
    return f"{len(cases)} cases"


def flagged_data_weigh_nothing(calibrator: Calibrator) -> str:
    """Values under flags, NaN among them, change no bit of the answer; a station without data has none.

    Flags are of visibilities, and then of one correlation each.
    """
    _, term = _phases()
    data = _model().corrupted(term)
    flag = np.zeros(data.data.shape[:3], bool)
    flag[:, :, (data.antenna1 == 3) | (data.antenna2 == 3)] = True
    flag[1, 0, ::7] = True
    single = np.zeros(data.data.shape, bool)
    single[..., 0, 1] = flag
    for hidden, flags in ((single, single), (np.broadcast_to(flag[..., None, None], single.shape), flag)):
        spoilt = [data.with_data(np.where(hidden, wild, data.data)).flagged(flags) for wild in (1e6, np.nan)]
        first, second = (calibrator.solve(one, _model()).jones for one in spoilt)
        demand(np.array_equal(first, second, equal_nan=True), "what is flagged changes the answer")
    demand(np.isnan(first[:, :, 3]).all(), "a station without data has matrices")
    demand(np.isfinite(np.delete(first, 3, axis=2)).all(), "a station with data has none")
    return ""


def a_block_of_times_gives_what_it_has_within_the_whole(calibrator: Calibrator) -> str:
    """The times of one interval, solved alone, give the matrices of that interval, to its tolerance."""
    gains, term = _phases()
    data, model = _model().corrupted(term), _model()
    noise = np.random.default_rng(4).normal(size=(*data.data.shape, 2)).view(complex)[..., 0]
    data = data.with_data(data.data + 0.05 * noise)  # or all intervals had the same answer
    whole = calibrator.solve(data, model)
    k = len(whole.outcome) // 2
    near = np.flatnonzero(np.abs(data.at.slots_s - whole.term.slots_s[k]) <= whole.interval_s / 2)
    one = slice(int(near[0]), int(near[-1]) + 1)
    alone = calibrator.solve(_times(data, one), _times(model, one))
    demand(len(alone.outcome) == 1, f"one interval alone gives {len(alone.outcome)}")
    due = np.broadcast_to(gains[:, None, None] * np.eye(2), alone.jones.shape)
    apart = np.abs(alone.aligned(to=due).jones[0] - whole.aligned(to=np.repeat(due, len(whole.jones), axis=0)).jones[k])
    limit = STEPS * calibrator.tolerance + ROUNDED
    demand(apart.max() <= limit, f"apart by {apart.max():.1e}, the tolerance is {calibrator.tolerance:.1e}")
    return f"{len(near)} of {TIMES} times, apart by {apart.max():.0e}"


def _times(data: Visibilities, times: slice) -> Visibilities:
    return replace(data, data=data.data[times], at=data.at.block(times, slice(None)))


def a_call_of_solve_has_no_side_effects(calibrator: Calibrator) -> str:
    """The same call twice gives the same, and nothing that was given has changed."""
    data = _model().corrupted(_phases()[1])
    return demand_repeatable(lambda: calibrator.solve(data, _model()).jones, calibrator, data, _model())


CLAIMS = (
    it_finds_the_phases_of_stations_to_its_own_tolerance,
    its_solution_fits_the_data_it_came_with,
    data_that_it_did_not_fit_are_never_converged,
    flagged_data_weigh_nothing,
    a_block_of_times_gives_what_it_has_within_the_whole,
    a_call_of_solve_has_no_side_effects,
)
