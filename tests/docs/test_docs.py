"""The documentation does what it says: its code runs, its links resolve, its pictures show what is there.

Every Python block of a page runs, in order, in one module per page. What a line `# -> text` promises must be printed by
its block. TOML blocks are checked as scene files, or as entry points. A block below `<!-- needs MODULE -->` runs where
that is installed.
"""

import ast
import contextlib
import importlib.metadata
import importlib.util
import io
import re
import subprocess
import sys
import tomllib
import types
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SCRIPTS = sorted((ROOT / "docs" / "examples").glob("*.py"))
COMMANDS = (
    "python3 -m venv .venv && .venv/bin/pip install -q . && .venv/bin/instrument run mock-grid            "
    "# sets up, runs the main job",
    'python3 -m venv .venv && .venv/bin/pip install -q ".[test]" && .venv/bin/pytest                       '
    "# sets up, runs the tests",
)


def blocks(page, language):
    """(line number, text) of the fenced blocks of a language."""
    text = page.read_text(encoding="utf-8")
    found = re.finditer(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return [(text[: m.start()].count("\n") + 2, m.group(1)) for m in found]


def prose(page):
    """A page without its fenced blocks."""
    return re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def anchors(page):
    """The anchors of the headings of a page, as GitHub makes them."""
    heads = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


def named(pages, wanted=lambda page: True):
    return [pytest.param(page, id=page.name) for page in pages if wanted(page)]


@pytest.mark.parametrize("page", named(PAGES, lambda page: blocks(page, "python")))
def test_python_blocks_run_and_print_what_the_page_says(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    module = types.ModuleType(f"page_{page.stem}")
    monkeypatch.setitem(sys.modules, module.__name__, module)  # classes made on the page are found by their JSON
    lines = page.read_text(encoding="utf-8").splitlines()
    for line, text in blocks(page, "python"):
        needed = re.fullmatch(r"<!-- needs (\w+) -->", lines[line - 3])
        if needed and importlib.util.find_spec(needed[1]) is None:
            continue
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            # as many empty lines before as on the page: a traceback then names the right one
            exec(compile("\n" * (line - 1) + text, str(page), "exec"), module.__dict__)
        left = iter(printed.getvalue().splitlines())
        for promised in re.findall(r"^# -> (.*)$", text, re.MULTILINE):
            assert any(found.strip() == promised for found in left), f"not printed: {promised}\n{printed.getvalue()}"
    assert not list(tmp_path.iterdir()), "a page leaves files behind"


@pytest.mark.parametrize("script", named(SCRIPTS))
def test_examples_run_say_something_and_leave_nothing_behind(script, tmp_path):
    done = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.strip() and not done.stderr.strip(), done.stderr[-3000:]
    assert not list(tmp_path.iterdir())


def test_examples_are_listed_on_the_index():
    listed = set(re.findall(r"\(examples/(\w+\.py)\)", (ROOT / "docs" / "index.md").read_text(encoding="utf-8")))
    assert listed == {script.name for script in SCRIPTS}


@pytest.mark.parametrize("page", named(PAGES, lambda page: blocks(page, "toml")))
def test_toml_blocks_are_scene_files_or_entry_points(page):
    from instrument.pipeline.scene_file import parse

    for _, text in blocks(page, "toml"):
        tables = tomllib.loads(text)
        if "project" in tables:
            groups = tables["project"]["entry-points"]
            assert set(groups) <= set(importlib.metadata.entry_points().groups)
        else:
            parse(tables).scene().plan()


@pytest.mark.parametrize("page", named(PAGES))
def test_links_resolve(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if target.startswith(("https://", "http://")):
            continue
        path, _, anchor = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        assert there.exists() and there.is_relative_to(ROOT), f"{target} is not there"
        assert not anchor or anchor in anchors(there), f"{target}: no such heading"


def test_every_page_is_on_the_index():
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    missing = [page.name for page in PAGES if page.name != "index.md" and f"{page.name})" not in index]
    assert not missing


def test_the_readme_has_the_two_commands_as_they_are_run():
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert [command for command in COMMANDS if command not in lines] == []


def test_the_commands_of_the_readme_are_known_verbs():
    from instrument.cli import parser

    (shell,) = (text for _, text in blocks(ROOT / "README.md", "sh") if text.startswith("instrument"))
    for line in shell.splitlines():
        parser().parse_args(line.partition("#")[0].split()[1:])


def test_a_section_for_each_kind_of_plugin_in_less_than_forty_lines():
    page = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
    sections = {text.partition("\n")[0]: text for text in re.split(r"^## (?=An? new )", page, flags=re.MULTILINE)[1:]}
    lines = {title: len(text.split("\n## ")[0].rstrip().splitlines()) for title, text in sections.items()}
    names = ["instrument", "element beam", "Jones term", "sky", "calibrator", "imager", "engine"]
    assert list(lines) == [f"A new {name}" for name in (*names, "foreground remover", "stage")]
    assert max(lines.values()) < 40, lines


def test_a_new_instrument_takes_less_than_forty_lines():
    page, script = ROOT / "docs" / "extending.md", ROOT / "docs" / "examples" / "new_instrument.py"
    text = next(text for _, text in blocks(page, "python") if "(Instrument)" in text)
    assert len(text.splitlines()) < 40
    # the page and the script show the same class
    (on_page,), (in_script,) = (
        [ast.dump(node) for node in ast.parse(t).body if isinstance(node, ast.ClassDef)]
        for t in (text, script.read_text(encoding="utf-8"))
    )
    assert on_page == in_script


def test_the_picture_of_the_house_shows_the_files_that_are_there():
    text = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    (picture,) = re.findall(r"^```\n(instrument/ .*?)^```$", text, re.MULTILINE | re.DOTALL)
    shown, folders = set(), []
    for line in picture.splitlines():
        depth = (len(line) - len(line.lstrip())) // 4
        name, what = line.split(maxsplit=1)
        folders[depth:] = [name]
        shown.add("".join(folders))
        if name.endswith("/"):
            shown |= {"".join(folders) + other for other in re.findall(r"\b\w+\.py\b", what)}
    missing = sorted(path for path in shown if not (ROOT / path).exists())
    assert not missing, f"docs/index.md shows what is not there: {', '.join(missing)}"
    there = {p.relative_to(ROOT).as_posix() for top in ("instrument", "plugins") for p in (ROOT / top).rglob("*.py")}
    unknown = sorted(path for path in there - shown if not path.endswith("__init__.py"))
    assert not unknown, f"docs/index.md does not show {', '.join(unknown)}"


def test_each_line_of_the_table_of_signs_is_a_test():
    page, file = ROOT / "docs" / "conventions.md", Path(__file__).with_name("test_conventions.py")
    listed = re.findall(r"\| `(test_\w+)` \|$", page.read_text(encoding="utf-8"), re.MULTILINE)
    tests = [
        node.name for node in ast.parse(file.read_text(encoding="utf-8")).body if isinstance(node, ast.FunctionDef)
    ]
    assert sorted(listed) == sorted(name for name in tests if name.startswith("test_"))
