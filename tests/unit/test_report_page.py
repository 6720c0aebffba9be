"""The page to a picky eye: order, dark screens, phones, words for what was not measured, first and last channels."""

import re
from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from astropy import units as u
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

from instrument import StokesCube
from instrument.analyze.sources.leakage import Leakage
from instrument.errors import InputError, Outcome
from instrument.experiments.many_directions_result import ManyDirectionsResult
from instrument.image.dirty import Imager
from instrument.pipeline import run as running
from instrument.pipeline.stage import StageResult
from instrument.pipeline.stages.analyze import Analyze
from instrument.pipeline.stages.image import ImageResult
from instrument.pipeline.stages.laboratories import SubtractionResult
from instrument.pipeline.stages.leakage import LeakageResult
from instrument.report import figures, images, laboratory, night, style
from instrument.report.page import FigureEntry, Figures, Page, Section, Table, Text, write_page
from instrument.report.run_page import page_of_run
from instrument.units import Direction

CENTRE = Direction(2.15, 0.84)


def drawn(entries):
    """Keeps the names of figures and writes none."""

    def inner(name, drawing, caption, wide=False):
        entries.append(name)
        return FigureEntry(f"{name}.png", caption, wide=wide)

    return inner


def cube(channels, value=1.0) -> StokesCube:
    data = np.full((channels, 4, 16, 16), value) * np.arange(1, channels + 1)[:, None, None, None]
    data[:, :, 8, 8] *= 2
    return StokesCube(data, (150 + np.arange(channels)) * u.MHz, 1 * u.arcmin, "Jy/beam", CENTRE, None)


def faint(count=3) -> LeakageResult:
    """Sources that are all near a null."""
    stokes, model = np.zeros((count, 4)), np.tile([1.0, 0, 0, 0], (count, 1))
    ra, zero = np.full(count, CENTRE.ra_rad), np.zeros(count)
    names = tuple(f"s{k}" for k in range(count))
    found = Leakage(names, ra, zero + 0.84, zero, model, stokes, stokes + 1e-9, 150e6, np.ones(count, bool), None)
    fluxes = SimpleNamespace(outcome=[Outcome.CONVERGED], model_jy=model[None], stokes_jy=stokes[None])
    return LeakageResult(fluxes, found, CENTRE)


def many(noise=2.0) -> SubtractionResult:
    two = np.array([1.0, 3.0])
    apart = np.array([[0.1, 0.2], [4.0, 5.0]])
    return SubtractionResult(
        ManyDirectionsResult(
            ("a", "b"),
            np.array([1, 2]),
            two,
            two / 100,
            np.zeros(2),
            9.0,
            noise,
            2.0,
            2.0,
            0.1,
            6.0,
            5.0,
            0.0,
            apart_jy=apart,
        )
    )


def test_where_no_source_was_measured_it_is_said_and_nothing_is_drawn(tmp_path):
    names = []
    (section,) = faint().sections(drawn(names))
    assert names == [] and not any(isinstance(block, Figures) for block in section.blocks)
    assert section.blocks[-1].text == "None of the 3 sources was measured: 3 near a null, 0 too faint."
    assert [card.value for card in faint().cards()] == ["none"]
    assert not re.search(r"[–-]\s*%", str(faint().cards()))


@pytest.mark.parametrize(
    ("channels", "places"), [(1, ["last"]), (2, ["first", "last"]), (5, ["first", "middle", "last"])]
)
def test_first_middle_and_last_channels_are_imaged(monkeypatch, channels, places):
    seen = []
    monkeypatch.setattr(images, "stokes_images", lambda cube, channel: seen.append(channel))
    names = ["images", *(f"images_{place}" for place in places[1:])]
    made = []
    (section,) = ImageResult(Imager(pixels=16, pixel="1 arcmin"), cube(channels)).sections(drawn(made))
    assert made == names and seen == {1: [0], 2: [0, 1], 5: [0, 2, 4]}[channels]
    figures_, table = section.blocks
    assert len(table.columns) == 1 + len(names) and len(table.rows) == 4
    assert table.columns[-1] == f"{149 + channels} MHz"
    assert table.rows[0][-1] == pytest.approx(channels * table.rows[0][1])  # channel n is n times the first
    assert len({entry.caption for entry in figures_.entries}) == len(names)


def test_images_without_data_are_said_not_drawn(tmp_path):
    made = []
    (section,) = ImageResult(Imager(pixels=16, pixel="1 arcmin"), cube(2, np.nan)).sections(drawn(made))
    assert made == [] and isinstance(section.blocks[0], Text)


def test_many_directions_draws_what_is_left_of_each_cluster_beside_the_noise(tmp_path):
    made = []
    (section,) = many().sections(drawn(made))
    assert made == ["many_directions"]
    table = section.blocks[-1]
    assert table.columns[-2:] == ["left of it (Jy)", "left with one direction (Jy)"]
    assert [row[-2:] for row in table.rows] == [[0.1, 4.0], [0.2, 5.0]]
    assert section.blocks[0].text.startswith("Left after subtraction")
    ax = laboratory.left_of_clusters(many().found)
    one, each, noise = ax.lines
    np.testing.assert_array_equal(one.get_ydata(), [4, 5])
    np.testing.assert_array_equal(each.get_ydata(), [0.1, 0.2])
    assert noise.get_ydata()[0] == 2.0
    assert len(laboratory.left_of_clusters(many(noise=0.0).found).lines) == 2
    with pytest.raises(InputError, match="run the laboratory again"):
        laboratory.left_of_clusters(SimpleNamespace(apart_jy=None))


