"""Tests that slow.txt lists are marked `long`, so that the default run ends soon; slow.py writes the list."""

from pathlib import Path

import pytest

SLOW = Path(__file__).with_name("slow.txt")


def listed():
    """Files and tests, as pytest names them."""
    lines = SLOW.read_text().splitlines()
    return {line for line in lines if line and not line.startswith("#")}


@pytest.hookimpl(tryfirst=True)  # before tests are chosen by their marks
def pytest_collection_modifyitems(items):
    slow = listed()
    for item in items:
        file, _, name = item.nodeid.partition("::")
        if not {file, f"{file}::{name.partition('[')[0]}", item.nodeid}.isdisjoint(slow):
            item.add_marker("long")
