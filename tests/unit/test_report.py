"""The figures show what was measured and nothing else; the page holds what it was given, escaped and self-contained."""

import re
import warnings
from html.parser import HTMLParser

import numpy as np
import pytest
from astropy import units as u
from matplotlib.figure import Figure
from matplotlib.image import imread

from instrument import StokesCube
from instrument.analyze.sources.leakage import Leakage
from instrument.errors import FileError, InputError
from instrument.image.psf import Psf
from instrument.observe.directions import offset
from instrument.report import figures, images, style
from instrument.report.page import (
    Card,
    Cell,
    Details,
    FigureEntry,
    Figures,
    Page,
    Section,
    Table,
    Text,
    duration,
    number,
    write_page,
)
from instrument.report.run_page import page_of_run
from instrument.units import Direction

CENTRE = Direction(2.15, 0.84)


def leakage_on_grid(near_null=(0, 3), expected=True, scale=1.0) -> Leakage:
    """5 x 5 sources 1 deg apart: linear leakage 1 % a degree, circular a thousandth of it."""
    step = np.deg2rad(np.arange(-2, 3))
    l, m = (x.ravel() for x in np.meshgrid(step, step))
    distance = np.arcsin(np.hypot(l, m))
    stokes = np.zeros((25, 4))
    stokes[:, 0] = 0.3
    stokes[:, 1] = 0.3 * 0.01 * np.rad2deg(distance) * scale
    stokes[:, 3] = stokes[:, 1] * 1e-3
    null = np.zeros(25, bool)
    null[list(near_null)] = True
    model = np.tile([0.4, 0, 0, 0], (25, 1)).astype(float)
    ra, dec = offset(CENTRE, l, m)
    percent = 100 * np.stack([stokes[:, 1], stokes[:, 3]], axis=1) / 0.3
    names = tuple(f"s{k}" for k in range(25))
    return Leakage(
        names,
        ra,
        dec,
        distance,
        model,
        stokes,
        np.full((25, 4), 1e-9),
        150e6,
        null,
        percent * 1.1 if expected else None,
    )