@dataclass(frozen=True)
class Told(StageResult):
    title: str

    def sections(self, draw):
        return [Section(self.title, [Text("found")])]


class Leads(Told):
    leading: ClassVar[bool] = True


def test_what_the_scene_is_about_comes_first_and_the_time_has_the_writing_in_it(tmp_path, monkeypatch):
    pages = []
    monkeypatch.setattr("instrument.report.page.write_page", lambda page, path: pages.append(page))
    stages = {"calibrate": Leads("Calibration"), "image": Told("Images"), "analyze": Told("Spectra")}
    monkeypatch.setattr(running, "record", lambda result, tables: {"name": "x"})
    running._write(SimpleNamespace(stages=stages, seconds={"predict": 0.5}, grown={}, whole=None), {}, tmp_path)
    titles = [section.title for section in pages[0].sections]
    assert titles[:3] == ["Calibration", "Spectra", "Images"]
    (costs,) = [s for s in pages[0].sections if s.title.startswith("What each stage cost")]
    assert {row[0] for row in costs.blocks[0].rows} == {"predict", "write"}


def test_every_check_says_what_was_expected():
    checks = {
        "photometry": {"outcome": ["converged"], "passed": True},
        "power spectrum of I": {"outcome": ["error 2.2e-15, at most 1e-11, of 16 samples"], "passed": True},
        "removal": {"outcome": ["removed 97 %"], "passed": True},
    }
    (section,) = [s for s in page_of_run({"name": "x", "checks": checks}).sections if s.title == "Checks"]
    assert [row[1:3] for row in section.blocks[0].rows] == [
        ["converged", "converged"],
        ["error 2.2e-15, of 16 samples", "at most 1e-11"],
        ["removed 97 %", "converged, and no worse than before"],
    ]


def test_a_figure_has_a_variant_for_dark_screens_that_leaves_images_alone(tmp_path):
    entry = style.drawer(tmp_path)("a", Figure(figsize=(1, 1)), "Images.")
    page = write_page(Page("t", sections=[Section("s", [Figures([entry])])]), tmp_path / "a.html").read_text()
    assert re.search(r'<source media="\(prefers-color-scheme: dark\)" srcset="data:image/(webp|png);base64,', page)
    assert 'alt="Images."' in page and 'class="day"' not in page
    lone = Page("t", sections=[Section("s", [Figures([FigureEntry(tmp_path / "a.png", "c")])])])
    assert 'class="day"' in write_page(lone, tmp_path / "b.html").read_text()

    figure = Figure(figsize=(2, 1))
    plot, picture = figure.subplots(1, 2)
    (ink,), (on_image,) = plot.plot([0, 1], color="black"), picture.plot([0, 1], color="black")
    colours = picture.imshow(np.eye(2)).cmap(0.5)
    night.night(figure)
    assert min(to_rgba(ink.get_color())[:3]) > 0.85 and max(plot.get_facecolor()[:3]) < 0.2
    assert on_image.get_color() == "black" and picture.images[0].cmap(0.5) == colours
    assert min(to_rgba(picture.xaxis.label.get_color())[:3]) > 0.85


def test_greys_change_places_and_colours_stay():
    assert night.flipped("white") == pytest.approx(to_rgba("#1d2126"))
    assert night.flipped("black") == pytest.approx(to_rgba("#e6e9ed"))
    assert night.flipped("#009E73") == pytest.approx(to_rgba("#009E73"))
    assert night.flipped((1, 1, 1, 0.25))[3] == 0.25 and night.flipped("none") == "none"


def test_tables_of_few_rows_stack_on_a_phone_and_others_show_that_they_scroll(tmp_path):
    blocks = [Table(["a", "b"], [["x", None]], stack=True), Table(["c"], [["y"]])]
    page = write_page(Page("t", sections=[Section("s", blocks)]), tmp_path / "a.html").read_text()
    assert '<table class="stack">' in page and 'data-head="a"' in page and 'data-head="c"' not in page
    assert re.search(r"pre, \.scroll \{[^}]*local", page) and "max-width: 620px" in page


def test_a_crowd_that_was_not_measured_is_dots():
    count = 400
    ra = CENTRE.ra_rad + np.linspace(0, 0.03, count)
    stokes = np.tile([1.0, 0.01, 0, 0], (count, 1))
    null = np.arange(count) > 20
    names = tuple(map(str, range(count)))
    found = Leakage(
        names, ra, np.full(count, CENTRE.dec_rad), ra - ra[0], stokes, stokes, 1e-9 * stokes, 150e6, null, None
    )
    measured, lost = figures.bubbles(found, CENTRE).collections
    assert len(lost.get_offsets()) == 379 and lost.get_sizes()[0] < measured.get_sizes().min() * 2


def test_a_wrong_product_in_a_scene_is_told_the_near_one():
    known = "'leakage', 'spectrum-2d', 'recovered'"
    with pytest.raises(InputError, match=rf"'leekage' is not one of {known}: did you mean 'leakage'\?"):
        Analyze(products=["leekage"])
