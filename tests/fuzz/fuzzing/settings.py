"""Cases of scenes: the text mutated, any key set to any value, and keys set to values that look right."""

import random
from collections.abc import Iterator
from pathlib import Path

from fuzzing import mutations, seeds
from fuzzing.harness import Case

VALUES = [
    *("nan", "inf", "-inf", "-1", "0", "1e308", "-1e308", "1e-320", "9223372036854775807", "-9223372036854775808"),
    *("1" + "0" * 400, "true", "[]", "{}", '""', '"nan Jy"', '"inf deg"', '"-5 Jy"', '"1e400 Hz"', '"0 s"', '"-3 deg"'),
    *('"5 parsec"', '"5"', '"Jy"', '"1 Jy/deg"', '"1e99 MHz"', '"[1,2] Jy"', '"\\u0000"', '"\\u007f"', '"\\u001b[31m"'),
    *('"<script>alert(1)</script>"', '"../../../etc/passwd"', '"~nouser/x"', "[nan, 1]", "[1, nan]", "[5, 1]"),
    *("[1,2,3,4]", "{a=1}", '"0x10"', "1979-05-27", '"9999-99-99"', '"2012-12-07T22:00:00Z"', '"1e5000"', '["x"]'),
    *("[[1]]", '"5 deg deg"', '"1,5 deg"', '"５ deg"', '"5 d\\u00e9g"', '"1e3 kJy"', "[1e308,1e309]", "1e20", "2.5"),
    *('{component="os:path"}', '{kind="os:path"}', '"os"', '"$\\\\frac{$"', "-0.0", "1_000", '"\\ud800"', "false"),
]
KEYS = """
seed tolerance engine name title instrument instrument.telescope instrument.stations instrument.element
instrument.gain instrument.gain.rms instrument.gain.seed instrument.feed.rms instrument.beam instrument.tiles
instrument.tile_pointing instrument.beam_pointing instrument.reference_frequency instrument.phase
observation observation.phase_centre observation.start observation.transit observation.duration observation.interval
observation.frequency observation.frequency.centre observation.frequency.width observation.frequency.channels
observation.frequencies observation.channel_width sky sky.kind sky.count sky.radius sky.flux_min sky.flux_max
sky.slope sky.polarization sky.circular sky.spectral_index sky.scatter sky.frequency sky.seed sky.path noise.sefd
noise correct.beam correct image image.pixels image.pixel image.uv_range image.weighting image.robust image.accuracy
analyze analyze.products analyze.uv_range analyze.every analyze.cube analyze.cube.products analyze.cube.depths
analyze.cube.bins analyze.cube.infill analyze.cube.redshift analyze.cube.signal analyze.cube.wedge
analyze.cube.removed analyze.cube.remove analyze.cube.remover analyze.cube.uv_range analyze.cube.taper calibrate
calibrate.kind calibrate.tolerance calibrate.clusters calibrate.rms calibrate.period calibrate.interval
calibrate.models component kind observation.component image.kind analyze.kind
"""
DEEP = [
    "a = " + "[" * 3000 + "]" * 3000,
    "a." + ".".join("b" * 2000) + " = 1",
    "x = " + "{a=" * 1500 + "1" + "}" * 1500,
    "frequencies = [" + ",".join(["1"] * 300000) + "]",
    'title = "' + "x" * 1000000 + '"',
    "[sky." + "a." * 3000 + "b]",
    "x = " + "9" * 10000,
    '"' + "k" * 100000 + '" = 1',
]
UNITS = [b"rad", b"mJy", b"THz", b"km", b"", b'yr"', b"K", b"furlong", b"%", b"deg2", b"Hz-1", b"dB", b"mag", b"Jy Jy"]


def written(name: str, content: str | bytes):
    """A setup that writes one file."""

    def setup(folder: Path) -> None:
        raw = content if isinstance(content, bytes) else content.encode(errors="surrogatepass")
        (folder / name).write_bytes(raw)

    return setup


def verb(rng: random.Random) -> tuple[str, ...]:
    """Plan, or run with its folder; runs are mostly not verified, which costs most of a small one."""
    if rng.random() < 0.4:
        return ("plan", "s.toml")
    return ("run", "s.toml", "--out", "o", *(("--no-verify",) if rng.random() < 0.8 else ()))


def scenes(rng: random.Random) -> Iterator[Case]:
    """Scene files with their text mutated."""
    while True:
        base = rng.choice(list(seeds.SCENES.values())).encode()
        how = rng.choice(["text", "text", "number", "unit", "lines", "deep"])
        if how == "unit":
            made = base.replace(rng.choice([b"deg", b"Jy", b"MHz", b's"', b"arcmin"]), rng.choice(UNITS), 1)
        elif how == "deep":
            extra = rng.choice(DEEP).encode()
            made = rng.choice([extra + b"\n" + base, base + b"\n" + extra])
        else:
            made = getattr(mutations, how)(rng, base)
        yield Case(f"scene {how}", "scene files", written("s.toml", made), verb(rng))


def sets(rng: random.Random) -> Iterator[Case]:
    """Any key set to any value on the command line."""
    while True:
        key, value = rng.choice(KEYS.split()), rng.choice(VALUES)
        argv = (*verb(rng), "--set", f"{key}={value}")
        yield Case("set", "--set", written("s.toml", _with(rng, key)), argv, text=f"{key}={value[:60]}")


