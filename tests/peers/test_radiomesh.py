"""radiomesh beside the imager: its images in all Stokes parameters are drawn into the contest."""

import pytest

from instrument.precision import Form, imagers

pytestmark = pytest.mark.peer
pytest.importorskip("radiomesh")
pytest.importorskip("sympy")


def test_radiomesh_is_drawn_into_the_contest_of_imagers():
    contest = imagers.contest({}, 12, 4, 64, Form(quick=True, peers=True))
    theirs = next(entry for entry in contest.entries if entry.plugin.startswith("radiomesh"))
    assert theirs.peer and "radiomesh" in contest.peers
    # measured 2.2e-4 whatever its kernel: V too, whose sign it has wrong where w < 0 (turned before)
    assert contest.judge(theirs.answer(1e-6), 1e-6).error < 1e-3
