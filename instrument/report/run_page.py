"""Figures and report page of a run: which are drawn, with what captions, and how wrong each stage may be."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from instrument.analyze.leakage import Leakage
from instrument.image.cube import StokesCube
from instrument.report.figures import bubbles, profile, psf_image, save, stokes_images
from instrument.report.page import FigureEntry, page_of_run, write_page
from instrument.units import Direction


def write_report(
    record: dict[str, Any], leakage: Leakage | None, cube: StokesCube | None, centre: Direction, folder: Path
) -> None:
    """Draw the figures of a run into its folder and write `report.html`; `record` is what `run.json` holds."""
    entries: list[FigureEntry] = []

    def draw(name: str, drawing: Any, caption: str) -> None:
        entries.append(FigureEntry(save(drawing, folder / f"{name}.png"), caption))

    if leakage is not None:
        for kind, what in (("linear", "linear polarization"), ("circular", "circular polarization")):
            draw(
                f"leakage_{kind}",
                bubbles(leakage, centre, kind),  # type: ignore[arg-type]
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
        draw("images", stokes_images(cube), "Dirty images of the four Stokes parameters.")
        if cube.psf is not None:
            draw("psf", psf_image(cube), "Point spread function and the Gaussian fitted to its main lobe.")
    sources = None if leakage is None else leakage.table()
    write_page(page_of_run(record, entries, sources), folder / "report.html")
