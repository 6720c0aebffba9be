"""The house: imports run one way, the framework lives without its plugins, starts quickly, its files are in order."""

import ast
import os
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

import instrument

ROOT = Path(__file__).resolve().parents[2]
FRAMEWORK = sorted((ROOT / "instrument").rglob("*.py"))
PLUGINS = sorted((ROOT / "plugins").rglob("*.py"))
HEAVY = {"astropy", "scipy", "numba", "matplotlib", "ducc0", "h5py", "jinja2", "rich", "erfa", "pydantic"}

# In the order in which imports may run: a group may import the groups of the lines above it, and within itself. A name
# stands for a module or for a whole package.
LAYERS = (
    ("errors", "data", "scenes"),
    ("numbers", "compiled_cache", "terminal", "threads", "provenance", "written"),
    ("compiled",),
    ("shown",),
    ("partial_folders",),
    ("whole_file",),
    ("units", "checked"),
    ("files_in", "memory", "machine"),
    ("h5",),
    ("zarr_tree",),
    ("registry", "mat2", "phasor", "patience"),
    ("component",),
    ("plugin_settings",),
    ("observe",),
    ("jones",),
    ("sky", "model"),
    ("beam_state", "correlations", "visibility_checks"),
    ("station_jones", "averaging", "recentred"),
    ("store", "msv4"),
    ("visibilities",),
    ("visibility_sets",),
    ("predict",),
    ("check",),
    ("plan",),
    ("not_modelled",),
    ("omissions",),
    ("planner",),
    ("scene",),
    ("calibrate",),
    ("image",),
    ("analyze",),
    ("foreground",),
    ("files",),
    ("experiments",),
    ("report",),
    ("pipeline",),
    ("conformance",),
    ("precision",),
    ("stress",),
    ("paper",),
    ("doctor_checks",),
    ("doctor",),
    ("",),  # `instrument` itself, which looks names up in all of them when they are first used
    ("cli_analyze",),
    ("cli",),
)
# (importer, imported): why this one import inside a function may run back
ALLOWED_BACK: dict[tuple[str, str], str] = {}


class Import(NamedTuple):
    importer: str
    imported: str
    deferred: bool  # inside a function, or for type checkers only
    line: int


def module_name(path):
    parts = path.relative_to(ROOT).with_suffix("").parts[1:]
    return ".".join(parts[:-1] if parts[-1:] == ("__init__",) else parts)


@cache
def tree(path):
    """A file, parsed once for all tests."""
    return ast.parse(path.read_text())


MODULES = {module_name(path) for path in FRAMEWORK}


def imports_of(path):
    """Imports of `instrument` modules in a file, without the leading 'instrument.'."""
    found = []

    def visit(node, deferred):
        for child in ast.iter_child_nodes(node):
            inside = (
                deferred
                or isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
                or (isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test))
            )
            names = []
            if isinstance(child, ast.Import):
                names = [alias.name for alias in child.names]
            elif isinstance(child, ast.ImportFrom):
                assert not child.level, f"{path}:{child.lineno}: a relative import; write it out"
                names = [f"{child.module}.{alias.name}" for alias in child.names]
            for name in names:
                if name.split(".")[0] == "instrument":
                    inner = name.partition(".")[2]
                    while inner and inner not in MODULES:
                        inner = inner.rpartition(".")[0]
                    found.append(Import(module_name(path), inner, inside, child.lineno))
            visit(child, inside)

    visit(tree(path), False)
    return found


@cache
def all_imports():
    return [i for path in FRAMEWORK for i in imports_of(path)]


def layer(module):
    group = module.split(".")[0]
    for number, names in enumerate(LAYERS):
        if group in names:
            return number, group
    raise AssertionError(f"instrument/{module.replace('.', '/')} is in no layer: put it in LAYERS, and in the docs")


def runs_back(found):
    (number, group), (other, imported_group) = layer(found.importer), layer(found.imported)
    if found.importer == "" and found.deferred:
        return False
    return not (other < number or (other == number and group == imported_group))


# Imports ---------------------------------------------------------------------------------------------------------


def test_every_module_has_its_place_in_the_layers():
    for module in MODULES:
        layer(module)


