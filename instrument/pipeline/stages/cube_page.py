"""Figures and sections of what was made of a cube: Faraday depth, power spectra, removal, EoR window."""

from __future__ import annotations

import re

import numpy as np

from instrument.analyze.faraday.cube import FaradayCube
from instrument.analyze.ixr import removal_table
from instrument.analyze.power.signal import Signal21cm
from instrument.pipeline.stage import Draw
from instrument.pipeline.stages.cube_results import CubeProducts
from instrument.report.page import Block, Details, Figures, Section, Table, Text, number
from instrument.units import Float


class CubeResults(CubeProducts):
    """What was made of a cube, and its part of the page."""

    def sections(self, draw: Draw) -> list[Section]:
        """Faraday depth, removal, spectra, window."""
        return cube_sections(self, draw)


def cube_sections(result: CubeProducts, draw: Draw) -> list[Section]:
    """Sections of a page, their figures drawn by `draw`; the window first, for it is what the others are made for."""
    made = (make(result, draw) for make in (_window, _spectra, _faraday, _removal))
    return [*(section for section in made if section is not None), _cube(result)]


def _cube(result: CubeProducts) -> Section:
    cube = result.cube
    rows = [
        ["channels", f"{len(cube.freq_hz)}, {cube.freq_hz.min() / 1e6:.6g} to {cube.freq_hz.max() / 1e6:.6g} MHz"],
        ["pixels", f"{cube.data.shape[3]} x {cube.data.shape[2]} of {60 * np.rad2deg(cube.pixel_rad):.4g}′"],
        ["unit", cube.unit],
    ]
    if cube.psf is not None and np.isfinite(cube.psf.major_rad).any():
        major, minor = (60 * np.rad2deg(np.nanmedian(x)) for x in (cube.psf.major_rad, cube.psf.minor_rad))
        rows.append(["beam (median of channels)", f"{major:.3g}′ x {minor:.3g}′"])
    rows += [[f"left out: {name}", why] for name, why in result.left_out.items()]
    rows += [["warning", text] for text in result.warned]
    return Section("Cube", [Table(["what", "value"], rows)])


def _faraday(result: CubeProducts, figure: Draw) -> Section | None:
    found, peaks = result.faraday, result.peaks
    if found is None or peaks is None:
        return None
    from instrument.report.faraday import faraday_slices, lines_of_sight, rmsf

    band = found.band
    rows = [
        ["width of the band in wavelength²", f"{number(band.width)} m²"],
        ["FWHM of the RMSF: measured on it", f"{number(band.fwhm)} rad/m²"],
        ["FWHM: 2 sqrt(3) / width, 3.8 / width", f"{number(band.fwhm_nominal)}, {number(band.fwhm_sinc)} rad/m²"],
        ["largest depth, sqrt(3) / channel", f"{number(band.phi_max)} rad/m²"],
        ["largest scale, pi / shortest wavelength²", f"{number(band.max_scale)} rad/m²"],
        ["reference wavelength²", f"{number(found.lambda2_0)} m²"],
        ["pixels with a significant peak", f"{int(peaks.significant.sum())}, above {peaks.snr_min:g} times the noise"],
    ]
    blocks: list[Block] = [Table(["what", "value"], rows)]
    if band.fwhm > band.max_scale:
        blocks.append(
            Text(
                "The RMSF is wider than the largest scale: emission that is thick in Faraday depth is seen only at its "
                "edges, and most of it is missing."
            )
        )
    if not any(np.nan_to_num(plane).any() for plane in found.data):
        return Section("Faraday depth", [*blocks, Text("There is no polarized emission in the cube to draw.")])
    y, x = result.brightest
    line = lines_of_sight(result.sights)
    line.set_title(f"pixel ({x}, {y}), the brightest")
    text = "Faraday spectra of the brightest pixel: Q + iU, and Stokes I and V where they have data."
    entries = [
        figure("faraday_slices", faraday_slices(found, _brightest(found)), "Polarized intensity |F|.", wide=True),
        figure("faraday_lines", line, text),
        figure("rmsf", rmsf(found), "The RMSF: what a screen at one depth looks like."),
    ]
    return Section("Faraday depth", [*blocks, Figures(entries)])


