"""Other programs drawn into contests, where they are installed: EveryBeam beside elements and station beams."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from functools import cache
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from instrument.errors import RefusedError
from instrument.model import Instrument
from instrument.observe.layout import geodetic_axes
from instrument.observe.sampling import Sampling, times_of
from instrument.precision.contest import Entry
from instrument.precision.cube_peers import quiet
from instrument.precision.truth import LIGHT, cis, real, stokes
from instrument.predict.base import Problem
from instrument.units import Complex, Float

# program -> module, and the package whose version is printed
MOST_POINTS = 1e8
LOFAR = ("lofar-hba", "lofar-lba")  # telescopes that EveryBeam knows, from a data set
EVERYBEAM, DRIFTING = ("everybeam",), ("matvis", "fftvis")


class Horizon(NamedTuple):
    """Matrices (T, F, A, S, 2, 2), those towards the pointing (T, F, A, 1, 2, 2), and at which times they were asked.

    In the basis of the antennas, for fields exp(+i omega t).
    """

    jones: Complex
    centre: Complex
    times: Any


@cache
def _everybeam() -> Any:
    """The module, with the folder that its coefficients are in, and casacore's tables."""
    found = next(f for f in metadata.files("everybeam") or () if f.name == "HamakerHBACoeff.h5")
    os.environ.setdefault("EVERYBEAM_DATADIR", str(Path(str(found.locate())).resolve().parent))
    if find_spec("casacore") is not None and "CASARCFILES" not in os.environ:
        import casacore

        path = Path(tempfile.mkdtemp()) / "casarc"
        path.write_text(f"measures.directory: {Path(casacore.__file__).parent / 'data'}\n")
        os.environ["CASARCFILES"] = str(path)
    import everybeam

    return everybeam


# EveryBeam ---------------------------------------------------------------------------------------------------------


def hamaker(freq_hz: float, angle: Float, azimuth: Float) -> list[Entry]:
    """EveryBeam's polynomials of the high band, (S, 2, 2); angles count from its X dipole, in the south-west."""
    if find_spec("everybeam") is None:
        return []
    element = _everybeam().ElementResponse.create("hamaker", "HBA")
    freq, phi = np.full(len(angle), freq_hz), azimuth - np.deg2rad(225)
    return [Entry("everybeam", lambda asked: element.response(freq, angle, phi), (0.0,), peer=True)]


