"""Pictures of a calibration: nothing that failed is lost in them, whatever the number of intervals and stations."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from instrument import InputError, JonesTable, Outcome
from instrument.calibrate.base import Solution
from instrument.calibrate.gauge import gauge_of
from instrument.report import calibration, stations
from instrument.report.calibration_page import solution_figures
from instrument.report.style import drawer

KINDS = [o for o in Outcome if o is not Outcome.CONVERGED]


def made(times=500, channels=1, count=59, failed=(), lost=(), errors=True, slots=None, steps=6):
    """A solution whose `failed` intervals ended in all other ways, in turn; `lost` stations have none."""
    rng = np.random.default_rng(0)
    jones = np.eye(2) + 0.05 * rng.normal(size=(times, channels, count, 2, 2, 2)).view(complex)[..., 0]
    outcome = np.full((times, channels), Outcome.CONVERGED, object)
    for k, row in enumerate(failed):
        outcome[row], jones[row] = KINDS[k % len(KINDS)], np.nan
    jones[:, :, list(lost)] = np.nan
    known = {}
    if errors:
        error = np.where(np.isfinite(jones), rng.uniform(1e-3, 2e-3, jones.shape), np.nan)
        known = {"error": error, "common_error": np.tile([np.inf, 2.0, 0.1, 1e-3], (times, channels, 1))}
    return Solution(
        term=JonesTable(
            values=jones, slots_s=4.86e9 + 10.0 * (np.arange(times) if slots is None else np.array(slots)),
            freq_hz=150e6 + 0.2e6 * np.arange(channels), stations=tuple(f"RS{k:03d}HBA" for k in range(count)),
        ),
        outcome=outcome, iterations=np.full((times, channels), 5),
        residual=np.where(outcome == Outcome.CONVERGED, 1e-2, np.nan),
        gauge=gauge_of(np.eye(2, dtype=complex)[None, None, None], np.ones((1, 1, 1))),
        history=np.where(np.arange(6) < steps, 10.0 ** -np.arange(6), 0.0), interval_s=10.0, **known,
    )  # fmt: skip


def drawn(ax):
    """The colours' values of the image on some axes."""
    return np.ma.filled(ax.images[0].get_array().astype(float), np.nan)


