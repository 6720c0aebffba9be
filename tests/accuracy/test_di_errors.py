"""The seven parameters of a solve: the paper's "below 0.002 %" is gauge freedom squared, no error of the solver."""

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import Chain, FeedTerm, GainTerm, Observation, Scene, SelfCal
from instrument.calibrate.di_errors import NAMES, compare


@pytest.fixture(scope="module")
def solved():
    sky = instrument.load("skies", "grid", shape=(5, 5), spacing=1 * u.deg, flux=5 * u.Jy)
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=8 * u.hour, interval=15 * u.min,
        frequencies=[150] * u.MHz,
    )  # fmt: skip
    model = (
        Scene(instrument=instrument.load("telescopes", "lofar-hba", beam=None), sky=sky, observation=night).plan().run()
    )
    out = {}
    for rms in (1e-3, 1e-2, 1e-1):
        term = Chain(GainTerm(rms=rms, seed=1), FeedTerm(rms=rms, seed=2))
        solution = SelfCal(tolerance=1e-12).solve(model.corrupted(term), model)
        truth = np.broadcast_to(term.jones(model.at)[:, :, :, 0], solution.jones.shape)
        out[rms] = compare(truth, solution, model.antenna1, model.antenna2, rms)
    return out


def test_with_the_gauge_removed_all_seven_are_solved_below_1e_6_percent(solved):
    for rms, found in solved.items():
        assert all(found.linear["difference, aligned"][n] < 1e-6 for n in NAMES), rms
        assert all(found.quadratic["difference, aligned"][n] < 1e-12 for n in NAMES), rms


def test_the_papers_recipe_gives_its_figure_with_the_gauge_left_free(solved):
    """Below 0.005 % at rms 1e-3, and proportional to the rms: (gauge)^2 / rms."""
    one, ten = (solved[r].quadratic["difference, raw"] for r in (1e-3, 1e-2))
    assert all(1e-5 < one[n] < 0.02 for n in NAMES)
    assert np.median([one[n] for n in NAMES]) < 0.005
    for n in NAMES:
        assert ten[n] / one[n] == pytest.approx(10, rel=0.5)


def test_by_the_linear_definition_the_gauge_is_all_there_is(solved):
    """s, IQ, IU, IV of the difference are blind to a common unitary matrix to first order; UV, QU, QV are not."""
    raw = solved[1e-3].linear["difference, raw"]
    assert all(raw[n] < 1 for n in ("s", "iq", "iu", "iv"))
    assert all(raw[n] > 1 for n in ("uv", "qu", "qv"))
    put_in = solved[1e-3].linear["input"]
    assert all(put_in[n] == pytest.approx(200, rel=0.1) for n in NAMES)  # four independent errors of the rms each


def test_table_has_a_row_for_each_way_to_look(solved):
    table = solved[1e-3].table()
    assert list(table["quantity"]) == [
        "linear, input", "linear, solution, raw", "linear, difference, raw", "linear, solution, aligned",
        "linear, difference, aligned", "quadratic, difference, raw", "quadratic, difference, aligned",
    ]  # fmt: skip
