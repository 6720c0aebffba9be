"""Beams for other programs: a station's as a UVBeam FITS file of pyuvdata, Mueller matrices as FITS images."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Literal

import numpy as np

from instrument.checked import checked
from instrument.errors import InputError
from instrument.files.uv_data import library, told
from instrument.jones.mean_mueller import mean_mueller
from instrument.jones.mueller import mueller
from instrument.memory import afford
from instrument.model import Instrument, State
from instrument.observe.directions import EarthFrame
from instrument.observe.grid import ImageGrid
from instrument.observe.layout import geodetic_axes
from instrument.observe.sampling import Sampling
from instrument.provenance import fits_cards, written_by
from instrument.units import Complex, Direction, Float, direction, instants, one_si, to_si
from instrument.whole_file import whole_file

ENDINGS = (".beamfits", ".fits", ".uvbeam")
CELLS = 2e6  # Jones matrices worked out at once: 128 MB


@checked
def write_uvbeam(
    path: str | os.PathLike[str],
    telescope: Instrument,
    time: Any,
    frequencies: Any,
    station: str | None = None,
    pointing: Any = None,
    step: Any = None,
    overwrite: bool = False,
) -> None:
    """Write the beam of one station, the first unless named, as pyuvdata's UVBeam FITS file (extra `uv`), E field.

    On every `step` (1 deg) of azimuth, from east through north, and zenith angle to 90 deg, about the geodetic zenith
    of the station at `time`, with the beam former at `pointing` (the zenith unless given). Basis vectors are along
    azimuth and zenith angle, feeds x and y are the two receptors of a chain, with the angles, below 180 deg, in which
    they respond at the zenith. Matrices are those of the chain, without errors of its receivers: they have the sign of
    time of the fringe, which is that of pyuvdata's visibilities too, exp(-i omega t). "Physical", with a bandpass of 1.
    Raises `InputError` for a `step` that does not divide 90 deg.
    """
    if Path(path).suffix.lower() not in ENDINGS:
        raise InputError(f"{path}: the name of a UVBeam file ends in {', '.join(ENDINGS)}")
    pyuvdata = library()
    width = np.deg2rad(1.0) if step is None else one_si(step, "rad", "step", above=0)
    count = round(np.pi / 2 / width)
    if not count or abs(np.pi / 2 / width - count) > 1e-6:
        raise InputError(f"step = {np.rad2deg(width):g} deg does not divide 90 deg: 1 deg does")
    freq = np.sort(np.atleast_1d(np.asarray(to_si(frequencies, "Hz", "frequencies", above=0), float)))
    layout, when = telescope.layout(), instants(time, "time")
    if len(when) != 1:
        raise InputError(f"time holds {len(when)} instants: a beam file is of one")
    which = 0 if station is None else layout.index(station)
    az = np.asarray(np.arange(4 * count) * (np.pi / 2 / count), float)
    za = az[: count + 1]
    afford(4 * 64.0 * len(freq) * len(za) * len(az), f"{path}: its grid", "take a larger step, or fewer frequencies")
    found = _towards(telescope, which, when, freq, _local(za, az), pointing)  # (F, S, 2 receptors, az and za)
    data = np.moveaxis(found.reshape(len(freq), len(za), len(az), 2, 2), (4, 3), (0, 1))
    with whole_file(path, overwrite) as partial, told(path):
        beam = pyuvdata.UVBeam.new(
            telescope_name=telescope.telescope_name or type(telescope).__name__, feed_name=layout.names[which],
            feed_version="1", model_name=type(telescope).__name__, model_version=str(written_by()["software"]),
            data_normalization="physical", freq_array=freq, feed_array=np.array(["x", "y"]),
            feed_angle=_feed_angles(data[:, :, 0, 0, 0]), mount_type="fixed" if pointing is None else "phased",
            axis1_array=az, axis2_array=za, data_array=np.ascontiguousarray(data),
            basis_vector_array=np.broadcast_to(np.eye(2)[:, :, None, None], (2, 2, len(za), len(az))).copy(),
            bandpass_array=np.ones(len(freq)), history=f"{written_by()['software']}, {written_by()['written']}. ",
        )  # fmt: skip
        beam.write_beamfits(str(partial), clobber=True)


def _local(za: Float, az: Float) -> Float:
    """Unit vectors east, north, up of a grid, and those along azimuth and zenith angle, (3, S, 3), azimuth fastest."""
    z, a = (x.ravel() for x in np.meshgrid(za, az, indexing="ij"))
    zero = np.zeros_like(z)
    towards = [np.sin(z) * np.cos(a), np.sin(z) * np.sin(a), np.cos(z)]
    along = [-np.sin(a), np.cos(a), zero]
    away = [np.cos(z) * np.cos(a), np.cos(z) * np.sin(a), -np.sin(z)]
    return np.moveaxis(np.array([towards, along, away]), 1, -1)


def _towards(telescope: Instrument, station: int, when: Any, freq: Float, local: Float, pointing: Any) -> Complex:
    """Jones matrices of a station for fields along azimuth and zenith angle, (F, S, 2, 2)."""
    layout, chain = telescope.layout(), telescope.perfect().chain()
    axes = geodetic_axes(layout.positions_m[station : station + 1])[0]
    somewhere = Direction(0.0, 0.0)
    start = Sampling.build(layout, when, freq, 0.0, 0.0, somewhere)
    centre = _icrs(start.earth, axes[2:])[0] if pointing is None else direction(pointing, "pointing").vector
    there = Direction(float(np.arctan2(centre[1], centre[0])), float(np.arctan2(centre[2], np.hypot(*centre[:2]))))
    at = Sampling.build(layout, when, freq, 0.0, 0.0, there)
    seen, along, away = local @ axes
    sky = _icrs(at.earth, seen)
    ra, dec = np.arctan2(sky[:, 1], sky[:, 0]), np.arctan2(sky[:, 2], np.hypot(sky[:, 0], sky[:, 1]))
    step = max(1, int(CELLS / (len(layout) * len(freq))))
    out = []
    for first in range(0, len(ra), step):
        piece = slice(first, first + step)
        one = at.towards(ra[piece], dec[piece])
        east = one.east_itrf[0]
        north = np.cross(one.itrf[0], east)
        turn = np.array([[np.sum(n * e, axis=-1) for e in (along[piece], away[piece])] for n in (north, east)])
        jones = np.broadcast_to(chain.jones(one), (1, len(freq), len(layout), len(ra[piece]), 2, 2))[0, :, station]
        out.append(jones @ np.moveaxis(turn, -1, 0))
    return np.concatenate(out, axis=1)


def _icrs(earth: EarthFrame, seen: Float) -> Float:
    """ICRS unit vectors (S, 3) of apparent ITRF ones (S, 3) at one time: `EarthFrame.itrf` backwards."""
    moved, velocity = seen @ earth.matrices[0], earth.velocity[0]
    along = moved @ velocity
    return np.asarray((along + np.sqrt(along**2 + 1 - velocity @ velocity))[:, None] * moved - velocity)


def _feed_angles(zenith: Complex) -> Float:
    """Angles (2,) from north through east in which receptors respond best at the zenith, below 180 deg.

    `zenith` (2, 2): along azimuth (there north) and zenith angle (there east), of each receptor.
    """
    north, east = zenith
    twice = 2 * np.real(north * east.conj()), np.abs(north) ** 2 - np.abs(east) ** 2
    return np.asarray(0.5 * np.arctan2(*twice) % np.pi)


@checked
def write_mueller(
    path: str | os.PathLike[str],
    telescope: Instrument,
    grid: ImageGrid,
    times: Any,
    frequencies: Any,
    baseline: tuple[str, str] | Literal["mean"] = "mean",
    state: State = "differential",
    overwrite: bool = False,
) -> None:
    """Write Mueller matrices over an image as FITS, (F, 4, 4, Ny, Nx) in double precision, mean over `times`.

    Rows (second axis) are the Stokes parameters that are seen, columns (third) those of the sky, I, Q, U, V. Of one
    baseline, or the mean over all of them, both ways round, as an image sees it. The imaginary part, which one baseline
    of unlike stations has, is the extension IMAGINARY where it is not 0. The beam points at the centre of the grid.
    """
    from astropy import units as u
    from astropy.coordinates import SkyCoord
    from astropy.io import fits

    if grid.centre is None:
        raise InputError("Mueller matrices are written over a grid with a centre: give ImageGrid(..., centre=...)")
    grid.on_the_sky()
    freq = np.atleast_1d(np.asarray(to_si(frequencies, "Hz", "frequencies", above=0), float))
    if len(freq) > 1 and not np.allclose(np.diff(freq), freq[1] - freq[0], rtol=1e-9, atol=0):
        raise InputError("frequencies of a Mueller file are equally spaced; write the others into files of their own")
    afford(5 * 256.0 * len(freq) * len(grid), f"{path}: its matrices", "take fewer pixels, or a file a frequency")
    ra, dec = grid.directions()
    at = telescope.sampling(SkyCoord(ra * u.rad, dec * u.rad), times, freq * u.Hz, grid.centre.skycoord)
    if baseline == "mean" and len(at.layout) < 2:
        raise InputError("the mean over baselines needs two stations: give baseline=(NAME, NAME) of the one there is")
    chain = telescope.chain()
    found = np.empty((len(freq), len(grid), 4, 4), complex)
    step = max(1, int(CELLS / (len(at.layout) * len(freq))))
    for first in range(0, len(grid), step):
        piece = slice(first, first + step)
        if baseline == "mean":
            found[:, piece] = mean_mueller(chain, at.towards(ra[piece], dec[piece]), state == "differential")
        else:
            a, b = (at.layout.index(n) for n in baseline)
            some = SkyCoord(ra[piece] * u.rad, dec[piece] * u.rad)
            jones = telescope.beam(some, times, freq * u.Hz, grid.centre.skycoord, state)
            found[:, piece] = mueller(jones[:, :, a], jones[:, :, b]).mean(axis=0)
    cube = np.moveaxis(found.reshape(len(freq), *grid.pixels, 4, 4), (3, 4), (1, 2))
    header = _mueller_header(grid, freq, "mean" if baseline == "mean" else "-".join(baseline), state)
    hdus = [fits.PrimaryHDU(np.ascontiguousarray(cube.real), header=header)]
    if cube.imag.any():
        hdus.append(fits.ImageHDU(np.ascontiguousarray(cube.imag), header=header, name="IMAGINARY"))
    with whole_file(path, overwrite) as partial:
        fits.HDUList(hdus).writeto(partial, overwrite=True)


def _mueller_header(grid: ImageGrid, freq: Float, baseline: str, state: str) -> Any:
    from astropy.io import fits

    assert grid.centre is not None
    header = fits.Header()
    ny, nx = grid.pixels
    degrees = np.rad2deg([grid.pixel, grid.centre.ra_rad, grid.centre.dec_rad]).tolist()
    width = float(freq[1] - freq[0]) if len(freq) > 1 else 1.0
    for k, (kind, unit, pixel, value, step) in enumerate(
        (
            ("RA---SIN", "deg", nx // 2 + 1.0, degrees[1], -degrees[0]),
            ("DEC--SIN", "deg", ny // 2 + 1.0, degrees[2], degrees[0]),
            ("STOKES", "", 1.0, 1.0, 1.0),
            ("STOKESOU", "", 1.0, 1.0, 1.0),
            ("FREQ", "Hz", 1.0, float(freq[0]), width),
        ),
        1,
    ):
        header[f"CTYPE{k}"], header[f"CUNIT{k}"], header[f"CRPIX{k}"] = kind, unit, pixel
        header[f"CRVAL{k}"], header[f"CDELT{k}"] = value, step
    header["RADESYS"], header["POLCCONV"] = "ICRS", ("IAU", "x north, y east; V is minus that of the IAU")
    header["BASELINE"], header["BEAMMODE"] = baseline, state
    header["COMMENT"] = "Mueller matrices: axis 3 is the Stokes parameter of the sky, axis 4 the one that is seen"
    header.extend(fits_cards(), update=True)
    return header