def plausible(rng: random.Random) -> Iterator[Case]:
    """One to three keys set to values of the right kind, of any size."""
    while True:
        base = rng.choice(list(seeds.SCENES.values()))
        keys = [k for k in PLAUSIBLE if f"[{k.rpartition('.')[0]}]" in base or "." not in k or k.startswith("instr")]
        pairs = [f"{k}={_plausible(rng, k)}" for k in rng.sample(keys, rng.choice([1, 1, 2, 3]))]
        argv = (*verb(rng), *(word for pair in pairs for word in ("--set", pair)))
        yield Case("plausible", "plausible settings", written("s.toml", base), argv, text="; ".join(pairs))


def _with(rng: random.Random, key: str) -> str:
    """A scene that has the table of a key."""
    if key.startswith("calibrate"):
        return rng.choice([seeds.SELFCAL, seeds.MANY])
    return seeds.CUBES if "cube" in key else seeds.IMAGES if key.startswith(("image", "analyze")) else seeds.SCENE


CHOICES = {
    "count": [0, 1, 2, 3, 5, 7, 15, 16, 17, 18, 64, 100, 1000, -1, 10**5, 2**31, 2**63],
    "direction": ["0h -90d", "0h 90d", "12h0m0s -60d", "0deg 0deg", "400d 20d", "8h +91d", "8 48", "-5h 20d"],
    "start": [
        *("2012-12-07", "1960-01-01T00:00:00", "2016-12-31T23:59:60", "2012-12-07T25:00:00"),
        *("0001-01-01", "9999-12-31T23:59:59", "2030-01-01T00:00:00", "2012-02-30", "2100-06-06T06:06:06"),
    ],
    "day": ["2012-12-07", "2012-13-07", "2012-12-07T12:00:00", "1800-01-01", "9999-12-31", "2050-05-05", "x"],
    "telescope": ["lofar-lba", "lofar-hba", "no"],
    "element": ["airy", "dipole", "gaussian", "hamaker"],
    "beam": ["none", "element", "array-factor", "full"],
    "sky": ["grid", "faraday", "mock-3c196", "catalogue", "random"],
    "weighting": ["natural", "uniform", "briggs"],
    "remover": ["gmca", "gpr", "pca", "polynomial", "ica", "faraday-filter"],
    "taper": ["hann", "none", "blackman-harris-7"],
    "signal": ["21cmFAST_2011_z9.50", "x"],
}
PLAUSIBLE = {
    **dict.fromkeys(("observation.duration", "observation.interval", "calibrate.period", "calibrate.interval"), "s"),
    **dict.fromkeys(("observation.frequency.centre", "observation.frequency.width", "sky.frequency"), "MHz"),
    **dict.fromkeys(("instrument.reference_frequency", "observation.channel_width"), "MHz"),
    **dict.fromkeys(("sky.radius", "analyze.cube.wedge"), "deg"),
    **dict.fromkeys(("sky.flux_min", "sky.flux_max", "noise.sefd"), "Jy"),
    **{"image.pixel": "arcmin", "analyze.cube.infill": "ns"},
    **dict.fromkeys(("seed", "tolerance", "instrument.gain.rms", "instrument.feed.rms", "sky.slope"), ""),
    **dict.fromkeys(("sky.polarization", "sky.circular", "sky.spectral_index", "sky.scatter", "image.robust"), ""),
    **dict.fromkeys(("image.accuracy", "analyze.cube.redshift", "analyze.cube.removed", "calibrate.rms"), ""),
    **dict.fromkeys(("observation.frequency.channels", "sky.count", "sky.seed", "image.pixels"), "count"),
    **dict.fromkeys(("analyze.every", "analyze.cube.bins", "calibrate.clusters", "calibrate.iterations"), "count"),
    **dict.fromkeys(("image.uv_range", "analyze.uv_range", "analyze.cube.uv_range"), "range"),
    **{"analyze.cube.depths": "depths", "sky.kind": "sky", "observation.start": "start", "observation.transit": "day"},
    **dict.fromkeys(("observation.phase_centre", "instrument.tile_pointing", "instrument.beam_pointing"), "direction"),
    **{"instrument.telescope": "telescope", "instrument.element": "element", "instrument.beam": "beam"},
    **{"image.weighting": "weighting", "analyze.cube.remove": "remover", "analyze.cube.taper": "taper"},
    "analyze.cube.signal": "signal",
}


def _size(rng: random.Random) -> float:
    return rng.choice([1, 1, 1, -1]) * 10 ** rng.uniform(*rng.choice([(-3, 3), (-1, 1), (-20, 20), (-300, 300)]))


def _plausible(rng: random.Random, key: str) -> str:
    kind = PLAUSIBLE[key]
    if kind in CHOICES:
        value = rng.choice(CHOICES[kind])
        return str(value) if isinstance(value, int) else f'"{value}"'
    if kind == "range":
        a, b = sorted(abs(_size(rng)) for _ in range(2))
        return rng.choice([f"[{a},{b}]", f"[0,{b}]", f"[{b},{a}]", f"[{a},{a}]", f"[{a},inf]", "[0,1e-9]"])
    if kind == "depths":
        a = _size(rng)
        return f"[{a},{a + abs(_size(rng))},{abs(_size(rng))}]"
    return f'"{_size(rng)} {kind}"' if kind else f"{_size(rng)}"
