"""A package of somebody else, made of the page on extending, as it lies after its installation."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from instrument import registry

PAGE = Path(__file__).parents[2] / "docs" / "extending.md"


@pytest.fixture
def package(tmp_path):
    """`package({"stages": {"flagged": "Flagged"}})`: the folder of a package with the classes of the page."""

    def make(points):
        code = []
        for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S):
            for node in ast.parse(block).body:
                if isinstance(node, ast.Import | ast.ImportFrom | ast.ClassDef) or "SITE =" in ast.unparse(node):
                    code.append(ast.unparse(node))
        info = tmp_path / "site" / "my_package-1.0.dist-info"
        info.mkdir(parents=True)
        (tmp_path / "site" / "my_package.py").write_text("\n\n".join(code))
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-package\nVersion: 1.0\n")
        groups = [
            f"[instrument.{kind}]\n" + "\n".join(f"{name} = my_package:{cls}" for name, cls in named.items())
            for kind, named in points.items()
        ]
        (info / "entry_points.txt").write_text("\n".join(groups) + "\n")
        return tmp_path / "site"

    return make


@pytest.fixture
def stranger(package, monkeypatch):
    """`stranger("stages", "flagged", "Flagged")` installs a class of the page, by this name, for this test."""

    def install(kind, name, cls):
        monkeypatch.syspath_prepend(str(package({kind: {name: cls}})))
        registry.refresh()
        assert registry.available(kind)[name].package == "my-package"

    yield install
    monkeypatch.undo()
    sys.modules.pop("my_package", None)
    registry.refresh()


@pytest.fixture
def command(tmp_path):
    """`command(site, "run", ...)`: the command in a process of its own that finds the package."""

    def run(site, *words):
        return subprocess.run(
            [sys.executable, "-m", "instrument.cli", *words], cwd=tmp_path, capture_output=True, text=True, timeout=300,
            env={**os.environ, "PYTHONPATH": str(site)},
        )  # fmt: skip

    return run