def _brightest(found: FaradayCube) -> Float:
    """Six depths over the range in which most of the emission lies."""
    power = np.array([np.nanmean(np.abs(plane.astype(complex)) ** 2) for plane in found.data])
    bright = found.depths[np.nan_to_num(power) >= 0.2 * np.nanmax(power)]
    bright = bright if bright.size else found.depths
    middle, half = (bright.max() + bright.min()) / 2, max(np.ptp(bright) / 2, 1.25 * min(found.fwhm, 1e6))
    return np.linspace(max(middle - half, found.depths.min()), min(middle + half, found.depths.max()), 6)


def _removal(result: CubeProducts, figure: Draw) -> Section | None:
    return None if result.split is None else Section("Foreground removal", [Text(result.said, code=True)])


def _spectra(result: CubeProducts, figure: Draw) -> Section | None:
    from instrument.report.cylinders import cylinder, spheres
    from instrument.report.spectra import spectra_2d

    entries = []
    first = next(iter(result.cylinders.values()), None) or next(iter(result.spheres.values()), None)
    for name, spectrum in result.cylinders.items():
        if not np.nan_to_num(spectrum.power).any():
            continue
        what = "Q + iU" if name == "P" else f"Stokes {name}"
        text = f"Cylindrical power spectrum of {what}; lines: the wedge of sources so far from the phase centre."
        entries.append(figure(f"cylindrical_{name.replace(' ', '_')}", cylinder(spectrum, what), text))
    if result.spheres:
        in_kelvin = all(s.unit == "K" for s in result.spheres.values())
        models = [Signal21cm.table(result.settings.signal)] if in_kelvin else []
        text = "Spherical power spectra" + (" and the 21-cm signal." if in_kelvin else ".")
        entries.append(figure("spherical", spheres(result.spheres, models), text))
    if any(np.nan_to_num(plane.power).any() for plane in result.planes.values()):
        entries.append(figure("spectrum_2d", spectra_2d(result.planes), "2D power spectra of the middle channel."))
    if not entries:
        return None
    blocks: list[Block] = []
    if first is not None:
        frame = first.frame
        blocks.append(
            Text(
                f"One redshift, {frame.redshift:.4g}, serves the whole band: {frame.distance_mpc:.0f} Mpc across a "
                f"radian, {1e6 * frame.depth_mpc_per_hz:.4g} Mpc along a MHz. Tapers: "
                f"{frame.taper or 'none'} along frequency, {frame.taper_space or 'none'} over the images. The beam "
                "stays in the power."
            )
        )
    return Section("Power spectra", [*blocks, Figures(entries)])


def _window(result: CubeProducts, figure: Draw) -> Section | None:
    if not result.windows:
        return None
    from instrument.report.cylinders import cylinder_ratio

    blocks: list[Block] = []
    entries = []
    for name, window in result.windows.items():
        said, *rest = str(window).splitlines()
        blocks.append(Text(f"{name[0].upper()}{name[1:]}. {said}" if name else said))
        rows = [re.split(r"\s{2,}", line, maxsplit=1) for line in rest]
        blocks.append(Table(["", ""], [row if len(row) == 2 else [*row, ""] for row in rows], stack=True))
        file = f"window{'_' if name else ''}{name.replace(' ', '_')}"
        text = "Power of Stokes I, taken as leakage, over that of the 21-cm signal" + (f", {name}." if name else ".")
        if window.counts.any():
            drawn = cylinder_ratio(window, reduced=result.settings.removed, name=name or "as it is")
            entries.append(figure(file, drawn, text))
    columns = ("removed_percent", "leakage_percent", "power_left", "ixr_m_db", "ixr_j_db")
    heads = ["leakage removed (%)", "leakage left (%)", "power left", "IXR_M (dB)", "IXR_J (dB)"]
    worth = [[float(row[name]) for name in columns] for row in removal_table()]
    table = Table(heads, worth, "The same for every scene: arithmetic, nothing of it was measured in this run.")
    rule = Details("Not measured: what any station of 25 dB is worth when part of its leakage is removed", [table])
    return Section("EoR window", [*blocks, *([Figures(entries)] if entries else []), rule])
