"""What is read without astropy is what astropy reads: directions in words, data files of the plugins; and when not."""

import subprocess
import sys
from importlib.resources import files

import instrument_plugins.data as data
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import Table

from instrument.errors import InputError
from instrument.units import direction
from instrument.written import icrs_degrees


def spellings(count):
    """Directions in every spelling that is read, with up to 13 digits."""
    rng = np.random.default_rng(11)

    def digits(most, long):
        return f"{rng.uniform(0, most):.{rng.integers(0, long)}f}"

    for k in range(count):
        hms = (f"{rng.integers(24):02d}h", f"{rng.integers(60)}m", f"{digits(59.4, 10)}s")
        dms = (f"{rng.choice(['', '+', '-'])}{rng.integers(90)}d", f"{rng.integers(60):02d}m", f"{digits(59.4, 10)}s")
        few = k % 3 + 1
        ra = f"{digits(359.4, 14)}deg" if k % 4 == 3 else "".join(hms[:few])
        dec = f"{rng.choice(['', '+', '-'])}{digits(89.4, 14)}d" if k % 5 == 4 else "".join(dms[: rng.integers(1, 4)])
        yield f"{ra} {dec}"


def test_directions_in_words_are_those_of_astropy_to_the_last_bit():
    for word in spellings(240):
        due = SkyCoord(word)  # one by one: of a list it takes other ways between units
        assert icrs_degrees(word) == (due.ra.deg, due.dec.deg), word
        assert direction(word) == (due.ra.rad, due.dec.rad), word


@pytest.mark.parametrize(
    "word",
    ["08:13:36 +48:13:03", "8.5h 3d", "-3d 4d", "361d 4d", "8h13m60s 3d", "8h 3d60m", "8h 90d0m1s", "8h 3d 4m", "٨h 3d",
     "8h13m36s+3d", "24h 3d", "8h13m5.1e1s 3d", "8h3d", "", "8h 3°"],
)  # fmt: skip
def test_all_other_spellings_are_astropys(word):
    assert icrs_degrees(word) is None


def test_what_is_no_direction_is_refused_as_before():
    with pytest.raises(InputError, match="'8h 91d' is not a direction; write it like"):
        direction("8h 91d")
    assert direction("24h 3d") == direction(SkyCoord("24h 3d"))


@pytest.mark.parametrize("name", sorted(p.name for p in files(data).iterdir() if p.name.endswith("csv")))
def test_data_files_are_those_that_astropy_reads(name):
    kind = "ascii.ecsv" if name.endswith(".ecsv") else "ascii.csv"
    due, found = Table.read(str(files(data) / name), format=kind, comment="#"), data.table(name)
    assert list(found.columns) == due.colnames and len(found) == len(due)
    for column in due.colnames:
        assert found[column].dtype.kind == due[column].dtype.kind
        assert np.array_equal(found[column], due[column])
    assert kind == "ascii.csv" or found.meta == dict(due.meta)
    assert list(found[[2, 0]][column]) == [due[column][2], due[column][0]]


LAZY = """
import sys, pickle
from instrument import phasor
assert "numba" not in sys.modules
import numpy as np
waves, offsets = np.ones((1, 3, 2)), np.ones((1, 4, 3))
from concurrent.futures import ThreadPoolExecutor
with ThreadPoolExecutor(4) as pool:
    found = list(pool.map(lambda _: phasor.array_factor(waves, offsets), range(8)))
assert all(np.allclose(one, phasor.array_factor_reference(waves, offsets)) for one in found)
assert "numba" in sys.modules and phasor._array_factor.signatures and phasor._array_factor.__name__ == "_array_factor"
"""


def test_numba_is_loaded_by_the_first_loop_that_is_called_in_whichever_thread():
    subprocess.run([sys.executable, "-c", LAZY], check=True, timeout=120)