def test_imports_run_one_way():
    back = [i for i in all_imports() if runs_back(i) and (i.importer, i.imported) not in ALLOWED_BACK]
    assert back == []


def test_every_allowed_exception_is_in_use_deferred_and_reasoned():
    for (importer, imported), reason in ALLOWED_BACK.items():
        uses = [i for i in all_imports() if (i.importer, i.imported) == (importer, imported)]
        assert uses, f"{importer} does not import {imported} any more"
        assert all(i.deferred and runs_back(i) for i in uses)
        assert len(reason.split()) > 4


def circle(imports):
    """Modules that import one another in a circle, deferred imports and those of type checkers counted; [] for none."""
    edges: dict[str, set[str]] = {}
    for found in imports:
        if found.importer:  # `instrument` itself looks names up in all of them
            edges.setdefault(found.importer, set()).add(found.imported)
    done: set[str] = set()

    def visit(module, trail):
        if module in trail:
            return [*trail[trail.index(module) :], module]
        if module in done:
            return []
        around = next((c for other in sorted(edges.get(module, ())) if (c := visit(other, [*trail, module]))), [])
        done.add(module)
        return around

    return next((c for module in sorted(edges) if (c := visit(module, []))), [])


def test_modules_do_not_import_one_another_in_a_circle():
    assert circle([i for i in all_imports() if i.importer != i.imported]) == []


def test_the_checks_of_imports_can_fail():
    one_way = [Import("a", "b", False, 1), Import("b", "c", True, 1), Import("a", "c", False, 1)]
    assert circle(one_way) == []
    assert circle([*one_way, Import("c", "b", False, 1)]) == ["b", "c", "b"]
    assert runs_back(Import("mat2", "jones.chain", True, 1))
    assert runs_back(Import("sky.base", "model", False, 1))
    assert runs_back(Import("units", "", True, 1))
    assert not runs_back(Import("jones.chain", "mat2", False, 1))
    assert not runs_back(Import("sky.points", "sky.base", False, 1))


def test_the_framework_never_mentions_the_package_of_the_plugins():
    mentions = []
    for path in FRAMEWORK:
        for node in ast.walk(tree(path)):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                names = [node.value]
            mentions += [f"{path.name}:{node.lineno}" for name in names if "instrument_plugins" in name]
    assert mentions == []


# Without plugins, and quickly ------------------------------------------------------------------------------------


def python(script, *flags):
    """Run a script in a fresh Python; returns what it printed."""
    done = subprocess.run(
        [sys.executable, *flags, "-c", script],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ},
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


WITHOUT_PLUGINS = """
import sys
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "instrument_plugins":
            raise ModuleNotFoundError(f"{name} is blocked")
sys.meta_path.insert(0, Blocker())
"""

TINY_SCENE = """
import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
import instrument as ins

enu = np.array([[0, 0, 0], [100, 0, 0], [0, 200, 1.0]])
layout = ins.Layout.from_enu(["a", "b", "c"], enu * u.m, 0.12 * u.rad, 0.92 * u.rad, 50 * u.m)
centre = SkyCoord("08h13m36.0s +48d13m03s")
scene = ins.Scene(
    instrument=ins.Composed(stations=layout, terms=ins.Chain(ins.GainTerm(values=[[[[2, 2], [1, 1], [1, 1]]]]))),
    sky=ins.PointSky.at(centre, [3.0]),
    observation=ins.Observation(
        phase_centre=centre, transit="2012-12-07", duration=20 * u.s, interval=10 * u.s, frequencies=[150] * u.MHz
    ),
)
plan = scene.plan(engine="direct")
vis = plan.run()
# one source of 3 Jy at the phase centre: no fringe, and the gains of both stations
assert np.allclose(vis.data[:, :, :, 0, 0], [6, 6, 3], rtol=1e-12), vis.data
assert plan.verify().passed
"""


def test_a_scene_of_gains_and_points_runs_without_the_plugins():
    python(WITHOUT_PLUGINS + TINY_SCENE + "assert 'instrument_plugins' not in sys.modules")


def test_without_the_plugins_their_names_are_reported_broken_and_the_engines_work():
    python(
        WITHOUT_PLUGINS
        + "import instrument\n"
        + "assert 'is blocked' in instrument.available('elements')['hamaker'].broken\n"
        + "assert instrument.available('engines')['direct'].broken is None\n"
    )


