"""A package of somebody else, made of the page on extending, as it lies after its installation."""

import re
import sys
from pathlib import Path

import pytest

from instrument import registry

PAGE = Path(__file__).parents[2] / "docs" / "extending.md"
HEAD = """from typing import Annotated
import numpy as np
from astropy import units as u
from pydantic import Field
from instrument.units import Metres
"""


@pytest.fixture
def stranger(tmp_path, monkeypatch):
    """`stranger("stages", "flagged", "Flagged")` installs a class of the page, by this name, for this test."""

    def install(kind, name, cls):
        blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)
        block = next(b for b in blocks if f"class {cls}(" in b)
        info = tmp_path / "site" / "my_package-1.0.dist-info"
        info.mkdir(parents=True)
        (tmp_path / "site" / "my_package.py").write_text(HEAD + block.partition("instrument.conformance")[0])
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-package\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[instrument.{kind}]\n{name} = my_package:{cls}\n")
        monkeypatch.syspath_prepend(str(tmp_path / "site"))
        registry.refresh()
        assert registry.available(kind)[name].package == "my-package"

    yield install
    monkeypatch.undo()
    sys.modules.pop("my_package", None)
    registry.refresh()
