"""Hostile Measurement Sets under the verbs: done, or refused in one line with the set and its folder as they were.

The default run takes a few; `long` a hundred, `--fuzz-seed` another hundred.
"""

import os
import random
import shutil

import numpy as np
import pytest
from fuzzing import mutations
from fuzzing.harness import CPU_S, Case, _whole

arrow = pytest.importorskip("arcae.lib.arrow_tables")
SOME, MANY = 6, 100
ADDRESSES = 8e9  # the library of sets takes more of them than it uses
SCENE = """name = "night"
[instrument]
telescope = "lofar-hba"
beam = "none"
[sky]
kind = "grid"
shape = [1, 2]
spacing = "1 deg"
flux = "5 Jy"
[calibrate]
kind = "selfcal"
[image]
pixels = 32
pixel = "8 arcmin"
uv_range = [0, 200]
"""
OBSERVED = """
[observation]
phase_centre = "08h13m36.0s +48d13m03s"
transit = "2012-12-07"
duration = "40 s"
interval = "10 s"
frequency = { centre = "150 MHz", channel_width = "0.2 MHz", channels = 3 }
[into]
set = "a.MS"
"""
VERBS = ("predict", "calibrate", "image", "subtract")
INTO = (["DATA", "--force"], ["UVW", "--force"], ["x y"], ["b.MS"], [""])
WORDS = (
    *(["--into", *words] for words in INTO),
    *(["--column", "FLAG"], ["--column", "NONE"], ["--window", "1"], ["--window", "-1"], ["--field", "9"]),
    *(["--set", words] for words in ("data.part=3", 'instrument.beam="full"', "data.window=1.5")),
    ["--memory", "1 MB"],
)
ODD = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e30, 1e-30, 1e300, 2.0**31)
MAIN = (
    *("DATA", "UVW", "TIME", "TIME_CENTROID", "INTERVAL", "ANTENNA1", "ANTENNA2", "DATA_DESC_ID", "FIELD_ID", "FLAG"),
    *("WEIGHT", "WEIGHT_SPECTRUM", "FLAG_ROW"),
)
BESIDE = {
    "SPECTRAL_WINDOW": ("CHAN_FREQ", "CHAN_WIDTH", "MEAS_FREQ_REF"), "ANTENNA": ("POSITION", "NAME"),
    "FIELD": ("PHASE_DIR", "DELAY_DIR"), "POLARIZATION": ("CORR_TYPE",),
    "DATA_DESCRIPTION": ("SPECTRAL_WINDOW_ID", "POLARIZATION_ID"), "OBSERVATION": ("TELESCOPE_NAME",),
    "LOFAR_ANTENNA_FIELD": ("COORDINATE_AXES", "ANTENNA_ID"),
}  # fmt: skip


@pytest.fixture(scope="module")
def seed(zygote, tmp_path_factory):
    """A folder with a healthy set, which the verbs take."""
    folder = tmp_path_factory.mktemp("seed")
    stations = 'stations = ["CS001HBA0", "CS002HBA1", "CS003HBA0", "RS106HBA"]\nbeam ='
    (folder / "new.toml").write_text(SCENE[: SCENE.index("[calibrate]")].replace("beam =", stations) + OBSERVED)
    words = ("run", "new.toml", "--out", "o")
    answer = zygote.ask(Case("new", "sets", lambda _: None, words, extra={"wall_s": 300}), folder, 100)
    assert answer["status"] == 0, answer["said"]
    shutil.rmtree(folder / "o")
    (folder / "s.toml").write_text(SCENE)
    return folder