@pytest.mark.parametrize("verb", ["scenes", "plugins", "doctor"])
def test_the_command_line_lives_without_the_plugins(verb):
    # doctor may find this installation wanting, but it says so and goes on
    out = python(
        WITHOUT_PLUGINS
        + f"from instrument.cli import main\nstatus = main([{verb!r}])\nprint('STATUS', status)\n"
        + "assert status in (0, 1), status\n"
    )
    assert "STATUS" in out


@pytest.mark.parametrize(
    "script",
    [
        "import instrument",
        "from instrument import errors, cli",
        "from instrument.cli import main\ntry:\n    main(['--help'])\nexcept SystemExit:\n    pass",
        "from instrument.cli import main\ntry:\n    main(['run', '--help'])\nexcept SystemExit:\n    pass",
        "import instrument; dir(instrument); instrument.__all__; instrument.__version__",
    ],
    ids=["import", "cli", "help", "run-help", "dir"],
)
def test_nothing_heavy_is_loaded_by(script):
    loaded = python(f"{script}\nimport sys\nprint('LOADED', *sorted(sys.modules))").rpartition("LOADED")[2].split()
    assert {name.split(".")[0] for name in loaded} & (HEAVY | {"numpy", "instrument_plugins"}) == set()


def test_a_plan_loads_no_library_that_it_does_not_need():
    """2.3 s of processor time were 0.6 s of these; coordinates in words and data files have readers of their own."""
    script = "from instrument.cli import main\nassert main(['plan', 'mock-grid']) == 0"
    loaded = python(f"{script}\nimport sys\nprint('LOADED', *sys.modules)").rpartition("LOADED")[2].split()
    assert {"numpy", "instrument.planner", "instrument.phasor"} <= set(loaded)
    needless = {"numba", "scipy", "ducc0", "h5py", "matplotlib", "jinja2", "astropy.coordinates", "astropy.table"}
    assert needless & set(loaded) == set()


def test_every_public_name_resolves():
    assert len(set(instrument.__all__)) == len(instrument.__all__)
    for name in instrument.__all__:
        assert getattr(instrument, name) is not None, name
    assert set(instrument.__all__) <= set(dir(instrument))


def test_the_stub_that_type_checkers_read_is_what_the_package_has():
    found = {}
    for node in ast.parse((ROOT / "instrument" / "__init__.pyi").read_text()).body:
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                assert alias.asname == alias.name, f"{alias.name}: only 'import X as X' is public to a type checker"
                found[alias.name] = f"instrument.{node.module}" if node.module else "instrument"
    assert set(found) | {"__version__"} == set(instrument.__all__)
    for name, home in found.items():
        one = getattr(instrument, name)
        module = sys.modules[home]
        assert getattr(module, name) is one, name


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="No instrument attribute Interferometer"):
        instrument.Interferometer  # noqa: B018


def test_every_package_is_listed_for_the_wheel():
    import tomllib

    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    found = {
        ".".join((top, *path.parent.relative_to(ROOT).parts[1:]))
        for paths, top in ((FRAMEWORK, "instrument"), (PLUGINS, "instrument_plugins"))
        for path in paths
    }
    assert found == listed


# Files in order --------------------------------------------------------------------------------------------------

SOURCES = [*FRAMEWORK, *PLUGINS]


def where(path):
    return str(path.relative_to(ROOT))


def test_no_file_is_longer_than_350_lines():
    long = {where(path): n for path in SOURCES if (n := len(path.read_text().splitlines())) > 350}
    assert long == {}


LINES, ARGUMENTS = 60, 8
# Public spellings, whose keywords are what a user may say of one thing, and why each is not cut
MANY_ARGUMENTS = {
    "instrument/analyze/analyzer.py: spectrum_2d": "a public spelling: what may be said of one spectrum",
    "instrument/analyze/analyzer.py: cells": "a public spelling: what may be said of the transform",
    "instrument/analyze/analyzer.py: cylindrical": "a public spelling: those of `cells`, and the bins",
    "instrument/analyze/analyzer.py: spherical": "a public spelling: those of `cells`, the bins and the wedge",
    "instrument/analyze/analyzer.py: eor_window": "a public spelling: those of `cells`, signal, noise and wedge",
    "instrument/analyze/analyzer.py: rm_synthesis": "a public spelling: what may be said of the synthesis",
    "instrument/analyze/power/spectra.py: spectrum_2d": "takes the keywords of `Analyzer.spectrum_2d` from sweeps too",
}


