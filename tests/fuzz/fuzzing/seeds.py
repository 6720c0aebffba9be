"""Healthy input of every kind, small: what the mutations start from."""

from pathlib import Path

import numpy as np

SCENE = """name = "fuzz"
title = "A small scene"
seed = 7

[instrument]
telescope = "lofar-hba"
stations = ["CS001HBA0", "CS002HBA1", "RS106HBA"]
gain = { rms = 1e-3 }

[observation]
phase_centre = "08h13m36.0s +48d13m03s"
transit = "2012-12-07"
duration = "40 s"
interval = "10 s"
frequency = { centre = "150 MHz", width = "0.19 MHz", channels = 1 }

[sky]
kind = "random"
count = 3
radius = "3 deg"
flux_min = "0.5 Jy"

[noise]
sefd = "2820 Jy"

[correct]
beam = "centre"

[analyze]
products = ["leakage"]
"""
IMAGES = SCENE.replace(
    '[analyze]\nproducts = ["leakage"]\n',
    '[image]\npixels = 16\npixel = "30 arcmin"\nuv_range = [10, 80000]\n\n'
    '[analyze]\nproducts = ["leakage", "spectrum-2d"]\n',
)
CUBES = IMAGES.replace("channels = 1", "channels = 4").replace(
    'products = ["leakage", "spectrum-2d"]\n',
    'products = []\n\n[analyze.cube]\nproducts = ["faraday", "cylindrical"]\ndepths = [-5, 5, 1]\nbins = 4\n',
)
WHOLE = CUBES.replace('["faraday", "cylindrical"]', "[]")  # all that can be drawn of it
_PERFECT = SCENE.replace('[correct]\nbeam = "centre"\n\n', "")
SELFCAL = _PERFECT.replace("[noise]", '[calibrate]\nkind = "selfcal"\n\n[noise]').replace(
    "gain = { rms = 1e-3 }", 'beam = "none"\ngain = { rms = 1e-3 }\nfeed = { rms = 1e-3 }'
)
MANY = (
    _PERFECT.replace(
        "[noise]",
        '[calibrate]\nkind = "many-directions"\nclusters = 2\nrms = 0.1\nperiod = "1 h"\ninterval = "20 s"\n\n[noise]',
    )
    .replace("gain = { rms = 1e-3 }", 'beam = "none"')
    .replace('"RS106HBA"]', '"RS106HBA", "CS003HBA0", "CS004HBA0", "CS005HBA0"]')
)
CATALOGUE = SCENE.replace(
    'kind = "random"\ncount = 3\nradius = "3 deg"\nflux_min = "0.5 Jy"', 'kind = "catalogue"\npath = "PATH"'
)
SCENES = {"plain": SCENE, "images": IMAGES, "cubes": CUBES, "selfcal": SELFCAL, "many": MANY}

BBS = (
    "FORMAT = Name, Type, Patch, Ra, Dec, I, Q, U, V, ReferenceFrequency='150e6', SpectralIndex='[0.0]', "
    "RotationMeasure, MajorAxis, MinorAxis, Orientation, OrientationIsAbsolute\n\n, , P1, 08:13:36.0, +48.13.03.0\n"
    + "".join(
        f"s{k}, GAUSSIAN, P1, 08:13:{36 + k}.0, +48.1{k}.03.0, {k + 1}.0, 0.0, 0.0, 0.0, 150e6, [-0.7, 0.01], "
        f"{'1.0' if k == 0 else ''}, 30, 20, 10, true\n"
        for k in range(5)
    )
)
CSV = "name,ra_deg,dec_deg,i_jy,q_jy,spectral_index,ref_freq_mhz,rm,major_arcsec,minor_arcsec,angle_deg\n" + "".join(
    f"s{k},{123.4 + 0.3 * k},{48.2 + 0.2 * k},{k + 1},0.0,-0.7,150,1.0,30,20,10\n" for k in range(5)
)


PROGRAMS = {  # other programs' text, by the extension of its seed
    "osm": "".join(
        f"{123 + 0.3 * k}, {48.2 + 0.2 * k}, {k + 1}, 0, 0, 0, 150e6, -0.7, 1, 30, 20, 10\n" for k in range(5)
    ),
    "sagecal": "".join(f"P{k} 8 13 {36 + k}.0 48 1{k} 3.0 {k + 1} 0 0 0 -0.7 .01 0 0 0 0 0 150e6\n" for k in range(5)),
    "tigger": "#format: name ra_h ra_m ra_s dec_d dec_m dec_s i q u v spi rm emaj_s emin_s pa_d freq0 tags...\n"
    + "".join(f"T{k} 8 13 {36 + k}.0 48 1{k} 3.0 {k + 1} 0 0 0 -0.7 1 30 20 10 150e6 +a\n" for k in range(5)),
    "ao": "skymodel fileformat 1.1\n"
    + "".join(
        f'source {{\n  name "A {k}"\n  component {{\n    type gaussian\n    position 8h13m{36 + k}.0s 48d1{k}m3.0s\n'
        f"    shape 30 20 10\n    sed {{\n      frequency 150 MHz\n      fluxdensity Jy {k + 1} 0 0 0\n"
        "      spectral-index { -0.7 0.0 }\n    }\n  }\n}\n"
        for k in range(5)
    ),
}


