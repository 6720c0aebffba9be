"""A Measurement Set four times the memory that may be taken: read, corrected and imaged within it."""

import importlib.util
from pathlib import Path

import pytest

pytest.importorskip("arcae")
spec = importlib.util.spec_from_file_location("large_set", Path(__file__).parents[2] / "docs/reports/large_set.py")
large_set = importlib.util.module_from_spec(spec)
spec.loader.exec_module(large_set)


@pytest.mark.long
def test_a_set_of_four_times_the_memory_is_imaged_within_it(tmp_path):
    rows, size = large_set.made(tmp_path / "l.MS", 4e9)
    assert size > 3.9e9 and rows > 1e6
    _, run = large_set.imaged(tmp_path, "1GB", most=150)
    assert run["memory"]["measured_bytes"] < 1e9
    assert run["memory"]["measured_bytes"] < 1.1 * run["memory"]["planned_bytes"]
    assert run["data"]["flagged"] == 0
