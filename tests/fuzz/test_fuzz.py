"""Hostile input of every kind is done whole or refused in one line: no traceback, hang, flood of memory or half folder.

The default run takes a small sample; `long` some hundreds; `--fuzz 3000` thousands, with the seed `--fuzz-seed`.
"""

import pytest
from fuzzing.choose import cases

SAMPLE, LONG = 18, 400


def faults(zygote, count, seed):
    """The cases that went wrong, as text."""
    found = (zygote.judge(case) for case in cases(count, seed, zygote.folder / "seeds"))
    return [str(verdict) for verdict in found if not verdict.good]


def test_a_sample_of_hostile_input_is_done_or_refused(zygote):
    assert faults(zygote, SAMPLE, 20261125) == []


@pytest.mark.long
def test_hundreds_of_hostile_inputs_are_done_or_refused(zygote, request):
    count = request.config.getoption("--fuzz", default=None) or LONG
    assert faults(zygote, count, request.config.getoption("--fuzz-seed", default=None) or 1) == []
