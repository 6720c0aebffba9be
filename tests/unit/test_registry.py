"""Plugins by name: found through entry points, refused in one line, and one broken package does not stop the rest."""

from importlib.metadata import EntryPoint, EntryPoints
from types import SimpleNamespace

import pytest

import instrument
from instrument import registry
from instrument.errors import InputError, PluginError
from instrument.predict.direct import Direct

GOOD = "instrument.predict.direct:Direct"
OTHER = "instrument.predict.matrix:Matrix"


def point(name, value, package, kind="engines"):
    found = EntryPoint(name, value, f"instrument.{kind}")
    return found._for(SimpleNamespace(name=package)) if package else found


@pytest.fixture
def installed(monkeypatch):
    """Puts fake packages in place of the installed ones."""

    def install(*points):
        monkeypatch.setattr(registry, "entry_points", lambda group: EntryPoints(points).select(group=group))
        registry.refresh()

    yield install
    monkeypatch.undo()
    registry.refresh()


def test_a_plugin_is_found_and_made_with_its_settings(installed):
    installed(point("plain", GOOD, "one"))
    assert instrument.load("engines", "plain") == Direct()
    found = instrument.available("engines")["plain"]
    assert (found.kind, found.name, found.package, found.target, found.broken) == (
        "engines",
        "plain",
        "one",
        GOOD,
        None,
    )


def test_an_unknown_name_lists_the_known_ones_and_the_nearest(installed):
    installed(point("plain", GOOD, "one"), point("fancy", OTHER, "one"))
    with pytest.raises(
        PluginError, match=r"no engine is called 'fany': did you mean 'fancy'\? \(known: fancy, plain\)"
    ):
        instrument.load("engines", "fany")


@pytest.mark.parametrize(
    ("kind", "singular"),
    [("skies", "sky"), ("engines", "engine"), ("elements", "element"), ("telescopes", "telescope")],
)
def test_the_thing_is_called_by_its_singular(kind, singular):
    with pytest.raises(PluginError, match=f"no {singular} is called 'no-such-thing'"):
        instrument.load(kind, "no-such-thing")


def test_nothing_installed_says_so(installed):
    installed()
    assert instrument.available("engines") == {}
    with pytest.raises(PluginError, match="no engine is called 'plain': none is known"):
        instrument.load("engines", "plain")


def test_an_unknown_kind_is_refused_with_the_nearest():
    with pytest.raises(PluginError, match="no plugins of kind 'element': did you mean 'elements'"):
        instrument.available("element")


def test_two_packages_claiming_one_name_is_an_error_that_names_both(installed):
    installed(point("plain", GOOD, "one-package"), point("plain", OTHER, "other-package"), point("fancy", OTHER, "one"))
    with pytest.raises(PluginError, match=r"'plain' in engines is claimed by one-package .*and other-package"):
        instrument.load("engines", "plain")
    listing = instrument.available("engines")
    assert "one-package" in listing["plain"].broken
    assert "other-package" in listing["plain"].broken
    assert listing["fancy"].broken is None


def test_the_same_claim_twice_is_one_plugin(installed):
    # an editable install beside a normal one shows every entry point twice
    installed(point("plain", GOOD, "one"), point("plain", GOOD, "one"))
    assert instrument.load("engines", "plain") == Direct()


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ("no_such_module_anywhere:Thing", "ModuleNotFoundError"),
        ("instrument.predict.direct:NoSuchClass", "AttributeError"),
        ("antigravity_that_fails:X", "ModuleNotFoundError"),
    ],
)
def test_a_plugin_that_does_not_import_is_reported_by_name_and_the_rest_works(installed, value, reason):
    installed(point("bad", value, "bad-package"), point("plain", GOOD, "one"))
    with pytest.raises(PluginError, match=f"plugin 'bad' of bad-package does not import: {reason}"):
        instrument.load("engines", "bad")
    listing = instrument.available("engines")
    assert "bad-package" in listing["bad"].broken
    assert listing["plain"].broken is None
    assert instrument.load("engines", "plain") == Direct()


def test_a_plugin_that_raises_anything_on_import_does_not_break_the_rest(installed, tmp_path, monkeypatch):
    (tmp_path / "raises_on_import.py").write_text("raise ZeroDivisionError('boom')")
    monkeypatch.syspath_prepend(tmp_path)
    installed(point("bad", "raises_on_import:X", "bad-package"), point("plain", GOOD, "one"))
    assert instrument.available("engines")["bad"].broken.endswith("does not import: ZeroDivisionError: boom")
    assert instrument.available("engines")["plain"].broken is None


def test_a_plan_with_a_broken_engine_names_it_and_runs_with_another(installed):
    from astropy import units as u

    from instrument.conformance.bench import bench, lofar_like, random_sky

    installed(point("bad", "no_such_module_anywhere:X", "bad-package"), point("plain", GOOD, "one"))
    scene = instrument.Scene(
        instrument=instrument.Composed(stations=lofar_like(), terms=instrument.Chain()),
        sky=random_sky(bench().centre, polarized=False, gaussian=False),
        observation=instrument.Observation(
            phase_centre=bench().centre.skycoord,
            start="2012-12-07T00:00:00",
            duration=10 * u.s,
            interval=10 * u.s,
            frequencies=[150] * u.MHz,
        ),
    )
    plan = scene.plan()
    assert plan.engine == Direct()
    assert [item.name for item in plan.refused] == ["bad"]
    assert "bad-package" in str(plan)


def test_an_unknown_setting_of_a_plugin_is_an_input_error():
    with pytest.raises(InputError, match="Matrix has no 'blocks'"):
        instrument.load("engines", "matrix", blocks=3)


def test_a_name_that_is_not_text_is_refused():
    with pytest.raises(InputError, match="name = 3 must be text"):
        instrument.load("engines", 3)


def test_a_package_installed_into_a_running_python_is_seen_after_refresh(installed, monkeypatch):
    installed(point("plain", GOOD, "one"))
    assert list(instrument.available("engines")) == ["plain"]
    more = (point("plain", GOOD, "one"), point("fancy", OTHER, "two"))
    monkeypatch.setattr(registry, "entry_points", lambda group: EntryPoints(more).select(group=group))
    registry.refresh()
    assert list(instrument.available("engines")) == ["fancy", "plain"]


def test_every_plugin_of_this_package_imports():
    broken = [p.broken for kind in registry.KINDS for p in instrument.available(kind).values() if p.broken]
    assert broken == []
