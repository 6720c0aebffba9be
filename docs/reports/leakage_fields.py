"""Leakage of the polarized Galaxy into I and V in fields of 4, 9 and 15 deg, seen by LOFAR HBA.

    python docs/reports/leakage_fields.py [--out docs/reports] [--fields 4,9,15] [--interval "40 min"]

Faraday screens with I = V = 0 on pixels of 2 arcmin, drawn once on the largest field; the smaller ones are its middle.
9 channels of 4 MHz from 134 MHz, 59 stations, 8 h about the transit of 3C196, 30 to 800 wavelengths, the beam towards
the centre taken out. In each channel the rms of I and of V over that of sqrt(Q² + U²) within 1.9 deg, half power; and
over the whole field.
"""

import argparse
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
from astropy import units as u

from instrument import ImageGrid, Imager, ImageSky, InputError, Observation, Scene, load
from instrument.errors import RefusedError

PIXEL = 2 * u.arcmin
MHZ = np.linspace(134, 166, 9)
FWHM_RADIUS = 1.9  # deg
UV = (30, 800)


def cut(images, pixels):
    """The middle of images (..., N, N)."""
    first = images.shape[-1] // 2 - pixels // 2
    return images[..., first : first + pixels, first : first + pixels]


def shares(data, inside):
    """Rms of I and V over that of P in each channel (2, F), of the pixels inside."""
    i, q, u_, v = np.moveaxis(data[:, :, inside], 1, 0)
    return np.array([i.std(axis=-1), v.std(axis=-1)]) / np.hypot(q.std(axis=-1), u_.std(axis=-1))


def night(interval):
    """The observation."""
    return Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=8 * u.hour, interval=interval,
        frequencies=MHZ * u.MHz,
    )  # fmt: skip


def seen(sky, pixels, tolerance, interval):
    """Images of a field, how many nodes its beams took, bound and error, and the seconds of prediction."""
    lofar, grid = load("telescopes", "lofar-hba"), ImageGrid(pixels=pixels, pixel=PIXEL)
    sky = ImageSky(grid=grid, stokes=sky, frequencies=MHZ * u.MHz)
    scene = Scene(instrument=lofar, sky=sky, observation=night(interval))
    plan = scene.plan(tolerance=tolerance, engine="gridded", uv_range=UV)
    begin = time.perf_counter()
    vis = plan.run()
    spent = time.perf_counter() - begin
    check = plan.verify(vis, samples=32)
    cube = Imager(pixels=pixels, pixel=PIXEL, uv_range=UV).image(vis.without_beam(lofar))
    return cube.data, len(plan.ready.nodes), plan.error_bound, check.error, spent


def line(field, largest, tolerances, interval):
    """A row of the table: the first tolerance that the engine keeps."""
    pixels = 2 * round(field * 15)
    said = ""
    for tolerance in tolerances:
        try:
            data, nodes, bound, error, spent = seen(cut(largest, pixels), pixels, tolerance, interval)
        except (InputError, RefusedError) as refused:
            said = f"{tolerance:g}: {refused}"
            continue
        y, x = np.mgrid[:pixels, :pixels] - pixels // 2
        radius = np.hypot(x, y) * PIXEL.to_value("deg")
        cells = []
        for within in (FWHM_RADIUS, field / 2):
            i, v = shares(data, radius < within)
            cells += [
                f"{100 * np.median(i):.3f} ({100 * i.min():.3f} to {100 * i.max():.3f})",
                f"{100 * np.median(v):.4f}",
            ]
        cells += [f"{nodes}", f"{bound:.1e}", f"{error:.1e}", f"{spent:.0f}"]
        return f"| {field:g} deg | {pixels} | " + " | ".join(cells) + " |", said
    return f"| {field:g} deg | {pixels} | refused | | | | | | | |", said


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/reports"))
    parser.add_argument("--fields", default="4,9,15")
    parser.add_argument("--interval", default="40 min")
    parser.add_argument("--tolerances", default="1e-3,1e-2")
    given = parser.parse_args()
    fields = [float(f) for f in given.fields.split(",")]
    tolerances = [float(t) for t in given.tolerances.split(",")]
    galaxy = load("skies", "galaxy", pixels=2 * round(max(fields) * 15), pixel=PIXEL)
    largest = galaxy.about(night(given.interval).phase_centre).planes(MHZ * 1e6)
    lines, refused = [], []
    for field in fields:
        row, said = line(field, largest, tolerances, given.interval)
        lines.append(row)
        refused += [f"- {field:g} deg, tolerance {said}"] if said else []
        print(row, said, flush=True)
    text = (
        "# Leakage in fields of 4, 9 and 15 deg\n\n"
        f"`python docs/reports/leakage_fields.py`, {time.strftime('%Y-%m-%d')}, instrument {version('instrument')}, "
        f"ducc0 {version('ducc0')}; integrations {given.interval} apart.\n{__doc__.split(chr(10), 3)[3]}\n"
        "| field | pixels | I/P within 1.9 deg, % | V/P | I/P of the field, % | V/P | nodes | bound | error | s |\n"
        "|---|---|---|---|---|---|---|---|---|---|\n" + "\n".join(lines) + "\n\n"
        "Median of the channels, smallest and largest in brackets. Bound and error (32 visibilities at least, against "
        "the direct sum) are of the total flux. Published for LOFAR within 1.9 deg: 0.35 % (3C196), 0.27 % (NCP).\n"
        + ("\nRefused:\n" + "\n".join(refused) + "\n" if refused else "")
    )
    (given.out / "leakage_fields.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
