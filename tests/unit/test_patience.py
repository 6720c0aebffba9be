"""When rounds that lead no nearer are given up."""

import numpy as np

from instrument.patience import ROUNDS, Patience


def test_what_falls_is_waited_for_and_what_does_not_is_lost():
    patience = Patience(3)
    for turn in range(2 * ROUNDS - 1):
        lost = patience.lost(np.array([0.997**turn, 1 + 1e-3 * np.sin(turn), np.nan if turn > ROUNDS else 1]))
        assert not lost.any()  # a first mean has nothing to be held against
    assert patience.lost(np.array([0.997**turn, 1.0, np.nan])).tolist() == [False, True, True]


def test_a_step_that_falls_like_one_over_the_rounds_is_lost_soon():
    """As where stations and model leave a fit that is best at infinity: 1e10 rounds to a step of 1e-10."""
    patience = Patience()
    ended = next(n for n in range(1, 10**5) if patience.lost(1 / n)[0])
    assert 3 * ROUNDS <= ended <= 8 * ROUNDS