def functions(parsed):
    """Functions of a file, nested ones and methods too: name, lines, arguments."""
    for node in ast.walk(parsed):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            given = node.args
            count = len(given.posonlyargs) + len(given.args) + len(given.kwonlyargs)
            yield node.name, node.end_lineno - node.lineno + 1, count


def test_no_function_is_longer_than_60_lines():
    long = {f"{where(path)}: {name}": n for path in SOURCES for name, n, _ in functions(tree(path)) if n > LINES}
    assert long == {}


def test_no_function_takes_more_than_8_arguments():
    many = {f"{where(path)}: {name}" for path in SOURCES for name, _, n in functions(tree(path)) if n > ARGUMENTS}
    assert many == set(MANY_ARGUMENTS)


def test_the_checks_of_functions_can_fail():
    body = "    pass\n" * LINES
    parsed = ast.parse(f"class A:\n  def f(self, a, b, c, d, e, /, f, g, *, h):\n{body}")
    assert list(functions(parsed)) == [("f", LINES + 1, ARGUMENTS + 1)]


def test_every_module_says_what_it_is_in_one_sentence():
    missing = [where(path) for path in SOURCES if not (ast.get_docstring(tree(path)) or "").strip()]
    assert missing == []


def undocumented(tree):
    """Public classes and functions without a docstring, and public methods of public classes."""
    kinds = (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for node in tree.body:
        if isinstance(node, kinds) and not node.name.startswith("_"):
            if ast.get_docstring(node) is None and not is_overload(node):
                yield f"{node.name}:{node.lineno}"
            if isinstance(node, ast.ClassDef):
                yield from undocumented(node)


def is_overload(node):
    return any("overload" in ast.unparse(d) or ".setter" in ast.unparse(d) for d in node.decorator_list)


def test_every_public_class_and_function_has_a_docstring():
    missing = [f"{where(path)}: {name}" for path in SOURCES for name in undocumented(tree(path))]
    assert missing == []


def test_nothing_swallows_every_exception():
    bare = [
        f"{where(path)}:{node.lineno}"
        for path in [*SOURCES, *(ROOT / "tests").rglob("*.py")]
        for node in ast.walk(tree(path))
        if isinstance(node, ast.ExceptHandler) and node.type is None
    ]
    assert bare == []


def test_a_broad_except_says_why():
    silent = [
        f"{where(path)}:{node.lineno}"
        for path in SOURCES
        for node in ast.walk(tree(path))
        if isinstance(node, ast.ExceptHandler)
        and isinstance(node.type, ast.Name)
        and node.type.id in ("Exception", "BaseException")
        and "#" not in path.read_text().splitlines()[node.lineno - 1]
    ]
    assert silent == []


def tracked():
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout")
    return [path for name in listed.stdout.split("\0") if name and (path := ROOT / name).is_file()]


def test_no_tracked_file_holds_a_path_of_one_machine():
    machine = re.compile(r"(?<![\w.\-])/(" + "|".join(("work", "home", "root")) + r")/\w")
    found = [
        f"{where(path)}:{number}"
        for path in tracked()
        if path.suffix in (".py", ".md", ".toml", ".ini", ".yml")
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if machine.search(line)
    ]
    assert found == []


def test_every_randomness_takes_a_seed():
    # no global generator, and no generator without a seed
    unseeded = re.compile(r"np\.random\.(?!default_rng|Generator|SeedSequence)\w|default_rng\(\)")
    found = [
        f"{where(path)}:{number}"
        for path in SOURCES
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if unseeded.search(line)
    ]
    assert found == []


def test_every_test_that_is_listed_as_slow_is_there():
    """A renamed one would be back in the default run, and its line for ever in the list."""
    lines = [line for line in (ROOT / "tests" / "slow.txt").read_text().splitlines() if not line.startswith("#")]
    assert lines
    for line in lines:
        file, _, name = line.partition("::")
        text = (ROOT / file).read_text()
        assert not name or f"def {name.partition('[')[0]}(" in text, line