def one_value(rng, path):
    """A value, a row or the whole of a column."""
    sub = rng.choice(["", "", *BESIDE])
    name = rng.choice(BESIDE[sub] if sub else MAIN)
    with arrow.Table.from_filename(f"{path}::{sub}" if sub else str(path), readonly=False) as table:
        values = np.array(table.getcol(name))
        odd = rng.choice(ODD)
        how = rng.randrange(4)
        if values.dtype.kind in "OU":
            values[rng.randrange(len(values))] = rng.choice(["", "x" * 300, "\x1b[31m", "é"])
        elif values.dtype.kind == "b":
            values = ~values if how else np.ones_like(values)
        else:
            with np.errstate(all="ignore"):
                odd = (
                    odd
                    if values.dtype.kind in "fc"
                    else np.array(rng.choice([-1, 0, 1, 7, 2**31 - 1])).astype(values.dtype)
                )
                flat = values.reshape(-1)
                if how == 0:
                    flat[rng.randrange(flat.size)] = odd
                elif how == 1:
                    values[rng.randrange(len(values))] = odd
                elif how == 2:
                    values[...] = odd
                else:
                    values[...] = values[rng.sample(range(len(values)), len(values))]
        table.putcol(name, values)
    return f"{sub}.{name}"


def of_files(rng, path):
    """A file or subtable that is gone, cut, changed or empty.

    Bits of descriptions (table.dat) stay: with some of them changed casacore ends the process.
    """
    found = sorted(p for p in path.rglob("*") if p.name != "table.lock")
    file = rng.choice(found)
    how = rng.choice([0, 1, 3] if file.name == "table.dat" else [0, 1, 2, 3])
    if file.is_dir():
        shutil.rmtree(file)
    elif how == 0:
        file.unlink()
    elif how == 1:
        file.write_bytes(file.read_bytes()[: rng.randrange(1 + file.stat().st_size)])
    elif how == 2 and file.stat().st_size:
        file.write_bytes(mutations.flipped(rng, file.read_bytes()))
    else:
        file.write_bytes(b"")
    return f"{file.relative_to(path)} {how}"


def state(folder):
    """Bytes of every file but locks."""
    files = (p for p in folder.rglob("*") if p.is_file() and p.name != "table.lock")
    return {str(p.relative_to(folder)): p.read_bytes() for p in files}


def fault(zygote, seed, rng):
    """What is wrong with what came of one case, or nothing."""
    folder = zygote.folder / "set"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(seed, folder)
    told = rng.choice([one_value, one_value, one_value, of_files])(rng, folder / "a.MS")
    verb, more = rng.choice(VERBS), rng.choice(WORDS) if rng.random() < 0.3 else []
    words = (verb, "s.toml", "--data", "a.MS", "--no-verify", "--out", "o", *more)
    before = state(folder)
    extra = {"more": ADDRESSES}
    answer = zygote.ask(Case("set", "sets", lambda _: None, words, extra=extra), folder, 2 * CPU_S)
    said = answer["said"].strip().splitlines()
    complaints = [line for line in said if not line.startswith("instrument: warning: ")]
    after = state(folder)
    what = (
        f"{told}: {' '.join(words)}: {answer['status']} {answer['signal']} {answer['killed']} {answer['said'][-600:]}"
    )
    if answer["killed"] or answer["signal"] or any(s in answer["said"] for s in ("Traceback", "unexpected ", "\x1b")):
        return f"FAULT {what}"
    if answer["status"] in (0, 3):
        done = _whole(folder / "o")
        return "" if done == "done" and not complaints else f"{done} {what}"
    if answer["status"] != 2 or len(complaints) != 1:
        return f"FAULT not refused in one line: {what}"
    left = sorted(set(after) - set(before)) or sorted(k for k in before if after.get(k) != before[k])
    left += [name for name in os.listdir(folder) if name.startswith(".")]
    return f"FAULT left or changed {left[:3]}: {what}" if left else ""


def faults(zygote, seed, count, number):
    rng = random.Random(number)
    return [wrong for wrong in (fault(zygote, seed, rng) for _ in range(count)) if wrong]


def test_a_few_hostile_sets_are_done_or_refused(zygote, seed):
    assert faults(zygote, seed, SOME, 14) == []


@pytest.mark.long
def test_a_hundred_hostile_sets_are_done_or_refused(zygote, seed, request):
    assert faults(zygote, seed, MANY, request.config.getoption("--fuzz-seed", default=None) or 1) == []
