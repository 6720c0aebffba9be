"""Skies as files: what comes back, to the last bit or the stated rounding, and what is refused."""

import numpy as np
import pytest

from instrument.errors import InputError
from instrument.sky.points import PointSky
from instrument.sky.writers import FORMS

ENDINGS = [".skymodel", ".bbs", ".txt", ".csv", ".ecsv", ".skyh5", ".osm"]
EXACT = (".csv", ".ecsv", ".skyh5")


def sky(ending, count=40, seed=1):
    """Sources of everything that the form can hold, of random bits."""
    rng = np.random.default_rng(seed)
    follows = ending in FORMS and FORMS[ending].follows
    fields = {}
    if ending != ".skyh5":
        fields |= {
            "rotation_measure": rng.normal(0, 30, count), "major_rad": rng.uniform(0, 1e-3, count),
            "minor_rad": rng.uniform(0, 1e-3, count), "angle_rad": rng.uniform(-3, 3, count),
        }  # fmt: skip
    terms = 2 if ending in (".csv", ".ecsv") else 4 if ending not in FORMS else 1
    if ending not in FORMS or follows:
        fields["polarization_follows_i"] = np.ones(count, bool)
    stokes = rng.normal(size=(count, 4))
    if ending not in FORMS:
        stokes[:, 3] = 0
    return PointSky(
        names=tuple(f"a {k}" for k in range(count)),
        patches=tuple(("p", "", "q")[k % 3] for k in range(count)),
        ra_rad=rng.uniform(0, 2 * np.pi, count),
        dec_rad=rng.uniform(-1.5, 1.5, count),
        stokes_jy=stokes,
        reference_hz=rng.uniform(1e8, 2e8, count),
        spectral_terms=rng.normal(-0.7, 0.1, (count, terms)),
        **fields,
    )


@pytest.mark.parametrize("ending", ENDINGS)
def test_what_is_written_comes_back(tmp_path, ending):
    there = sky(ending)
    there.write(tmp_path / f"s{ending}")
    back = PointSky.read(tmp_path / f"s{ending}")
    rtol = 0 if ending in EXACT else 1e-15
    for field in type(there).model_fields:
        value, other = getattr(there, field), getattr(back, field)
        if field in ("names", "patches"):
            assert ending == ".osm" or other == value
        elif field not in ("polarization_follows_i", "logarithmic", "not_read"):
            np.testing.assert_allclose(other, value, rtol=rtol, atol=0) if value is not None else None
    freq = np.array([75e6, 150e6, 300e6])
    np.testing.assert_allclose(back.stokes(freq), there.stokes(freq), rtol=rtol and 1e-13, atol=0)


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_sky_that_is_constant_in_frequency_comes_back_as_that(tmp_path, ending):
    there = PointSky(names=("s0",), ra_rad=[1.1], dec_rad=[-0.3], stokes_jy=[[1, 0.1, 0.2, 0.3]])
    there.write(tmp_path / f"s{ending}")
    back = PointSky.read(tmp_path / f"s{ending}")
    assert (back.reference_hz, back.spectral_terms, back.stokes_jy.tolist()) == (None, None, there.stokes_jy.tolist())


def test_the_mock_field_is_written_as_every_form(tmp_path):
    there = PointSky.read("mock_150mhz.csv").brightest(300)
    for ending in ENDINGS:
        there.write(tmp_path / f"s{ending}")
        back = PointSky.read(tmp_path / f"s{ending}")
        np.testing.assert_allclose(back.stokes(np.array([75e6])), there.stokes(np.array([75e6])), rtol=1e-14)


def changed(**fields):
    given = {"names": ("a",), "ra_rad": [1.0], "dec_rad": [0.5], "stokes_jy": [[1, 0.1, 0, 0]], "reference_hz": [1e8]}
    return PointSky(**(given | fields))


@pytest.mark.parametrize(
    ("ending", "fields", "message"),
    [
        (".csv", {"spectral_terms": [[-0.7, 0, 0.1]]}, "source 'a' has more than 2 spectral terms, which CSV cannot"),
        (".skyh5", {"spectral_terms": [[-0.7, 0.1]]}, "source 'a' has more than 1 spectral term, which SkyH5 cannot"),
        (".ecsv", {"spectral_terms": [[-0.7]], "logarithmic": [False]}, "linear spectral terms, which ECSV cannot"),
        (".csv", {"spectral_terms": [[-0.7]], "polarization_follows_i": [True]}, "Q, U and V that follow that of I"),
        (".osm", {"spectral_terms": [[-0.7]]}, "Q, U and V that do not follow the spectrum of I"),
        (".skyh5", {"rotation_measure": [1.0]}, "a rotation measure, which SkyH5 cannot"),
        (".skyh5", {"major_rad": [1e-4], "minor_rad": [1e-4]}, "a shape, which SkyH5 cannot"),
        (".csv", {"names": ("#a",)}, "CSV.*no source in it"),
        (".csv", {"names": ("a\nb",)}, "the sky cannot be written as CSV"),
        (".csv", {"stokes_jy": [[-99.0, 0, 0, 0]]}, "the sky cannot be written as CSV: .*stands for 'no data'"),
        (".csv", {"names": (" a",)}, "CSV does not give source ' a' back as it is"),
        (".fits", {}, "the name of a sky ends in .skymodel, .bbs, .txt, .csv, .ecsv, .skyh5, .osm"),
    ],
)  # fmt: skip
def test_what_a_form_cannot_hold_is_refused_and_nothing_is_left(tmp_path, ending, fields, message):
    with pytest.raises(InputError, match=message) as caught:
        changed(**fields).write(tmp_path / f"s{ending}")
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("ending", ENDINGS)
def test_nothing_is_overwritten_unless_it_is_said(tmp_path, ending):
    (tmp_path / f"s{ending}").write_text("mine")
    with pytest.raises(InputError, match="exists"):
        changed().write(tmp_path / f"s{ending}")
    assert (tmp_path / f"s{ending}").read_text() == "mine"
    changed().write(tmp_path / f"s{ending}", overwrite=True)
    assert len(PointSky.read(tmp_path / f"s{ending}")) == 1