def cube_of(pixels=64, psf=True, unit="Jy/beam") -> StokesCube:
    """Images of noise with one polarized source; a PSF 6 by 3 pixels wide whose major axis points north-east."""
    data = np.random.default_rng(1).normal(0, 1e-3, (1, 4, pixels, pixels))
    data[0, :, pixels // 2 + 5, pixels // 2 - 9] = [1, 0.02, -0.01, 1e-5]
    data[0, 3] *= 1e-6
    y, x = np.indices((pixels, pixels)) - pixels // 2
    along, across = (-x + y) / np.sqrt(2), (x + y) / np.sqrt(2)
    lobe = np.exp(-4 * np.log(2) * ((along / 6) ** 2 + (across / 3) ** 2))
    pixel = np.deg2rad(1 / 60)
    fit = Psf(lobe[None], np.array([6 * pixel]), np.array([3 * pixel]), np.array([np.pi / 4]), np.zeros(1))
    return StokesCube(data, [150] * u.MHz, 1 * u.arcmin, unit, CENTRE, fit if psf else None)


def is_drawn(path) -> bool:
    picture = imread(path)[..., :3]
    colours = np.unique(np.round(255 * picture) @ [65536, 256, 1])
    return min(picture.shape[:2]) > 300 and len(colours) > 30


def test_every_figure_is_written_and_not_blank(tmp_path):
    drawings = {
        "linear": figures.bubbles(leakage_on_grid(), CENTRE),
        "circular": figures.bubbles(leakage_on_grid(), CENTRE, "circular"),
        "profile": figures.profile(leakage_on_grid()),
        "images": images.stokes_images(cube_of()),
        "psf": images.psf_image(cube_of()),
    }
    for name, drawing in drawings.items():
        path = style.save(drawing, tmp_path / f"{name}.png")
        assert is_drawn(path), name
    assert not list(tmp_path.glob("*.part"))


def test_figures_are_drawn_on_the_axes_they_are_given():
    ax = Figure().add_subplot()
    assert figures.bubbles(leakage_on_grid(), CENTRE, ax=ax) is ax
    ax = Figure().add_subplot()
    assert figures.profile(leakage_on_grid(), ax=ax) is ax


def test_sources_near_a_null_are_not_coloured_and_are_named_in_the_legend():
    leakage = leakage_on_grid(near_null=(0, 3, 7))
    measured, crosses = figures.bubbles(leakage, CENTRE).collections
    assert len(measured.get_array()) == 22 and crosses.get_array() is None
    assert len(crosses.get_offsets()) == 3
    shown = np.rad2deg(leakage.distance_rad)[~leakage.near_null]
    # the leakage drawn is 1 % a degree
    np.testing.assert_allclose(np.sort(measured.get_array()), np.sort(shown), atol=1e-12)
    texts = [t.get_text() for t in measured.axes.get_legend().get_texts()]
    assert texts == ["not measured: near a null, or too faint (3)"]


def test_bubbles_lie_east_to_the_left_at_their_true_distance():
    leakage = leakage_on_grid(near_null=())
    ax = figures.bubbles(leakage, CENTRE)
    left, right = ax.get_xlim()
    assert left > 2 > -2 > right
    places = ax.collections[0].get_offsets()
    np.testing.assert_allclose(
        np.sort(np.hypot(*np.asarray(places).T)), np.sort(np.rad2deg(leakage.distance_rad)), atol=1e-9
    )
    east, north = figures.offsets_deg(np.array([CENTRE.ra_rad + 0.01]), np.array([CENTRE.dec_rad]), CENTRE)
    assert east > 0 and abs(north) < 0.01


def test_the_centre_is_found_from_a_source_there_or_asked_for():
    figures.bubbles(leakage_on_grid())
    away = leakage_on_grid()
    away = Leakage(**{**vars(away), "distance_rad": away.distance_rad + 0.01})
    with pytest.raises(InputError, match="centre="):
        figures.bubbles(away)


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e3])
@pytest.mark.parametrize("near_null", [(), range(25)])
def test_extreme_leakages_are_drawn_without_a_warning(tmp_path, scale, near_null):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", DeprecationWarning)  # an older matplotlib with a newer pyparsing
        leakage = leakage_on_grid(near_null, expected=False, scale=scale)
        style.save(figures.bubbles(leakage, CENTRE), tmp_path / "a.png")
        style.save(figures.profile(leakage), tmp_path / "b.png")


def test_one_source_at_the_centre_is_drawn():
    leakage = leakage_on_grid()
    keep = leakage.distance_rad < 1e-6
    one = Leakage(
        **{k: v[keep] if isinstance(v, np.ndarray) and len(v) == 25 else v for k, v in vars(leakage).items()}
        | {"names": ("s12",)}
    )
    assert len(figures.bubbles(one, CENTRE).collections[0].get_offsets()) == 1
    figures.profile(one)


def test_images_without_data_or_psf_are_drawn_and_a_psf_alone_is_asked_for(tmp_path):
    cube = cube_of(psf=False, unit="K")
    cube.data[0, 1] = np.nan
    cube.data[0, 2] = 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", DeprecationWarning)  # an older matplotlib with a newer pyparsing
        style.save(images.stokes_images(cube), tmp_path / "a.png")
    with pytest.raises(InputError, match="no PSF"):
        images.psf_image(cube)


def test_a_large_image_is_shown_smaller_without_losing_a_source():
    cube = cube_of(pixels=1300, psf=False)
    figure = images.stokes_images(cube)
    shown = figure.axes[0].images[0]
    assert shown.get_array().shape == (434, 434)  # 3 x 3 pixels in one, the last row and column padded
    assert np.nanmax(shown.get_array()) == 1 or np.isclose(np.nanmax(shown.get_array()), 1000)
    row, column = np.unravel_index(np.nanargmax(shown.get_array()), (434, 434))
    left, right, bottom, _ = shown.get_extent()
    step = (left - right) / 434
    # 9 pixels of 1 arcmin east, 5 north of the centre, to the size of what is shown
    assert abs(left - (column + 0.5) * step - 9 / 60) <= step
    assert abs(bottom + (row + 0.5) * step - 5 / 60) <= step


