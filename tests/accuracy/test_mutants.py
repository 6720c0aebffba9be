"""The mutants of docs/reports/mutants.py: drawn by a seed, of numerical code alone, and found by cases."""

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def reports():
    sys.path.insert(0, str(ROOT / "docs" / "reports"))
    try:
        import mutant_sites
        import mutants

        yield mutant_sites, mutants
    finally:
        sys.path.pop(0)


def test_the_draw_is_that_of_its_seed_and_spread_over_groups_and_kinds(reports):
    sites, _ = reports
    every = sites.sites()
    one, again, other = (sites.drawn(seed, 40, every) for seed in (1, 1, 2))
    assert one == again and one != other and len({(s.path, s.start, s.kind) for s in one}) == 40
    assert {s.group for s in one} == set(sites.GROUPS)
    assert {s.kind for s in one} == set(sites.KINDS)


def test_every_mutant_is_another_program_and_stands_in_no_text(reports):
    sites, _ = reports
    every = sites.sites()
    for s in every[:: max(1, len(every) // 300)]:
        source = (ROOT / s.path).read_bytes()
        assert source[s.start : s.end].decode() == s.before
        assert ast.dump(ast.parse(s.applied(source))) != ast.dump(ast.parse(source))
    source = b'''"""1 + 1"""
def f(x: int = 2) -> float:
    """2 * 2."""
    if x > 3:
        raise ValueError(f"{x + 1}" + "a")
    return -x * 2.0
def g(x) -> str:
    return "a" * (x + 1)
'''
    finder = sites.Finder("jones", "x.py", source)
    finder.visit(ast.parse(source))
    assert {(s.before, s.after) for s in finder.found} == {
        ("-x * 2.0", "((-x) / (2.0))"),
        ("-x", "(x)"),
        ("2.0", "4.0"),
    }


@pytest.mark.parametrize(
    ("path", "before", "case"),
    [
        ("instrument/jones/parallactic.py", "-phi_east", ("G10", "")),
        ("instrument/jones/mueller.py", "np.conj(jones_b)", ("L3", "")),
        ("instrument/observe/grid.py", "-r2 / (1 + np.sqrt(1 - r2))", ("G3", "")),
    ],
)
def test_a_mutant_is_found_in_a_copy_and_the_sources_stay(reports, tmp_path, path, before, case):
    sites, mutants = reports
    site = next(s for s in sites.sites() if s.path == path and s.before == before)
    was = (ROOT / path).read_bytes()
    copy = mutants.Copy(tmp_path)
    calls = [f"{path}:{site.function}"]
    found = copy.tried(site, {case: ("right", 1.0, calls)}, 120.0)
    assert found.case.startswith(case[0]) and "right -> WRONG" in found.how
    assert (ROOT / path).read_bytes() == was == copy.path(site).read_bytes()
