"""The verb `analyze`: its words on the command line, and what they become."""

from __future__ import annotations

import argparse
from typing import Any

from instrument.errors import InputError
from instrument.terminal import DONE, FELL_SHORT, show


def add_analyze(verb: argparse.ArgumentParser) -> None:
    """Its words on the command line."""
    verb.add_argument("files", metavar="CUBE.fits", nargs="+", help="FITS cubes, together or one for each Stokes")
    verb.add_argument(
        "--products", metavar="A,B", help="faraday, spectrum-2d, cylindrical, spherical, window (default: all possible)"
    )
    verb.add_argument("--stokes", metavar="Q,U", help="what the planes of the files are, where they do not say it")
    verb.add_argument("--unit", help="Jy/beam, Jy/pixel or K, where the files do not say it")
    verb.add_argument(
        "--beam", metavar="SIZE", help="beam where the files name none: '3 arcmin', or major, minor, angle"
    )
    verb.add_argument(
        "--frequencies", metavar="FILE", help="of the channels, in Hz, one a line, where no header has them"
    )
    verb.add_argument("--psf", metavar="PSF.fits", help="images of the PSF of the channels, or one for all")
    verb.add_argument("--flag-channels", metavar="3,7-9", help="leave these channels out, counted from 0")
    verb.add_argument("--band", metavar="A,B", help="take the channels in it, e.g. '134 MHz,166 MHz'")
    verb.add_argument(
        "--common-beam", metavar="SIZE", nargs="?", const="smallest", help="convolve all channels to one beam"
    )
    verb.add_argument("--depths", metavar="A,B[,STEP]", help="Faraday depths in rad/m2 (default: those of the band)")
    verb.add_argument("--weights", metavar="FILE", help="of the channels in Faraday depth, one a line, e.g. 1/sigma^2")
    verb.add_argument("--clean", action="store_true", help="RM-CLEAN down to 5 sigma before peaks are looked for")
    verb.add_argument("--uv-range", metavar="A,B", help="baselines of the spectra, wavelengths, e.g. 30,800")
    verb.add_argument("--taper", help="along frequency: blackman-harris (default), blackman-harris-7, hann, none")
    verb.add_argument("--taper-space", help="over the images: hann (default), blackman-harris, none")
    verb.add_argument("--infill", metavar="DELAY", help="fill missing channels in from delays below it, e.g. '300 ns'")
    verb.add_argument("--remove", metavar="NAME", help="foreground remover: gmca, pca, polynomial, ...")
    verb.add_argument(
        "--remover", action="append", default=[], metavar="KEY=VALUE", help="its setting, e.g. components=4"
    )
    verb.add_argument("--signal", metavar="MODEL", help="21-cm model of the window (default: 21cmFAST_2011_z9.50)")
    verb.add_argument("--noise", metavar="NOISE.fits", help="cube of noise alone, added to the leakage in the window")
    verb.add_argument(
        "--wedge", metavar="ANGLE", help="from the phase centre: below its line no bin counts, e.g. '2 deg'"
    )
    verb.add_argument("--redshift", type=float, help="of the whole band (default: of its middle)")
    verb.add_argument("--cubes", action="store_true", help="write the Faraday cube and the residual too")


def analyze(given: argparse.Namespace) -> int:
    """Read, analyze and write; the exit status."""
    import shlex

    from instrument.pipeline.analyze_files import Reading, analyze_files
    from instrument.pipeline.scene_text import override
    from instrument.pipeline.stages.cube import CubeAnalysis

    def listed(name: str) -> Any:
        text = getattr(given, name)
        try:
            return None if text is None else tuple(float(part) for part in text.split(","))
        except ValueError:
            raise InputError(f"--{name.replace('_', '-')} {text}: numbers with commas between, please") from None

    for setting in given.remover:
        if "=" not in setting:
            raise InputError(f"--remover {setting}: write it like --remover components=4")
    if given.depths is not None and given.depths.count(",") not in (1, 2):
        raise InputError(f"--depths {given.depths}: give the first, the last and the step, as -50,50,0.25")
    fields: dict[str, Any] = {
        "products": None if given.products is None else tuple(p.strip() for p in given.products.split(",")),
        "depths": listed("depths"),
        "uv_range": listed("uv_range"),
        **{name: getattr(given, name) for name in ("infill", "remove", "signal", "wedge", "redshift")},
    }
    fields = {name: value for name, value in fields.items() if value is not None}
    for name in ("taper", "taper_space"):
        if (text := getattr(given, name)) is not None:
            fields[name] = None if text == "none" else text
    settings = CubeAnalysis(remover=override({}, given.remover), cubes=given.cubes, clean=given.clean, **fields)
    names = ("stokes", "unit", "beam", "frequencies", "psf", "flag_channels", "band", "common_beam", "weights", "noise")
    reading = Reading(**{name: getattr(given, name) for name in names})
    command = shlex.join(["instrument", *given.words])
    result = analyze_files(given.files, settings, reading, given.out, command, show, given.force)
    return DONE if result.passed else FELL_SHORT