def test_the_psf_ellipse_lies_along_the_psf():
    ax = images.psf_image(cube_of())
    ellipse = ax.patches[0]
    ends = ellipse.get_patch_transform().transform([(0, 1), (0, -1)])
    east, north = (ends[0] - ends[1]) / 2
    # the major axis is 6 arcmin long at a position angle of 45 deg: north-east is up and to the left
    np.testing.assert_allclose([abs(east), abs(north)], 3 / np.sqrt(2), rtol=1e-6)
    assert east * north > 0
    assert ax.get_xlim()[0] > ax.get_xlim()[1]


class Resources(HTMLParser):
    """Every address a page asks for, its tags, and the text a reader sees."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.addresses, self.tags, self.text = [], [], []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [v for k, v in attrs if k in ("src", "href", "srcset", "data", "action", "poster")]

    def handle_data(self, data):
        self.text.append(data)


RECORD = {
    "name": "mock-grid",
    "title": "A <b>grid</b> & more",
    "finished": "2026-01-02T03:04:05+00:00",
    "seed": 196,
    "versions": {"instrument": "9.8.7", "numpy": "2.0"},
    "machine": {"system": "Linux", "workers": 16},
    "plan": {"text": ["scene mock-grid: <59> stations", "kept  StationBeam"], "engine": "matrix"},
    "stages": {
        name: {
            "seconds": {"planned": due, "measured": spent},
            "memory": {"planned_bytes": 2e6, "measured_bytes": 1.5e6},
        }
        for name, due, spent in (("predict", 18.0, 20.0), ("image", 12.0, 10.0), ("write", None, 0.0))
    },
    "memory": {"planned_bytes": 8e8, "measured_bytes": 7e8},
    "checks": {
        "prediction": {"error": 3e-14, "bound": 2e-12, "samples": 64, "relative_to_jy": 189.6, "passed": True},
        "photometry": {"outcome": ["converged"], "passed": True, "flux_in_jy": 189.6, "flux_out_jy": 116.3},
    },
    "parts": {"image": {"weights": 2.0}},
    "command": "instrument run mock-grid --set seed=196",
}


@pytest.fixture
def page(tmp_path):
    drawing = style.save(figures.profile(leakage_on_grid()), tmp_path / "profile.png")
    entry = FigureEntry(drawing, "Leakage <against> distance", wide=True)
    sections = [
        Section("Leakage", [Figures([entry])]),
        Section("Spectra", [Text("a paragraph"), Table(["k"], [[1.5]])]),
    ]
    sources = [Section("All sources", [Details("25 sources", [Table.of(leakage_on_grid().table())])])]
    made = page_of_run(RECORD, [Card("PSF", "3.83′ × 3.81′")], sections, sources)
    path = write_page(made, tmp_path / "report.html")
    assert not list(tmp_path.glob("*.part"))
    return path.read_text(encoding="utf-8")


def test_the_page_holds_what_was_given(page):
    text = "".join(Resources(page).text)
    for part in (
        "A <b>grid</b> & more", "scene mock-grid: <59> stations", "Leakage <against> distance", "a paragraph", "1.50",
        "Done; every check held", "3.0e-14", "bound 2.0e-12", "189.6 Jy", "116.3 Jy", "30 s", "3.83′ × 3.81′", "9.8.7",
        "engine matrix, 16 workers", "instrument run mock-grid --set seed=196", "25 sources", "s17", "converged",
        "weights",
    ):  # fmt: skip
        assert part in text, part
    assert "width:100.0%" in page and "width:50.0%" in page and "width:0.0%" in page


def test_the_page_escapes_what_it_is_given(page):
    assert "<b>" not in page and "<59>" not in page and "<against>" not in page
    assert "A &lt;b&gt;grid&lt;/b&gt; &amp; more" in page


def test_everything_in_every_block_is_escaped(tmp_path):
    evil = "<script>alert(1)</script>\"'"
    blocks = [
        Text(evil),
        Text(evil, code=True),
        Table([evil], [[evil], [Cell(evil, bar=0.5, mark="bad")]], evil),
        Details(evil, [Text(evil)]),
    ]
    out = Page(evil, evil, evil, "bad", [Card(evil, evil, evil, "good")], [Section(evil, blocks)], evil)
    found = Resources(write_page(out, tmp_path / "a.html").read_text(encoding="utf-8"))
    assert "script" not in found.tags
    # title twice, subtitle, verdict, card x 3, section, two texts, head, two cells, caption, details x 2, footer
    assert "".join(found.text).count(evil) == 17


def test_the_page_is_self_contained(page):
    found = Resources(page)
    assert len(found.addresses) == 1 and found.addresses[0].startswith("data:image/png;base64,")
    assert not {"script", "link", "iframe", "object"} & set(found.tags)
    style = re.search(r"<style>(.*?)</style>", page, re.S)[1]
    assert "url(" not in style and "@import" not in style and "prefers-color-scheme: dark" in style
    assert 'name="viewport"' in page and "default-src 'none'" in page


def test_a_check_that_fell_short_is_said_at_the_top(tmp_path):
    prediction = {**RECORD["checks"]["prediction"], "error": 5e-12, "passed": False}
    record = {**RECORD, "checks": {**RECORD["checks"], "prediction": prediction}}
    made = page_of_run(record)
    assert made.verdict == "Done, but fell short: prediction." and made.mark == "bad"
    assert [card.mark for card in made.cards if card.label == "Prediction error"] == ["bad"]


def test_parts_that_are_absent_from_the_record_are_absent_from_the_page(tmp_path):
    made = page_of_run({"name": "bare", "stages": {"plan": RECORD["stages"]["predict"]}})
    assert [section.title for section in made.sections] == [
        "What each stage cost, and how wrong it may be",
        "To run it again",
    ]
    assert made.verdict == "Done; nothing was checked." and made.mark == ""
    write_page(made, tmp_path / "a.html")


def test_a_long_table_is_cut_and_says_so():
    from astropy.table import QTable

    table = Table.of(QTable({"flux": np.arange(2500.0) * u.Jy}), "Fluxes.")
    assert len(table.body) == 2000 and table.columns == ["flux (Jy)"]
    assert table.caption == "Fluxes. The first 2000 of 2500 rows."


def test_a_figure_that_is_not_there_or_no_png_is_named(tmp_path):
    with pytest.raises(FileError, match=r"gone\.png"):
        Figures([FigureEntry(tmp_path / "gone.png", "")]).read()
    (tmp_path / "text.png").write_text("no")
    with pytest.raises(FileError, match="not a PNG"):
        Figures([FigureEntry(tmp_path / "text.png", "")]).read()


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.4, "0.400"),
        (1.0, "1"),
        (12345.6, "12346"),
        (1.67e-5, "1.67e-05"),
        (123.4, "123"),
        (0.0, "0"),
        (7, "7"),
        (2.5e9, "2.50e+09"),
        (np.float32(0.25), "0.250"),
        (float("inf"), "inf"),
        (float("nan"), "–"),
        (None, "–"),
        (True, "yes"),
        (np.bool_(False), "no"),
        ("text", "text"),
    ],
)
def test_numbers_are_written_with_three_digits(value, text):
    assert number(value) == text


def test_durations_are_written_as_people_say_them():
    assert [duration(s) for s in (0.25, 48.2, 700, 11000)] == ["0.25 s", "48 s", "12 min", "3.1 h"]
