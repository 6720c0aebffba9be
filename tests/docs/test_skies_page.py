"""The page of catalogues lists the columns and surveys that the reader knows, all of them and no others."""

from pathlib import Path

from instrument.sky.columns import MEANINGS, SURVEYS

PAGE = (Path(__file__).parents[2] / "docs" / "skies.md").read_text(encoding="utf-8")


def rows(mark):
    table = PAGE.partition(f"<!-- {mark} -->\n")[2].partition("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table]


def test_every_name_of_a_column_stands_on_the_page():
    assert {meaning: tuple(names.split(", ")) for meaning, names in rows("columns")} == {
        meaning: names for meaning, (_, names) in MEANINGS.items()
    }


def test_every_survey_stands_on_the_page_with_its_frequency():
    listed = {title: frequency for title, frequency, _ in rows("surveys")}
    assert list(listed) == [s.title for s in SURVEYS]
    assert {t: f for t, f in listed.items() if f.endswith("MHz")} == {
        s.title: f"{s.freq_hz / 1e6:g} MHz" for s in SURVEYS if s.freq_hz
    }
