"""The contest of calibrators: tolerance, with LOFAR's beams in the model, against gains that are known."""

from __future__ import annotations

from typing import Any

import numpy as np

import instrument.registry as registry
from instrument.errors import Outcome
from instrument.jones.chain import Chain
from instrument.jones.feed import FeedTerm
from instrument.jones.gain import GainTerm
from instrument.observe.observation import Observation
from instrument.precision.contest import RIGHT, WRONG, Contest, Entry, Form, Trial
from instrument.scene import Scene
from instrument.visibilities import Visibilities

STATIONS, INTEGRATIONS = 12, 3
FULL = tuple(10.0 ** (-k / 4) for k in range(5, 45))
SHORT = tuple(10.0**-k for k in range(2, 12))
FEW = tuple(10.0**-k for k in range(2, 12, 3))  # of patterns beside "full"
PATTERNS = {  # errors that a pattern has the unknowns for
    "full": Chain(GainTerm(rms=0.1, seed=1), FeedTerm(rms=0.1, seed=2)),
    "diagonal": Chain(GainTerm(rms=0.1, seed=1)),
}
STEPS = 10.0  # a step of the size of the tolerance is left where a solve stops; more than ten of them is wrong


def contests(calibrators: dict[str, Any], form: Form) -> list[Contest]:
    """One for each pattern of unknowns, errors of 0.1, no noise, seen through element, tile and station beams."""
    sky = _sky()
    return [_of_pattern(pattern, calibrators, sky, form) for pattern in PATTERNS]


def _of_pattern(pattern: str, calibrators: dict[str, Any], sky: Visibilities, form: Form) -> Contest:
    data = sky.corrupted(PATTERNS[pattern])
    scale = _rms(sky.data)

    def judge(solution: Any, asked: float) -> Trial:
        if solution is None or not solution.converged.any():
            return Trial(np.nan, np.nan, "no solution" if solution is None else str(solution.outcome.ravel()[0].name))
        apart = (data.corrected(solution.term).data - sky.data) / scale
        error, whole = _rms(apart), bool(solution.converged.all())
        leaked = _rms(np.stack([apart[..., 0, 0] - apart[..., 1, 1], apart[..., 0, 1] + apart[..., 1, 0]])) / 2
        ended = RIGHT if whole else Outcome.ITERATION_LIMIT.name
        return Trial(error, leaked, WRONG if whole and not error <= STEPS * asked else ended)

    # a solver that has no pattern of unknowns of its own stands beside those of full matrices alone
    entries = {n: c for n, c in calibrators.items() if pattern == "full" or "pattern" in c.model_fields}
    values = FULL if not form.quick else SHORT if pattern == "full" else FEW
    return Contest(
        name="calibrate through beams" + ("" if pattern == "full" else f", {pattern} errors"),
        kind="calibrators",
        knob="tolerance",
        values=values,
        entries=tuple(Entry(name, _answer(cls, data, sky, pattern)) for name, cls in entries.items()),
        judge=judge,
        error="rms of the corrected data less the model, over the rms of the model",
        error_user="rms of what is wrong in Q and U, over the rms of the model",
        truth="the model itself, of which the data were made with known matrices",
    )


def _answer(cls: Any, data: Visibilities, sky: Visibilities, pattern: str) -> Any:
    from instrument.calibrate.directional import DirectionalCal

    def answer(tolerance: float) -> Any:
        solver = cls(tolerance=tolerance, **({} if pattern == "full" else {"pattern": pattern}))
        if isinstance(solver, DirectionalCal):
            return solver.solve(data, {"all": sky})["all"]
        return solver.solve(data, sky)

    return answer


def _sky() -> Visibilities:
    """Nine sources that are not polarized through the beams of twelve LOFAR stations, three integrations."""
    from astropy import units as u

    names = registry.load("telescopes", "lofar-hba", beam=None).layout().names
    chosen = [names[k] for k in np.linspace(0, len(names) - 1, STATIONS).astype(int)]
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=10 * INTEGRATIONS * u.s,
        interval=10 * u.s, frequencies=[150] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    sky = registry.load("skies", "grid", shape=(3, 3), spacing=1 * u.deg, flux=10 * u.Jy)
    lofar = registry.load("telescopes", "lofar-hba", stations=chosen)
    return Scene(instrument=lofar, sky=sky, observation=night).plan().run()


def _rms(values: Any) -> float:
    return float(np.sqrt(np.nanmean(np.abs(values) ** 2)))
