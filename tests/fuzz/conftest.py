"""Puts `fuzzing`, the harness of these tests, where tests in importlib mode find it; the process that forks cases."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


def pytest_addoption(parser):
    parser.addoption("--fuzz", type=int, help="number of hostile inputs (default 300)")
    parser.addoption("--fuzz-seed", type=int, help="their seed (default 1)")


@pytest.fixture(scope="session")
def zygote(tmp_path_factory):
    """A loaded process that forks one child a case."""
    from fuzzing import seeds
    from fuzzing.harness import Zygote

    folder = tmp_path_factory.mktemp("forked")
    (folder / "s.toml").write_text(seeds.IMAGES)
    with Zygote([["run", "s.toml", "--no-verify", "--out", "warm"]], folder) as started:
        yield started