def station_beams(telescope: Instrument, at: Sampling, shared: Callable[[float], Any]) -> list[Entry]:
    """EveryBeam on a data set made of the same stations; `shared(held)` gives the times asked and which is whose.

    It is given ITRF vectors, so that its directions are the same, and answers in the basis of the antennas.
    """
    if find_spec("everybeam") is None or find_spec("casacore") is None:
        return []
    from astropy import units as u

    from instrument.observe.observation import Observation
    from instrument.precision.lofar_ms import make_ms

    library = _everybeam()
    folder = tempfile.TemporaryDirectory()
    night = Observation(
        phase_centre=at.centre.skycoord, start="2012-12-07T01:00:00", duration=10 * u.s, interval=10 * u.s,
        frequencies=at.freq_hz * u.Hz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    make_ms(f"{folder.name}/stations.MS", telescope, night)
    beams = library.load_telescope(f"{folder.name}/stations.MS", element_response_model="hamaker")
    stations, freq_hz = np.arange(len(at.layout), dtype=np.uint64), at.freq_hz
    seen, centre = at.itrf, at.centre_itrf

    def towards(t: int, directions: Float) -> Complex:
        slot, beam = at.slots_s[t : t + 1], centre[t]
        found = [beams.station_response(slot, stations, freq_hz, d, beam, beam, False)[0] for d in directions]
        return np.stack(found, axis=2).swapaxes(0, 1)  # (F, A, S, 2, 2)

    def answer(held: float) -> Horizon:
        asked, which = shared(held)
        found, middle = (np.stack([towards(t, d[t]) for t in asked])[which] for d in (seen, centre[:, None]))
        return Horizon(found, middle, asked[which])

    answer.folder = folder  # type: ignore[attr-defined]  # which is removed when nobody asks any more
    return [Entry("everybeam", answer, peer=True)]


# matvis and fftvis -------------------------------------------------------------------------------------------------


class Drifting(NamedTuple):
    """Visibilities (T, F, B) of one receptor by a program that does not follow the phase centre."""

    data: Complex


def drifting(problem: Problem) -> list[Entry]:
    """matvis in its two precisions, and fftvis, whose knob is the tolerance, on one thread each."""
    made = (
        Entry("matvis", _answer(problem, _matvis), (1e-6, 1e-15), peer=True),
        Entry("fftvis", _answer(problem, _fftvis), peer=True),
    )
    return [entry for entry in made if find_spec(entry.plugin) is not None]


def _answer(problem: Problem, simulate: Callable[[Any, dict[str, Any], float], Complex]) -> Callable[[float], Drifting]:
    given = _given(problem)

    def answer(asked: float) -> Drifting:
        from threadpoolctl import threadpool_limits

        with threadpool_limits(1), quiet():
            return Drifting(simulate(problem, given, asked))

    return answer


def _matvis(problem: Problem, given: dict[str, Any], asked: float) -> Complex:
    from matvis import simulate_vis
    from pyuvdata.analytic_beam import UniformBeam

    pairs = np.stack([problem.antenna1, problem.antenna2], axis=-1)
    found = simulate_vis(
        **given, beams=[UniformBeam()], precision=1 if asked > 1e-7 else 2, polarized=False, antpairs=pairs,
        coord_method="CoordinateRotationERFA",
    )  # fmt: skip
    return np.swapaxes(found, 0, 1)


def _fftvis(problem: Problem, given: dict[str, Any], asked: float) -> Complex:
    from fftvis import simulate_vis
    from pyuvdata.analytic_beam import UniformBeam

    points = _grid_of(problem, given)
    if points > MOST_POINTS:
        raise RefusedError(f"its transform in three dimensions takes a grid of {points:.0e} points for every time")
    pairs = list(zip(problem.antenna1.tolist(), problem.antenna2.tolist(), strict=True))
    found = simulate_vis(
        **given, beam=UniformBeam(), precision=2, polarized=False, baselines=pairs, eps=asked, nprocesses=1, nthreads=1
    )
    return np.swapaxes(found, 0, 1)


def _grid_of(problem: Problem, given: dict[str, Any]) -> float:
    """Points of the grid of a transform from sources to baselines that lie in no plane: twice extent by extent, padded.

    On LOFAR's core (5e8 of them) the first of four integrations of 50 sources was not done after 170 s.
    """
    enu = np.stack(list(given["ants"].values())) * float(problem.at.freq_hz.max()) / float(LIGHT)
    if np.ptp(enu[:, 2]) == 0:
        return 0.0
    local = problem.at.itrf[0] @ geodetic_axes(problem.at.layout.centre_m[None])[0].T
    return float(np.prod(4 * np.ptp(enu, axis=0) * np.ptp(local, axis=0) + 16))


def _given(problem: Problem) -> dict[str, Any]:
    """What both are given of a problem: stations east, north and up of its centre, sources, times, channels."""
    from astropy.coordinates import EarthLocation

    at, sky = problem.at, problem.sky
    enu = (at.layout.positions_m - at.layout.centre_m) @ geodetic_axes(at.layout.centre_m[None])[0].T
    return {
        "ants": dict(enumerate(enu)),
        "fluxes": np.ascontiguousarray(stokes(sky, at.freq_hz)[..., 0].T.astype(float)),
        "ra": at.ra_rad,
        "dec": at.dec_rad,
        "freqs": at.freq_hz,
        "times": times_of(at.slots_s),
        "telescope_loc": EarthLocation.from_geocentric(*at.layout.centre_m, unit="m"),
    }


def drifting_truth(problem: Problem) -> Any:
    """Visibilities (T, F, B) in extended precision about the directions that both work with."""
    from astropy import units as u
    from astropy.coordinates import SkyCoord
    from matvis.core.coords import CoordinateRotation

    given = _given(problem)
    sky = SkyCoord(given["ra"] * u.rad, given["dec"] * u.rad)
    flux = given["fluxes"][:, 0]
    frame = CoordinateRotation._methods["CoordinateRotationERFA"](
        flux=flux, times=given["times"], telescope_loc=given["telescope_loc"], skycoords=sky, precision=2
    )
    frame.setup()
    enu = real(list(given["ants"].values()))
    apart = enu[problem.antenna2] - enu[problem.antenna1]
    out = []
    for t in range(len(given["times"])):
        frame.rotate(t)
        delay = (apart[:, None] * real(frame.all_coords_topo).T[None]).sum(-1) / LIGHT  # (B, S)
        out.append(
            [
                (real(given["fluxes"][:, f]) / 2 * cis(delay * real(freq))).sum(-1)
                for f, freq in enumerate(given["freqs"])
            ]
        )
    return np.array(out)
