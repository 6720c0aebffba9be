"""Calibration on the brightest sources alone: what 1, 5, 50, 400, 1000 of 4567 leave, and what it does to fluxes."""

from __future__ import annotations

import numpy as np

from instrument.experiments.incomplete_model_result import Sweep
from instrument.paper.bench import Bench
from instrument.paper.field_3c196 import field
from instrument.paper.finding import Finding
from instrument.report.laboratory import errors_against_model
from instrument.report.spectra import spectra_2d

PRINTED = {1: 10, 5: 15, 50: 30, 400: 60, 1000: 75}  # share of the flux, %


def run(bench: Bench) -> list[Finding]:
    """The scene `incomplete-model`; for the sampling also 3C196 alone with half the integrations."""
    interval = bench.choose(900, 300)
    watched = bench.choose(("calibrate.watched=60", "calibrate.every=4"), ())
    sweep = _sweep(bench, interval, *watched)
    table = sweep.table()
    image = 100 * sweep.image_share
    sparse = 100 * float(_sweep(bench, 2 * interval, "calibrate.models=[1]", *watched).image_share[0])
    times = 28800 // interval
    # rms^2 = floor^2 + noise^2 / integrations
    floor = float(np.sqrt(max(2 * image[0] ** 2 - sparse**2, 0.0)))
    spectra = sweep.spectra("I", uv_range=(30, 800), bins=12)
    bench.draw("errors", errors_against_model(sweep), "Errors against the number of sources in the model.")
    named = {"true image": spectra.pop(0)} | {f"{n} in the model": one for n, one in spectra.items()}
    bench.draw("spectra", spectra_2d(named), "What calibration leaves in Stokes I, by sources in the model.")
    falls = np.diff(image).max() / image[0]
    return [
        *[
            # the paper prints fives
            Finding(f"share of the flux, {n} in the model", 100 * share, "%", f"{paper}", (paper - 2.5, paper + 2.5))
            for (n, paper), share in zip(PRINTED.items(), sweep.flux_share.tolist(), strict=True)
        ],
        # about 1: to the digit printed, and a quarter more to either side for the sky, which is not the paper's
        Finding(
            "3C196 alone: residual image, of its rms", float(image[0]), "%", "about 1", (0.75, 1.25),
            f"{sparse:.2f} % with {times // 2} integrations, {image[0]:.2f} % with {times}: {floor:.2f} % with "
            "no end, reckoned"
            if not 0.75 <= image[0] <= 1.25 else "",
        ),
        *[
            Finding(f"{n} in the model: residual image", value, "%")
            for n, value in zip(sweep.models[1:], image[1:].tolist(), strict=True)
        ],
        Finding("largest step of it from model to model", float(100 * falls), "%", "falls", (-100.0, 0.0)),
        *[
            Finding(f"{n} in the model: flux of the 50 brightest, median error", float(value), "%")
            for n, value in zip(sweep.models, table["bright_flux_median"].value, strict=True)
        ],
        *[
            Finding(f"{n} in the model: their position, median error", float(value), "arcsec")
            for n, value in zip(sweep.models, table["bright_shift_median"].value, strict=True)
        ],
        Finding("3C196 alone: flux that the others lose", 100 * (1 - float(sweep.suppression[0])), "%"),
        Finding("solves that failed", float(100 * sweep.failed.max()), "%"),
    ]  # fmt: skip


def _sweep(bench: Bench, interval: int, *settings: str) -> Sweep:
    found = bench.run("incomplete-model", *field(bench), f"observation.interval={interval} s", *settings)
    sweep: Sweep = found.stages["calibrate"].found  # type: ignore[attr-defined]
    return sweep
