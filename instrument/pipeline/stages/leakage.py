"""Leakage of the sources of a run: forced photometry block by block, beside what the beam model says."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from instrument.analyze.analyzer import Analyzer
from instrument.analyze.sources.fluxes import SourceFluxes
from instrument.analyze.sources.leakage import CLEAR, Leakage, expected_percent
from instrument.analyze.sources.photometry import ForcedPhotometry
from instrument.errors import InputError, Outcome
from instrument.observe.sampling import Sampling
from instrument.pipeline.stage import Draw, Running, StageResult, StageRun
from instrument.plan import Plan
from instrument.report.page import Block, Card, Details, Figures, Section, Table, Text, number
from instrument.sky.base import PlacedSky
from instrument.sky.points import PointSky, points_of
from instrument.units import Direction, Float
from instrument.visibilities import Visibilities

EXPECTED_JONES = 4e6  # station Jones matrices spent on the leakage expected from the beam model
PLANES: tuple[tuple[Literal["linear", "circular"], str], ...] = (
    ("linear", "linear polarization"),
    ("circular", "circular polarization"),
)


def listed(sky: PlacedSky) -> PointSky:
    """The sources of a placed sky, whose fluxes are measured: of a sum those of its lists. Raises `InputError`."""
    lists = [found for one in sky.members().values() if (found := points_of(one)) is not None]
    if not lists:
        raise InputError("[analyze] products = ['leakage'] needs a sky that is a list of sources")
    return lists[0] if len(lists) == 1 else PointSky.join(*lists)


class LeakageRun(StageRun):
    """Measures the fluxes of all sources of a sky that is a list of them."""

    def __init__(self, run: Running, photometry: ForcedPhotometry) -> None:
        self.run = run
        self.sums = photometry.start(listed(run.plan.problem.sky))
        self.differential = False

    def take(self, block: Visibilities) -> Visibilities:
        """Add a block to the sums."""
        self.differential = block.beam_state.removed != "nothing"
        with self.run.timed("photometry"):
            self.sums.add(block)
        return block

    def finish(self) -> LeakageResult:
        """Fluxes, leakage, and the leakage expected."""
        plan = self.run.plan
        with self.run.timed("photometry"):
            fluxes = self.sums.finish()
        with self.run.timed("expected leakage"):
            expected = _expected(fluxes, plan, self.differential)
        centre = plan.problem.at.centre
        found = Analyzer(fluxes=fluxes, centre=centre).leakage()
        return LeakageResult(fluxes, replace(found, expected=expected), centre)


def _expected(fluxes: SourceFluxes, plan: Plan, differential: bool) -> Float:
    """Leakage (G, 2) in % the beam model has in the first channel of the fluxes, from evenly spread integrations."""
    channel = int(abs(plan.problem.at.freq_hz - fluxes.freq_hz[0]).argmin())
    at = plan.problem.at.block(slice(None), slice(channel, channel + 1)).towards(fluxes.ra_rad, fluxes.dec_rad)
    times, _, stations, sources = at.shape
    step = max(1, round(times * stations * sources / EXPECTED_JONES))
    chosen: Sampling = at.block(slice(step // 2, None, step), slice(None))
    return expected_percent(plan.problem.chain.beams(), chosen, fluxes.model_jy[0], differential=differential)


@dataclass(frozen=True)
class LeakageResult(StageResult):
    """Fluxes (F, G, 4) of the sources of a run and their leakage, seen from the phase centre."""

    fluxes: SourceFluxes
    leakage: Leakage
    centre: Direction

    @property
    def passed(self) -> bool:
        """Whether the fluxes of every channel were found."""
        return all(o is Outcome.CONVERGED for o in self.fluxes.outcome)

    def record(self) -> dict[str, Any]:
        """Rings of leakage, and the flux that came out of what went in."""
        leakage = self.leakage
        check = {
            "outcome": [o.value for o in self.fluxes.outcome],
            "passed": self.passed,
            "flux_in_jy": float(self.fluxes.model_jy[0, :, 0].sum()),
            "flux_out_jy": float(self.fluxes.stokes_jy[0, :, 0].sum()),
        }
        return {
            "checks": {"photometry": check},
            "stage_errors": self._apart(),
            "leakage": {
                "inside_4_deg": leakage.inside(4.0),
                "rings": leakage.rings(),
                "near_null": int(leakage.near_null.sum()),
                "too_faint": int((~leakage.measured & ~leakage.near_null).sum()),
            },
        }

    def _apart(self) -> dict[str, str]:
        """How far the measured leakage lies from that of the beam model."""
        leakage = self.leakage
        if leakage.expected is None:
            return {}
        use = leakage.measured & (np.rad2deg(leakage.distance_rad) <= 4)
        gap = np.abs(leakage.linear_percent - leakage.expected[:, 0])[use]
        if not gap.size:
            return {"photometry": "; ".join(dict.fromkeys(o.value for o in self.fluxes.outcome))}
        text = f"within 4 deg it differs from the beam model by {np.median(gap):.1e} percentage points in the median"
        return {"photometry": f"{text}, {gap.max():.1e} at most (linear)"}

    def lines(self) -> list[str]:
        """Rings of distance, what was left out, what fell short."""
        return [*self._rings(), *self._short()]

    def _rings(self) -> Iterator[str]:
        yield ""
        yield "distance      sources   I->P median   max %     I->V median   max %"
        for row in self.leakage.rings():
            yield (
                f"{row['from_deg']:4.1f}-{row['to_deg']:3.1f} deg  {row['sources']:7d}   {row['linear_median']:11.5f}"
                f" {row['linear_max']:8.5f}   {row['circular_median']:11.5f} {row['circular_max']:8.5f}"
            )
        near = int(self.leakage.near_null.sum())
        faint = int((~self.leakage.measured).sum()) - near
        if near:
            yield f"left out: {near} sources near a null of the beam (apparent flux below 1 %)"
        if faint:
            yield f"left out: {faint} sources too faint beside the others (error above {CLEAR:g} % of I)"

    def _short(self) -> Iterator[str]:
        bad = [o.value for o in self.fluxes.outcome if o is not Outcome.CONVERGED]
        yield from (f"photometry fell short: {text}" for text in bad)

    def write(self, folder: Path) -> None:
        """leakage.ecsv."""
        self.leakage.write(folder / "leakage.ecsv")

    def cards(self) -> list[Card]:
        """Sources and leakage within 4 deg."""
        found = self.record()["leakage"]
        inside = found["inside_4_deg"]
        if not inside["sources"]:
            return [Card("Sources measured in 4°", "none", self._left_out())]
        note = f"left out in the whole field: {self._left_out()}"
        cards = [Card("Sources measured in 4°", str(inside["sources"]), note)]
        for kind in ("linear", "circular"):
            median, most = (number(inside[f"{kind}_{what}"]) for what in ("median", "max"))
            text = f"median; at most {most}\u00a0%"
            cards.append(Card(f"{kind.capitalize()} leakage in 4°", f"{median}\u00a0%", text))
        return cards

    def _left_out(self) -> str:
        near = int(self.leakage.near_null.sum())
        return f"{near} near a null, {int((~self.leakage.measured).sum()) - near} too faint"

    def sections(self, draw: Draw) -> list[Section]:
        """Leakage by distance, over the field, and beside the beam model."""
        from instrument.report.figures import bubbles, profile

        blocks: list[Block] = []
        if rings := self.leakage.rings():
            rows = [
                [f"{r['from_deg']:g} – {r['to_deg']:g}", r["sources"]]
                + [float(r[f"{kind}_{what}"]) for kind in ("linear", "circular") for what in ("median", "max")]
                for r in rings
            ]
            heads = ["distance (deg)", "sources", "I→P median (%)", "I→P max (%)", "I→V median (%)", "I→V max (%)"]
            blocks.append(Table(heads, rows, "P is sqrt(Q² + U²); both in % of the apparent I of the source.", True))
        if not self.leakage.measured.any():
            blocks.append(Text(f"None of the {len(self.leakage.names)} sources was measured: {self._left_out()}."))
            return [Section("Leakage by distance", blocks)]
        entries = []
        for kind, what in PLANES:
            text = (
                f"Leakage of Stokes I into {what}, source by source: size and colour are its percentage of the "
                "apparent I. Circles at 2 and 4 deg from the phase centre."
            )
            entries.append(draw(f"leakage_{kind}", bubbles(self.leakage, self.centre, kind), text))
        text = "Leakage against distance: measured in the visibilities, and as the beam model has it averaged over "
        entries.append(draw("leakage_profile", profile(self.leakage), f"{text}baselines and times."))
        return [Section("Leakage by distance", [*blocks, Figures(entries)])]

    def tables(self) -> list[Section]:
        """All sources."""
        table = self.leakage.table()
        return [Section("All sources", [Details(f"{len(table)} sources", [Table.of(table)])])]
