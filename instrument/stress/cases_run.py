"""Cases of visibilities and of runs: other phase centres, leap seconds, threads, one ulp, memory that runs out."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from instrument.errors import InstrumentWarning
from instrument.model import Composed
from instrument.observe.directions import earth_frame
from instrument.observe.observation import Observation
from instrument.predict.direct import Direct
from instrument.scene import Scene
from instrument.stress.bench import field, observed, small_array
from instrument.stress.case import Answer, Unfit, both, case, claim, held, not_there
from instrument.units import Direction
from instrument.visibilities import Visibilities, VisibilitySet

CENTRE = Direction(2.15, 0.84)
RATE = 7.292115855306589e-5  # rad/s


def _scene(times: int = 12) -> Scene:
    from astropy import units as u

    night = Observation(
        phase_centre=CENTRE.skycoord, transit="2012-12-07", duration=times * 60 * u.s, interval=60 * u.s,
        frequencies=[150, 151, 152] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    return Scene(instrument=Composed(stations=small_array()), sky=field(), observation=night)


@case("6", "visibilities", "another phase centre, and back", "the same data, to 1e-13 of each; u, v, w to 1e-9 m")
def there_and_back(_: None) -> Answer:
    """3 deg away."""
    data = observed(small_array(), field())
    back = data.shifted_to(Direction(2.2, 0.86).skycoord).shifted_to(CENTRE.skycoord)
    return both(held(back.data, data.data, 1e-13), held(back.uvw_m, data.uvw_m, 1e-9, scale=1.0))


@case("14", "visibilities", "across a leap second", "the Earth turns on evenly, to 1e-9 rad")
def leap(_: None) -> Answer:
    """2016-12-31 has a second 23:59:60."""
    from astropy import units as u
    from astropy.time import Time

    times = Time("2016-12-31T23:59:50", scale="utc") + 2 * np.arange(11) * u.s
    frame = earth_frame(times, small_array().centre_m)
    turned = frame.matrices @ frame.matrices[0].T
    angle = np.arctan2(turned[:, 0, 1], turned[:, 0, 0])
    return held(angle, RATE * 2 * np.arange(11), 1e-9, scale=1.0)


@case(
    "14b", "visibilities", "an observation in 2045", "finite, and a warning that the Earth's orientation is not known"
)
def far_future(_: None) -> Answer:
    """Beyond the table that comes along."""
    import warnings

    from astropy import units as u
    from astropy.time import Time

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        frame = earth_frame(Time(["2045-06-01T20:00:00"], scale="utc"), small_array().centre_m)
    words = " ".join(str(w.message) for w in said if issubclass(w.category, InstrumentWarning))
    assert u.s  # astropy units are loaded with times
    return claim(np.isfinite(frame.matrices).all() and "Earth" in words, "nothing is said", words[:160])


@case("65", "run", "1, 2 and 64 threads; blocks of any size", "the same visibilities, to 1e-13")
def threads(_: None) -> Answer:
    """12 times, 3 channels; and every time and channel predicted by itself."""
    due = _scene().plan(workers=1).run().data
    found = [_scene().plan(workers=n).run().data for n in (2, 64)]
    ready = _scene().plan(workers=1).ready
    parts = np.empty_like(due)
    for t in range(len(due)):
        for f in range(due.shape[1]):
            parts[t : t + 1, f : f + 1] = ready.sums(slice(t, t + 1), slice(f, f + 1))
    return both(*(held(x, due, 1e-13) for x in (*found, parts)))


@case("66", "run", "stations and directions moved by one ulp, 30 draws", "as many digits as the plan's bound claims")
def one_ulp(_: None) -> Answer:
    """The bound is on the rounding of a prediction; inputs of one ulp move it by as much."""
    plan = _scene(3).plan(workers=1)
    given, due = plan.problem, Direct().sums(plan.problem)
    rng = np.random.default_rng(0)
    worst = 0.0
    for _draw in range(30):
        at = given.at
        ra, dec = (np.nextafter(x, x + rng.choice([-1, 1], x.shape)) for x in (at.ra_rad, at.dec_rad))
        places = at.layout.positions_m
        layout = at.layout.with_fields(positions_m=np.nextafter(places, places + rng.choice([-1, 1], places.shape)))
        moved = replace(given, at=replace(at, layout=layout).towards(ra, dec))
        worst = max(worst, float(np.abs(Direct().sums(moved) - due).max()) / plan.scale_jy)
    # a position of 5e6 m has an ulp of 9e-10 m, 5e-10 turns at 2 m: that is the input's own, beside the bound's
    place = 2 * np.pi * 2 * float(np.spacing(np.abs(given.at.layout.positions_m).max())) * np.sqrt(3) / 1.97 * 0.05
    return Answer(worst, plan.error_bound + place)


class _Failing(VisibilitySet):
    """Blocks of which one cannot be made."""

    def __init__(self, blocks: list[Visibilities], at: int) -> None:
        self.given, self.at = blocks, at

    def blocks(self) -> Iterator[Visibilities]:
        """The first ones, and then no memory."""
        for k, block in enumerate(self.given):
            if k == self.at:
                raise MemoryError("a block")
            yield block


@case("67", "run", "no memory at each of 4 blocks", "MemoryError as it is, and no file, not even a part of one")
def no_memory(_: None) -> Answer:
    """While visibilities are saved."""
    data = observed(small_array(), field(), 4)
    blocks = [data.block(slice(t, t + 1), slice(None)) for t in range(4)]
    left = []
    for k in range(4):
        with tempfile.TemporaryDirectory() as folder:
            try:
                _Failing(blocks, k).save(Path(folder) / "x.h5")
            except MemoryError:
                left += [p.name for p in Path(folder).iterdir()]
            else:
                left.append(f"block {k}: saved all the same")
    return claim(not left, f"left: {', '.join(left)}")


@case(
    "C1",
    "visibilities",
    "noise of 200 integrations of 1 ms",
    "200 draws of their own; rms SEFD / sqrt(2 dnu dt), to 4 sigma",
)
def short_noise(_: None) -> Answer:
    """A key of rounded times has 112; close channels have their own too; a part of it has the same noise."""
    from astropy import units as u

    data = observed(small_array(3), field(), 200, (150.0, 150.001), interval=1e-3)
    noise = data.with_noise(1e3 * u.Jy, seed=1).data - data.data
    distinct = len({x.tobytes() for x in noise.reshape(-1, 3, 2, 2).round(9)})
    sigma = 1e3 / np.sqrt(2 * 0.2e6 * 1e-3)
    part = data.block(slice(50, 60), slice(1, 2))
    same = part.with_noise(1e3 * u.Jy, seed=1).data - part.data
    level = np.abs(noise.real.std() / sigma - 1) * np.sqrt(2 * noise.size)
    return both(
        claim(distinct == 400, f"{distinct} draws of 400"), held(same, noise[50:60, 1:2], 1e-9), Answer(level, 5.0)
    )


@case("B3", "visibilities", "a beam taken out that is not in the data", "refused: which beam is in the data is known")
def no_beam(_: None) -> Answer:
    """And the one that is there comes out: a source at the centre is then as without, to 1e-10."""
    from instrument.errors import InstrumentError
    from instrument.jones.parallactic import Parallactic
    from instrument.stress.bench import points
    from instrument.stress.cases_exact import Slanted

    array = Composed(stations=small_array(3), terms=(Slanted(), Parallactic()))
    bare = Composed(stations=small_array(3))
    sky = points([CENTRE.ra_rad], [CENTRE.dec_rad], [2, 0.3, 0.1, 0])
    without = observed(array, sky).without_beam(array)
    try:
        observed(bare, sky).without_beam(array)
        taken = True
    except InstrumentError:
        taken = False
    return both(
        held(without.data, observed(bare, sky).data, 1e-10), claim(not taken, "taken out of data that have none")
    )


SMALL = """name = "small"
engine = "direct"
[instrument]
telescope = "lofar-hba"
stations = ["CS001HBA0", "CS002HBA0", "CS003HBA0"]
[observation]
phase_centre = "08h13m36.0s +48d13m03s"
transit = "2012-12-07"
duration = "40 s"
interval = "10 s"
frequency = { centre = "150 MHz", channel_width = "0.19 MHz", channels = 1 }
[sky]
kind = "grid"
shape = [1, 1]
[image]
pixels = 32
pixel = "2 arcmin"
"""


@case("67b", "run", "no memory in a block, in an image, while files are written", "one line, status 1, and no folder")
def run_out(_: None) -> Answer:
    """The first call of each of these fails in a run of three stations."""
    import contextlib
    import io
    import os
    from unittest.mock import patch

    from instrument.image import cube, dirty
    from instrument.pipeline.run import run
    from instrument.pipeline.scene_file import parse
    from instrument.pipeline.scene_text import read_tables
    from instrument.predict import base
    from instrument.registry import available
    from instrument.report import page
    from instrument.terminal import status_of

    if "lofar-hba" not in available("telescopes"):
        raise Unfit("there is no telescope")
    answers, was = [], os.getcwd()
    places = ((base.Blockwise, "sums"), (dirty.Images, "add"), (dirty.Images, "finish"), (cube, "write_cube"),
              (page, "write_page"))  # fmt: skip
    for owner, name in places:
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            Path("small.toml").write_text(SMALL, encoding="utf-8")
            said = io.StringIO()
            try:
                with (
                    patch.object(owner, name, side_effect=MemoryError("no block")),
                    contextlib.redirect_stderr(said),
                    contextlib.redirect_stdout(io.StringIO()),
                ):
                    tables = read_tables("small.toml")
                    status = status_of(lambda t=tables: int(run(parse(t), t, "x", verify=False).passed))  # type: ignore[misc]
                rest = sorted(str(p) for p in Path().rglob("*"))
            finally:
                os.chdir(was)
        line = said.getvalue().strip()
        good = status == 1 and rest == ["small.toml"] and "not enough memory" in line and "Traceback" not in line
        answers.append(claim(good, f"{name}: status {status}, left {rest}, said {line[-160:]}"))
    return both(*answers)


MISSING = (not_there("68", "run", "GPU against CPU", "within the bound", "no engine runs on a GPU"),)
