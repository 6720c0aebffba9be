"""The experiment `errata`: no printed form is the right one, and the right ones are those of other sources."""

import numpy as np
import pytest

from instrument.paper import errata
from instrument.paper.bench import Bench
from instrument.paper.finding import CORRECTED, DOUBTFUL, NOT, near, slip


@pytest.mark.long
def test_every_slip_is_shown_to_be_one(tmp_path):
    every = errata.run(Bench(tmp_path, quick=True))
    found = {f.what: f for f in every}
    assert len(found) == len(every)  # run.json has them by name
    said = {f.what: f.agreement for f in found.values() if f.within}
    assert said.pop("13. within 5 deg by published counts, sources above 27 mJy") == DOUBTFUL  # the mock follows it
    assert set(said.values()) == {CORRECTED}
    assert {int(what.split(".")[0]) for what in found} == set(range(1, 14))
    ours = {what.split(".")[0]: f.ours for what, f in found.items()}
    assert ours["7"] == pytest.approx(0.913 * 160 / 161, rel=2e-3)  # Nyquist, where 161 channels have their last delay
    assert ours["8"] == pytest.approx(9276, abs=1)
    assert ours["9"] == pytest.approx(1, rel=2e-3)  # the delay 0 is left out
    assert found["13. within 5 deg by published counts, sources above 27 mJy"].ours == pytest.approx(2159, rel=0.01)
    assert ours["12"] == pytest.approx(np.sqrt(3.83 * 3.81), rel=0.02)  # of the whole night


def test_a_printed_form_that_were_right_or_ours_that_were_wrong_would_be_no_slip():
    assert slip("x", 1.0, "", "1", 1.02, "why", near(1.0)).agreement == CORRECTED
    assert slip("x", 1.0, "", "1", 1.0, "why", near(1.0)).agreement == NOT
    assert slip("x", 1.02, "", "1", 2.0, "why", near(1.0)).agreement == NOT


def test_the_first_order_matrix_is_of_second_order_only_with_the_i():
    first = errata._first_order(np.random.default_rng(1))
    slope = {key: np.polyfit(np.log(first["size"]), np.log(first[key]), 1)[0] for key in ("right", "printed")}
    assert slope["right"] == pytest.approx(2, abs=1e-3) and 0.98 < slope["printed"] < 1.02