def test_one_failed_interval_of_thousands_is_seen_and_counted():
    solution = made(times=2874, count=2, failed=[1001], errors=False)
    ax = calibration.outcomes(solution)
    shown = drawn(ax)
    assert shown.shape == (1, stations.COLUMNS)
    assert np.flatnonzero(shown[0]).tolist() == [1001 * stations.COLUMNS // 2874]
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["converged (2873)", "iteration limit (1)"]


def test_every_way_of_ending_has_a_colour_and_a_name():
    assert {o for o, _, _ in calibration.ENDED} == set(Outcome)
    assert calibration.ENDED[0][0] is Outcome.CONVERGED  # the least of all: any other covers it in a crowded column
    assert len({colour for _, _, colour in calibration.ENDED}) == len(Outcome)
    ax = calibration.outcomes(made(times=6, channels=3, count=2, failed=range(5)))
    assert sorted(np.unique(drawn(ax))) == list(range(len(Outcome)))
    assert drawn(ax).shape == (3, 6)  # frequency upwards


def test_gaps_in_time_and_stations_without_solutions_are_grey():
    solution = made(times=4, count=3, lost=[1], slots=[0, 1, 6, 7])
    for ax in (stations.gains(solution).axes[0], stations.gain_errors(solution)):
        assert np.array_equal(np.isnan(drawn(ax)[0]), [False, False, True, True, True, True, False, False])
        assert np.isnan(drawn(ax)[1]).all()
    assert "min" in calibration.residuals(made(times=20, count=2)).get_xlabel()
    assert "(h)" in calibration.residuals(made(times=2874, count=2)).get_xlabel()


def test_of_many_intervals_the_one_that_stands_out_is_shown():
    values = np.zeros((2874, 2))
    values[700, 0], values[1500, 1], values[1501, 1] = -3.0, 2.0, np.nan
    along = stations.Along.times(10.0 * np.arange(2874), 10.0)
    shown = along.gathered(values)
    assert shown.min() == -3 and shown[1].max() == 2 and np.isfinite(shown).all()


def test_phases_are_relative_to_a_station_that_has_solutions():
    solution = made(times=10, count=4, lost=[0])
    phase = drawn(stations.gains(solution).axes[2])
    assert np.isnan(phase[0]).all() and np.abs(phase[1]).max() < 1e-12 and np.abs(phase[2:]).min() > 1e-9


def test_errors_of_blocks_are_those_of_the_whole():
    one, other = made(times=3, count=2), made(times=2, count=2, slots=[3, 4])
    none = made(times=2, count=2, errors=False, slots=[5, 6])
    few = replace(other, common_error=other.common_error[..., :2], error=np.full((1, 1, 1, 2, 2), 0.1))
    whole = Solution.joined([one, few, none])
    assert whole.error.shape == whole.jones.shape and whole.common_error.shape == (7, 1, 4)
    assert np.array_equal(whole.error[:3], one.error) and np.all(whole.error[3:5] == 0.1)
    assert np.array_equal(whole.common_error[3:5, :, :2], few.common_error)
    assert np.isnan(whole.common_error[3:5, :, 2:]).all() and np.isnan(whole.error[5:]).all()
    assert Solution.joined([none]).error.shape == (1, 1, 1, 2, 2)


def test_one_interval_shows_how_stations_differ():
    amplitude = drawn(stations.gains(made(times=1, count=4)).axes[0])
    assert amplitude.shape == (4, 1) and np.ptp(amplitude) > 1  # %; over its own median each would be 0


def test_frequencies_are_written_out_however_near_they_are():
    solution = made(times=1, count=2, channels=2)
    near = replace(solution, term=solution.term.with_fields(freq_hz=[149.905e6, 150.095e6]))
    axes = stations.bandpass(near).axes[2]
    axes.figure.draw_without_rendering()
    assert all(t.get_text()[:3] in ("149", "150") for t in axes.get_xticklabels())
    assert axes.xaxis.get_offset_text().get_text() == ""


def test_common_errors_break_at_gaps_and_name_what_is_free():
    ax = calibration.common_errors(made(times=4, count=2, slots=[0, 1, 6, 7]))
    assert [t.get_text() for t in ax.get_legend().get_texts()] == [
        "direction 1, free", "direction 2", "direction 3", "direction 4",
    ]  # fmt: skip
    assert np.isnan(ax.lines[2].get_ydata()).tolist() == [False, False, True, False, False]


def test_what_is_not_known_is_asked_for_in_one_line():
    solution = made(times=2, count=2, errors=False)
    for draw in (stations.gain_errors, calibration.common_errors):
        with pytest.raises(InputError, match="does not know the errors"):
            draw(solution)
    with pytest.raises(InputError, match="what is left has shape"):
        stations.left_by_stations(np.ones((3, 4)), np.zeros(2), 10.0)


@pytest.mark.parametrize(
    ("settings", "names"),
    [
        (
            {"times": 1, "count": 4, "channels": 3},
            "outcomes gains bandpass gain_errors common_errors convergence residual",
        ),
        ({"times": 3, "count": 4, "failed": [0, 1, 2], "errors": False, "steps": 0}, "outcomes"),
    ],
)
def test_a_page_has_the_pictures_of_which_the_solution_knows_something(settings, names, tmp_path):
    drawer_of = drawer(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        entries = solution_figures(made(**settings), drawer_of if settings["times"] == 3 else lambda n, d, t: n)
    if settings["times"] == 3:
        assert all(e.dark.startswith("data:image/") for e in entries)
        assert sorted(p.stem for p in tmp_path.glob("*.png")) == sorted(names.split())
    else:
        assert entries == names.split()
