"""Figures and report page of a run: which are drawn, with what captions, and how wrong each stage may be."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from instrument.analyze.leakage import Leakage
from instrument.analyze.spectra import Spectrum2D
from instrument.analyze.subtraction import ManyDirectionsResult
from instrument.analyze.sweep import Sweep
from instrument.calibrate.base import Solution
from instrument.calibrate.di_errors import DIComparison
from instrument.cube_results import CubeResults
from instrument.image.cube import StokesCube
from instrument.report.calibration import convergence, gains, residuals
from instrument.report.cube_page import cube_sections
from instrument.report.figures import Kind, bubbles, profile
from instrument.report.images import psf_image, stokes_images
from instrument.report.laboratory import errors_against_model
from instrument.report.page import (
    Block,
    Card,
    Cell,
    Details,
    FigureEntry,
    Figures,
    Page,
    Section,
    Table,
    Text,
    duration,
    number,
    write_page,
)
from instrument.report.spectra import spectra_2d
from instrument.report.style import save
from instrument.units import Direction

PLANES: tuple[tuple[Kind, str], ...] = (("linear", "linear polarization"), ("circular", "circular polarization"))


def write_report(
    record: dict[str, Any],
    leakage: Leakage | None,
    cube: StokesCube | None,
    centre: Direction,
    folder: Path,
    solution: Solution | None = None,
    errors: DIComparison | None = None,
    spectra: dict[str, Spectrum2D] | None = None,
    sweep: Sweep | ManyDirectionsResult | None = None,
    products: CubeResults | None = None,
) -> None:
    """Draw the figures of a run into its folder and write `report.html`; `record` is what `run.json` holds."""
    entries: list[FigureEntry] = []

    def draw(name: str, drawing: Any, caption: str, wide: bool = False) -> None:
        entries.append(FigureEntry(save(drawing, folder / f"{name}.png"), caption, wide=wide))

    if leakage is not None:
        for kind, what in PLANES:
            draw(
                f"leakage_{kind}",
                bubbles(leakage, centre, kind),
                f"Leakage of Stokes I into {what}, source by source: size and colour are its percentage of the "
                "apparent I. Circles at 2 and 4 deg from the phase centre.",
            )
        draw(
            "leakage_profile",
            profile(leakage),
            "Leakage against distance: measured in the visibilities, and as the beam model has it averaged over "
            "baselines and times.",
        )
    if cube is not None:
        if cube.psf is not None and cube.psf.data is not None:
            draw("psf", psf_image(cube), "Point spread function and the Gaussian fitted to its main lobe.")
        draw("images", stokes_images(cube), "Dirty images of the four Stokes parameters.", wide=True)
    more: list[Section] = []
    if solution is not None:
        draw("gains", gains(solution), "Solved gains of every station against time; white where there is no solution.")
        draw("convergence", convergence(solution), "How the solve converged: the slowest interval.")
        draw("residual", residuals(solution), "What the solutions leave of the data they were solved from.")
        blocks: list[Block] = [Text(str(solution))]
        if errors is not None:
            blocks.append(
                Table.of(errors.table(), "The seven direction-independent error parameters, in % of the rms put in.")
            )
        more.append(Section("Calibration", blocks))
    if isinstance(sweep, ManyDirectionsResult):
        rows = Table.of(
            sweep.table(), "Rms of visibilities; one: with one direction for all. Errors without the gauge."
        )
        more.append(Section("Many directions", [Text("\n".join(sweep.lines()), code=True), rows]))
    elif sweep is not None:
        what = "Errors against the number of sources in the model."
        draw("errors_against_model", errors_against_model(sweep), what)
        rows = Table.of(sweep.table(), "One row a model of the n brightest sources.")
        more.append(Section("Incomplete models", [rows]))
        if sweep.reference is not None:
            curves = sweep.spectra(taper="hann").items()
            spectra = {f"left with {n} in the model" if n else "true image": curve for n, curve in curves}
    if spectra:
        draw(
            "spectrum_2d",
            spectra_2d(spectra),
            "2D power spectra of the images, Hann taper; the PSF stays.",
        )
    if products is not None:
        more.extend(cube_sections(products, folder))
    sources = None if leakage is None else leakage.table()
    write_page(page_of_run(record, entries, sources, more), folder / "report.html")


def page_of_run(
    record: Mapping[str, Any],
    figures: Iterable[FigureEntry] = (),
    sources: Any = None,
    more: Iterable[Section] = (),
) -> Page:
    """The page of a run from what `run.json` holds; a part that is absent there is absent here.

    `sources` is an astropy table of all sources, `more` are sections of other stages, put after the figures. Read are
    name, title, finished, seed, versions, machine, plan (text, engine), seconds, checks, leakage, image, and where
    given command, kind ("scene" unless said) and stage_errors (stage -> how wrong it may be).
    """
    plan = record.get("plan", {})
    sections = [
        Section("Plan", [Text("\n".join(plan.get("text", ())), code=True)] if plan.get("text") else []),
        Section("Leakage by distance", _rings(record.get("leakage", {}))),
        Section("Figures", [Figures(entries)] if (entries := list(figures)) else []),
        *more,
        Section("Checks", _checks(record)),
        Section("What each stage cost, and how wrong it may be", _stages(record)),
        Section("All sources", [_all_sources(sources)] if sources is not None else []),
        Section("To run it again", _again(record)),
    ]
    finished = record.get("finished", "").replace("T", " ")
    verdicts = {name: check.get("passed", True) for name, check in record.get("checks", {}).items()}
    short = [name for name, passed in verdicts.items() if passed is False]
    unmade = [name for name, passed in verdicts.items() if passed is None]
    verdict = f"Done, but fell short: {', '.join(short)}." if short else "Done; every check held."
    if unmade and not short:
        verdict = f"Done; not checked: {', '.join(unmade)}."
    if not verdicts:
        verdict = "Done; nothing was checked."
    return Page(
        title=record.get("title") or record.get("name", "run"),
        subtitle=f"{record.get('kind', 'scene')} {record.get('name', '')}, finished {finished}",
        verdict=verdict,
        mark="bad" if short else "good" if verdicts and not unmade else "",
        cards=_cards(record),
        sections=[section for section in sections if section.blocks],
        footer=f"instrument {record.get('versions', {}).get('instrument', '')}",
    )


def _mark(passed: bool | None, good: str = "held", bad: str = "fell short") -> Cell | str:
    """The verdict of a check; one that was not made, `None`, is neither held nor fell short."""
    if passed is None:
        return "not checked"
    return Cell(good if passed else bad, mark="good" if passed else "bad")


def _cards(record: Mapping[str, Any]) -> list[Card]:
    cards = []
    leakage, checks = record.get("leakage", {}), record.get("checks", {})
    if inside := leakage.get("inside_4_deg"):
        null, faint = leakage.get("near_null", 0), leakage.get("too_faint", 0)
        note = f"left out in the whole field: {null} near a null, {faint} too faint"
        cards.append(Card("Sources in 4°", str(inside["sources"]), note))
        for kind in ("linear", "circular"):
            median, most = (number(inside[f"{kind}_{what}"]) for what in ("median", "max"))
            cards.append(
                Card(f"{kind.capitalize()} leakage in 4°", f"{median}\u00a0%", f"median; at most {most}\u00a0%")
            )
    if (check := checks.get("prediction")) and check.get("passed") is not None:
        note = f"of the {number(check['relative_to_jy'], 4)} Jy in the sky; bound {check['bound']:.1e}"
        cards.append(Card("Prediction error", f"{check['error']:.1e}", note, "good" if check["passed"] else "bad"))
    if "psf_arcmin" in record.get("image", {}):
        major, minor = (number(width) for width in record["image"]["psf_arcmin"])
        cards.append(Card("PSF", f"{major}′ × {minor}′", "width at half maximum"))
    if seconds := record.get("seconds"):
        parts = [record.get("plan", {}).get("engine"), record.get("machine", {}).get("workers")]
        note = f"engine {parts[0]}, {parts[1]} workers" if all(parts) else ""
        cards.append(Card("Wall time", duration(sum(seconds.values())), note))
    return cards


def _rings(leakage: Mapping[str, Any]) -> list[Block]:
    if not leakage.get("rings"):
        return []
    rows = [
        [f"{r['from_deg']:g} – {r['to_deg']:g}", r["sources"]]
        + [float(r[f"{kind}_{what}"]) for kind in ("linear", "circular") for what in ("median", "max")]
        for r in leakage["rings"]
    ]
    heads = ["distance (deg)", "sources", "I→P median (%)", "I→P max (%)", "I→V median (%)", "I→V max (%)"]
    return [Table(heads, rows, "P is sqrt(Q² + U²); both in % of the apparent I of the source.")]


def _checks(record: Mapping[str, Any]) -> list[Block]:
    rows: list[list[Any]] = []
    for name, check in record.get("checks", {}).items():
        if name == "prediction" and check.get("passed") is None:
            found, wanted = check.get("text", ""), ""
        elif name == "prediction":
            found, wanted = f"error {check['error']:.1e}", f"at most {check['bound']:.1e}"
            seen = ", ".join(f"{n} {of}/{all_}" for n, (of, all_) in check.get("seen", {}).items())
            name = f"prediction, {check['samples']} visibilities against the definition" + (seen and f" ({seen})")
        else:
            found, wanted = "; ".join(dict.fromkeys(check.get("outcome", ()))), ""
        rows.append([name, found, wanted, _mark(check.get("passed", True))])
        if "flux_in_jy" in check:
            given, seen = check["flux_in_jy"], check["flux_out_jy"]
            share = f"apparent, {number(100 * seen / given)}\u00a0%" if given else "apparent"
            rows.append(
                ["flux of all sources", f"{number(seen, 4)} Jy {share}", f"{number(given, 4)} Jy in the sky", ""]
            )
    if image := record.get("image"):
        for stokes, rms in image.get("rms", {}).items():
            rows.append([f"rms of the {stokes} image", f"{number(float(rms))} {image['unit']}", "", ""])
    return [Table(["check", "found", "expected", "verdict"], rows)] if rows else []


def _stages(record: Mapping[str, Any]) -> list[Block]:
    seconds, checks = record.get("seconds", {}), record.get("checks", {})
    if not seconds:
        return []
    wrong = dict(record.get("stage_errors", {}))
    if (check := checks.get("prediction")) and check.get("passed") is not None:
        wrong.setdefault("predict", f"{check['error']:.1e} measured, {check['bound']:.1e} at most, of the total flux")
    if check := checks.get("photometry"):
        wrong.setdefault("photometry", "; ".join(dict.fromkeys(check["outcome"])))
    longest = max(seconds.values()) or 1.0
    rows = [
        [stage, Cell(duration(spent), bar=spent / longest), wrong.get(stage, "–")]
        for stage, spent in sorted(seconds.items(), key=lambda item: -item[1])
    ]
    return [Table(["stage", "time", "how wrong it may be"], rows)]


def _all_sources(sources: Any) -> Details:
    return Details(f"{len(sources)} sources", [Table.of(sources)])


def _again(record: Mapping[str, Any]) -> list[Block]:
    blocks: list[Block] = [Text(record.get("command", "instrument run scene.toml"), code=True)]
    rows = [["seed", number(record.get("seed"))]]
    rows += [[name, str(value)] for name, value in record.get("machine", {}).items()]
    rows += [[name, str(value)] for name, value in record.get("versions", {}).items()]
    return [Details("Command, seed, versions", [*blocks, Table(["what", "value"], rows)])]
