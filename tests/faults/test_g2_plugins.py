"""What a plugin can be given is listed with units and defaults; what it lacks is said."""

from importlib.metadata import EntryPoint, EntryPoints
from types import SimpleNamespace
from typing import ClassVar

import pytest

from instrument import registry
from instrument.cli import main
from instrument.component import Component
from instrument.registry import KINDS, available


def told(capsys, *words):
    status = main(["plugins", *words])
    out = capsys.readouterr()
    return status, out.out, out.err


def test_g2_settings_are_listed_with_units_and_defaults(capsys):
    status, shown, _ = told(capsys, "dipole")
    assert status == 0
    rows = {line.split()[0]: " ".join(line.split()[1:]) for line in shown.splitlines() if line.strip()}
    assert rows["height"] == "needed a value with a unit (m, km), above 0"
    assert rows["x_azimuth"] == "0 deg a value with a unit (deg)"
    _, shown, _ = told(capsys, "lofar-hba")
    for words in ("element", "{ kind = name, ... }", "airy, dipole, gaussian, hamaker", '"surveyed" or "ideal"', "MHz"):
        assert words in shown
    _, shown, _ = told(capsys, "random")
    assert "5 deg" in shown and "a whole number of at least 1" in shown


def test_g2_the_settings_of_a_stage_are_the_keys_of_its_table(capsys):
    for name, *keys in (
        ("image", "pixels", "uv_range"), ("calibrate", "tolerance", "interval"), ("analyze", "products", "every"),
        ("calibrate.many-directions", "clusters", "tolerance"), ("calibrate.incomplete-model", "models"),
    ):  # fmt: skip
        rows = [line.split()[0] for line in told(capsys, name)[1].splitlines() if line.strip()]
        assert set(keys) <= set(rows), name
        assert not {"imager", "calibrator needed", "laboratory"} & set(rows)


def test_g2_every_plugin_can_be_described(capsys):
    for name in {name for kind in KINDS for name in available(kind)}:
        status, shown, said = told(capsys, name)
        assert status == 0 and said == "" and name in shown


def test_g2_an_unknown_plugin_is_one_line_with_the_nearest(capsys):
    status, _, said = told(capsys, "dipol")
    assert status == 2 and "did you mean 'dipole'" in said and said.count("\n") == 1


class Needy(Component):
    """Needs what is not there."""

    needs: ClassVar = {"no_such_module_anywhere": "no-such-package"}


def test_g2_a_plugin_that_lacks_a_package_says_so(capsys, monkeypatch):
    point = EntryPoint("needy", f"{__name__}:Needy", "instrument.foregrounds")._for(SimpleNamespace(name="mine"))
    monkeypatch.setattr(EntryPoint, "load", lambda self: Needy)
    monkeypatch.setattr(registry, "entry_points", lambda group: EntryPoints([point]).select(group=group))
    registry.refresh()
    try:
        assert available("foregrounds")["needy"].lacks == "no-such-package: pip install no-such-package"
        assert "lacks no-such-package: pip install no-such-package" in told(capsys)[1]
    finally:
        monkeypatch.undo()
        registry.refresh()


@pytest.mark.parametrize("kind", KINDS)
def test_g2_settings_of_every_kind_have_words(kind):
    from instrument.plugin_settings import describe

    for name in available(kind):
        assert not any("typing." in line or "<class" in line for line in describe(name))
