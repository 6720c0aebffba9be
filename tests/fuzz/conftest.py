"""Puts `fuzzing`, the harness of these tests, where tests in importlib mode find it."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))


def pytest_addoption(parser):
    parser.addoption("--fuzz", type=int, help="number of hostile inputs (default 400)")
    parser.addoption("--fuzz-seed", type=int, help="their seed (default 1)")
