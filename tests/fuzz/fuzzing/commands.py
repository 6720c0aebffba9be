"""Cases of the command line: options of `analyze`, sizes that no machine has, words and names of every odd kind."""

import os
import random
from collections.abc import Iterator

from fuzzing import seeds
from fuzzing.files import Seeds, both
from fuzzing.harness import Case
from fuzzing.settings import written

OPTIONS = {  # values parted by |; None: an option without one
    "--products": "faraday|faraday,faraday|x||,|FARADAY|window|spherical,window|faraday,",
    "--stokes": "Q,U|I|X||I,Q,U,V|I,Q,U,V,I|q|iquv|I;Q|I,I,I,I",
    "--unit": "K|Jy/beam|jy||Jy/pixel|mK|../x",
    "--beam": "3 arcmin|-3 arcmin|0 deg|nan deg|inf deg|4 arcmin,3 arcmin,30 deg|4|1,2,3,4||3 Jy|[1,2] deg|4 "
    "arcmin,3 arcmin,nan deg",
    "--depths": "-5,5,1|5,-5,1|0,0,0|nan,1,1|-5,5,-1|-5,5,1e-9|-1e308,1e308,1|1,2|a,b,c|"
    "|-5,5,inf|0,1e-320,1e-324|1,1,1|,,|-5,5,1e308|1e17,1e17,1",
    "--uv-range": "30,800|800,30|-1,5|nan,1|0,inf|1|1,2,3|x||1e308,1e309|0,0",
    "--taper": "hann|none|x||None|blackman-harris-7",
    "--taper-space": "hann|none|x|",
    "--infill": "300 ns|-1 s|0 s|nan s|inf s|1e30 s|3|x|1e-30 s|5 m",
    "--remove": "gmca|pca|polynomial|gpr|sparse|x||none|os",
    "--remover": "components=4|components=-1|components=1000000|components=nan|x=1|"
    'components|=|components=|a.b=1|components="x"|components.x=1|degree=3|degree=1000|kind="os:x"',
    "--signal": "21cmFAST_2011_z9.50|x||../../etc/passwd",
    "--noise": "c.fits|b.fits|nope.fits|/etc/passwd||.|/dev/null",
    "--wedge": "2 deg|-2 deg|0 deg|nan deg|91 deg|1e9 deg|x|3",
    "--redshift": "9|-1|nan|inf|0|1e308|x|-0.999999|1e-300|1100",
    "--frequencies": "f.txt|nope.txt|/dev/zero||.|c.fits",
    "--flag-channels": "3|3,7-9|7-3|-1|x||0-1e9|99999999999999999999|0-7",
    "--band": "150 MHz,151 MHz|151 MHz,150 MHz|nan MHz,1 MHz|150,151|x||1 m,2 m|0 Hz,inf Hz",
    "--psf": "c.fits|nope.fits||/dev/zero",
    "--weights": "f.txt|nope.txt|/dev/zero|",
    "--common-beam": "3 arcmin|-1 deg|nan deg|x|1e9 deg",
    "--clean": None,
    "--cubes": None,
    "--bogus": "1",
    "--workers": "2",
    "--out": "o||.|..|/|c.fits|o/p/q|/proc/x|/dev/null|a\nb|-|o/|./o|" + "x" * 300,
}
DEEP = [
    name
    for name in OPTIONS
    if name in ("--products", "--remove", "--infill", "--noise", "--signal", "--wedge", "--redshift")
]


def options(rng: random.Random, made: Seeds) -> Iterator[Case]:
    """One to three options of `analyze` with any of their values."""
    while True:
        names = rng.sample(list(OPTIONS), rng.choice([1, 1, 2, 3]))
        pairs = [(name, OPTIONS[name] and rng.choice(OPTIONS[name].split("|"))) for name in names]
        if "--remover" in names and "--remove" not in names:
            pairs.append(("--remove", rng.choice(["gmca", "pca", "polynomial", "gpr"])))
        argv = ["analyze", rng.choice(["c.fits", "c.fits", "b.fits"])]
        for name, value in pairs:
            argv += [name] if value is None else rng.choice([[name, value], [f"{name}={value}"]])
        given = [name for name, _ in pairs]
        if not any(name in given for name in DEEP):
            argv += ["--products", "spectrum-2d" if {"--uv-range", "--taper-space"} & {*given} else "faraday"]
        argv += [] if "--depths" in given else ["--depths=-5,5,1"]
        out = next((value for name, value in pairs if name == "--out"), "o")
        argv += [] if "--out" in given else ["--out", "o"]
        # before the one of the case, so that what is in the folder is what has been put there
        setup = both(
            written("c.fits", made.cubes["cube"]), written("b.fits", made.cubes["beams"]), written("f.txt", _channels())
        )
        yield Case(
            "options", "options of analyze", setup, tuple(argv), out=os.path.normpath(out or "."), text=str(pairs)
        )


def _channels() -> str:
    return "".join(f"{150e6 + 2e5 * k:.0f}\n" for k in range(8))