def catalogues(folder: Path) -> dict[str, bytes]:
    """A catalogue of five sources in every format, by extension."""
    from astropy import units as u
    from astropy.coordinates import SkyCoord
    from astropy.table import Table

    from instrument import PointSky

    k = np.arange(5)
    table = Table(
        {
            "name": [f"s{n}" for n in k],
            "ra": (123.4 + 0.3 * k) * u.deg,
            "dec": (48.2 + 0.2 * k) * u.deg,
            "i": (1.0 + k) * u.Jy,
            "q": np.zeros(5) * u.Jy,
            "spectral_index": np.full(5, -0.7),
            "ref_freq": np.full(5, 150.0) * u.MHz,
            "rotation_measure": np.ones(5) * u.rad / u.m**2,
            "major": np.full(5, 30.0) * u.arcsec,
            "minor": np.full(5, 20.0) * u.arcsec,
            "angle": np.full(5, 10.0) * u.deg,
        }
    )
    found = {"skymodel": BBS.encode(), "csv": CSV.encode()} | {ext: text.encode() for ext, text in PROGRAMS.items()}
    for ext, form in (("ecsv", "ascii.ecsv"), ("fits", "fits"), ("vot", "votable")):
        table.write(folder / f"seed.{ext}", format=form, overwrite=True)
        found[ext] = (folder / f"seed.{ext}").read_bytes()
    places = SkyCoord(123.4 + 0.3 * k, 48.2 + 0.2 * k, unit="deg")
    PointSky.at(places, 1.0 + k, 150 * u.MHz).write(folder / "seed.skyh5", overwrite=True)
    return found | {"skyh5": (folder / "seed.skyh5").read_bytes()}


def cubes(folder: Path) -> dict[str, bytes]:
    """FITS cubes of 8 channels of 16 x 16 pixels: with one beam, and with a table of beams."""
    from astropy.io import fits

    channels, pixels = 8, 16
    data = np.random.default_rng(0).normal(size=(channels, 4, pixels, pixels)).astype(np.float32)
    image = fits.PrimaryHDU(data)
    middle = pixels // 2 + 1.0
    axes = (
        {"CTYPE": "RA---SIN", "CRVAL": 123.4, "CDELT": -0.5 / 60, "CRPIX": middle, "CUNIT": "deg"},
        {"CTYPE": "DEC--SIN", "CRVAL": 48.2, "CDELT": 0.5 / 60, "CRPIX": middle, "CUNIT": "deg"},
        {"CTYPE": "STOKES", "CRVAL": 1.0, "CDELT": 1.0, "CRPIX": 1.0},
        {"CTYPE": "FREQ", "CRVAL": 150e6, "CDELT": 2e5, "CRPIX": 1.0, "CUNIT": "Hz"},
    )
    for number, axis in enumerate(axes, 1):
        for key, value in axis.items():
            image.header[f"{key}{number}"] = value
    image.header.update({"BUNIT": "Jy/beam", "BMAJ": 0.05, "BMIN": 0.05, "BPA": 0.0, "OBJECT": "fuzz"})
    columns = [fits.Column("FREQ", "D", "Hz", array=150e6 + 2e5 * np.arange(channels))]
    columns += [fits.Column(name, "D", "deg", array=np.full(channels, 0.05)) for name in ("BMAJ", "BMIN", "BPA")]
    image.writeto(folder / "seed_cube.fits", overwrite=True)
    table = fits.BinTableHDU.from_columns(columns, name="BEAMS")
    fits.HDUList([image, table]).writeto(folder / "seed_beams.fits", overwrite=True)
    return {name: (folder / f"seed_{name}.fits").read_bytes() for name in ("cube", "beams")}


def solutions(folder: Path) -> bytes:
    """An h5parm of 3 times, 2 channels and 5 stations."""
    from instrument import JonesTable
    from instrument.files.solutions import write_h5parm

    rng = np.random.default_rng(1)
    shape = (3, 2, 5, 2, 2)
    values = np.eye(2) + 0.3 * (rng.normal(size=shape) + 1j * rng.normal(size=shape))
    table = JonesTable(
        values=values,
        slots_s=4.86e9 + 10.0 * np.arange(3),
        freq_hz=np.array([149e6, 150e6]),
        stations=("CS001HBA0", "CS003HBA1", "RS106HBA", "RS508HBA", "abc"),
    )
    path = folder / "seed.h5"
    path.unlink(missing_ok=True)
    write_h5parm(path, table)
    return path.read_bytes()