HUGE = [
    *("observation.frequency.channels=1000000000", "observation.frequency.channels=100000000000000"),
    *('observation.duration="1e9 h"', 'observation.duration="1e15 yr"', 'observation.interval="1e-6 s"'),
    *("sky.count=1000000000", "sky.count=10000000", 'sky.radius="180 deg"', 'image={pixels=32768,pixel="0.1 arcsec"}'),
    "observation.frequencies=[" + ",".join(f'"{100 + k * 1e-5} MHz"' for k in range(20000)) + "]",
    *("tolerance=1e308", "tolerance=2.0", "seed=1e30", f"seed={2**128}", "analyze.every=1000000"),
    "instrument.stations=[" + ",".join(['"CS001HBA0"'] * 1000) + "]",
    *(f'name="{"n" * 300}"', 'name="a\\nb"', 'name=" "', 'name="con:aux"', 'name="-rf"', 'name="é"', 'name="$(id)"'),
    *(f'title="{"<" * 100000}"', 'sky={kind="grid",shape=[100000,100000]}', "sky.slope=1", "sky.slope=1e6"),
    *('sky={kind="grid",shape=[3000,3000],spacing="1 arcsec"}', "sky.count=30000"),
    *('observation.start="1000-01-01T00:00:00"', 'observation.start="2500-01-01T00:00:00"'),
    *('observation.start="99999-01-01T00:00:00"', 'observation.transit="2500-01-01"'),
    *('observation.phase_centre="0h 90d"', 'observation.phase_centre="M31"', 'observation.phase_centre="1 2"'),
    *('observation.frequency.centre="1e-3 Hz"', 'observation.frequency.centre="1e20 Hz"'),
    *('sky.flux_min="1e-300 Jy"', 'sky.flux_max="1e300 Jy"', 'noise.sefd="1e300 Jy"'),
    *("instrument.gain.rms=1e200", "instrument.gain.rms=1e300", "instrument.gain.rms=nan", "instrument.stations=[]"),
    *(
        'observation.frequency.width="1e12 Hz"',
        'observation.frequency.width="0 Hz"',
        "observation.frequency.channels=1e20",
    ),
]
WORDS = [
    *(["--tolerance", word] for word in ("nan", "inf", "-1", "2", "x", "")),
    *(["--memory", word] for word in ("-1GB", "nan GB", "inf GB", "1 B", "8", "[1,2] GB", "", "1e400 GB", "8 Jy")),
    *(["--workers", word] for word in ("1000000000", "0", "-1", "1e3", "100000", "", "nan")),
    *(["--engine", word] for word in ("", "x", "../x", "direct")),
    *(["--set", word] for word in ("", "=", "a", "sky..count=1", "\udcff=1", 'title="\udcff"', 'name="\udcff"')),
    *(["--set", word] for word in ('title="""a\nb"""', "sky.count=3\nx=5", "value=1", "sky=1", "instrument=[]")),
    *(["--set", word] for word in ('observation="x"', 'title="\x7f"', 'title="\x1b[31m"', f"seed={'9' * 5000}")),
    *(["--out", word] for word in ("", "/", "/proc/1/x", "/dev/full", "x" * 300, "a/" * 2500, "s.toml", "s.toml/x")),
    *(["--out", word] for word in (".", "..", "o/..", "~nouser/x", "a\x1bb")),
]
SCENE_NAMES = [
    *("", "nope", ".", "/", "..", "x" * 5000, "/proc/self/mem", "/proc/self/environ", "3c196.toml", "../../etc/passwd"),
    *(
        "s.toml/",
        "mock-grid/../x",
        "\udcff",
        "\udcff.toml",
        "s.toml\n",
        "-x",
        "/dev/stdin",
        "~nouser/x.toml",
        "\x1b[2J",
    ),
]
CATALOGUE_NAMES = [
    *("", ".", "/", "~", "~nouser/x", "a\\u0000b", "/dev/zero", "/dev/stdin", "/proc/self/environ", "/etc/shadow"),
    *("x" * 5000, "/proc/kcore", "/proc/self/mem", "\\u007f", "../data/mock_150mhz.csv", "http://example.com/x.csv"),
    *("s.toml", "\\u001b[31m.csv"),
]
VERBS = [
    *(["analyze"], ["analyze", ""], ["run"], [], ["x"], ["plan", "s.toml", "s.toml"], ["analyze", "x" * 5000]),
    *(["analyze", "/"], ["analyze", "/etc/passwd"], ["doctor", "x"], ["plugins", "--x"], ["plugins", "os"]),
    *(["paper", "x"], ["paper", "ixr", ""], ["paper", "--seed", "x"], ["paper", "ixr", "--seed"]),
    *(["plugins", "dipole"], ["scenes", "x"], ["-"], ["--"], ["\x1b[31m"], ["plan", "mock-grid", "--set"]),
]


def odd_words() -> Iterator[Case]:
    """Sizes that no machine has, and odd words and names at every place of the command line."""
    plain = written("s.toml", seeds.SCENE)
    for setting in HUGE:
        for head in (("plan", "s.toml"), ("run", "s.toml", "--out", "o")):
            yield Case("huge", "sizes", plain, (*head, "--set", setting), text=setting[:80])
    for words in WORDS:
        out = ["--out", "o"] if words[0] != "--out" else []
        wrote = os.path.normpath(words[1]) if words[0] == "--out" and words[1] else "o"
        if wrote.startswith("a/a"):
            wrote = "a"
        yield Case(
            "words", "words and names", plain, ("run", "s.toml", *words, *out), out=wrote, text=ascii(words)[:80]
        )
        if words[0] != "--out":
            yield Case("words", "words and names", plain, ("plan", "s.toml", *words), text=ascii(words)[:80])
    for name in SCENE_NAMES:
        yield Case("scene name", "words and names", plain, ("plan", name), text=ascii(name)[:60])
    for name in CATALOGUE_NAMES:
        scene = written("s.toml", seeds.CATALOGUE.replace("PATH", name))
        yield Case("catalogue name", "words and names", scene, ("plan", "s.toml"), text=name[:60])
    for words in VERBS:
        yield Case("verb", "words and names", plain, tuple(words), text=ascii(words)[:60])
