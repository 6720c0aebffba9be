"""Everything that `instrument` exports, with NaN, inf, -1, 0, "2", True and None at each argument.

Each is accepted with a meaning or refused in one line. What is accepted is held against the annotation: a number is no
text, a truth value no count, NaN and infinity no setting; `MEANT` lists the exceptions, each with its meaning.
"""

import inspect
import math
import warnings
from dataclasses import fields, is_dataclass
from functools import cache

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.time import Time

import instrument as ins
from instrument.component import Component
from instrument.errors import InstrumentError

POISON = {"nan": math.nan, "inf": math.inf, "-1": -1, "0": 0, "'2'": "2", "True": True, "None": None}
CENTRE = SkyCoord("08h13m36.0s +48d13m03s")
COUNTS = {"seed", "samples", "count", "bins", "bins_par", "workers", "components", "iterations", "nodes", "every"}
COUNTS |= {"pixels", "rms", "tolerance", "channel", "indent"}
# errors, enumerations, and what only a subclass can be; a Direction is a plain tuple, checked wherever it is taken
NOT_WALKED = {"Component", "InputError", "InstrumentError", "InstrumentWarning", "Outcome", "Simplified", "__version__"}
NOT_WALKED |= {
    "Direction",
    "ScalarTerm",
    "ImageMaker",
    "PixelSky",
    "Predictor",
    "Stage",
    "StageRun",
    "StageResult",
    "VisibilitySet",
}  # those of others are
NOT_WALKED |= {"Prepared", "ImageOperator", "Work"}  # between engines and plans
# (what, argument, poison): why it is accepted
MEANT: dict[tuple[str, str, str], str] = {
    ("Analyzer.rm_synthesis", "divide_by_i", "True"): "by the way that suits the signal",
    ("ixr.leakage_of_ixr", "ixr_db", "inf"): "a perfect instrument leaks nothing",
    ("EoRWindow.removal_needed", "k_par", "inf"): "wherever the window is known",
    ("Signal21cm.inside", "k", "inf"): "no k of the table: False",
    ("Signal21cm.inside", "k", "nan"): "no k of the table: False",
}


class World:
    """A small scene, its visibilities, a small cube, and what is made of them."""

    def __init__(self):
        enu = np.array([[0, 0, 0], [100, 0, 0], [0, 200, 1.0], [-150, 70, 2.0]])
        self.layout = ins.Layout.from_enu(list("abcd"), enu * u.m, 0.12 * u.rad, 0.92 * u.rad, 50 * u.m)
        self.terms = ins.Chain(ins.GainTerm(rms=0.1))
        self.instrument = ins.Composed(stations=self.layout, terms=self.terms)
        self.sky = ins.PointSky.at(CENTRE, [3.0])
        self.pixels = ins.ImageSky(grid=ins.ImageGrid(pixels=4, pixel=1 * u.deg), stokes=np.ones((1, 4, 4, 4)))
        self.observation = ins.Observation(
            phase_centre=CENTRE,
            start="2012-12-07T23:00:00",
            duration=40 * u.s,
            interval=10 * u.s,
            frequencies=[150, 150.2] * u.MHz,
        )
        self.scene = ins.Scene(instrument=self.instrument, sky=self.sky, observation=self.observation)
        self.plan = self.scene.plan()
        self.vis = self.plan.run()
        self.at = self.vis.at
        rng = np.random.default_rng(0)
        freq = np.arange(150, 158, 0.5) * u.MHz
        self.cube = ins.StokesCube(
            rng.normal(size=(16, 4, 16, 16)), freq, 4 * u.arcmin, "K", ins.Direction(2.15, 0.84), None
        )
        self.jansky = ins.Imager(pixels=32, pixel=8 * u.arcmin).image(self.vis)
        self.signal = ins.Signal21cm.table()
        self.analyzer = ins.Analyzer(self.cube)
        one = np.ones(1)
        self.found = ins.SourceCatalogue(
            one, one, one, np.ones((1, 1, 4)), np.ones((1, 1, 4)), one, one, one, one, one, np.zeros(1, int),
            np.ones(1, bool), 150e6 * one,
        )  # fmt: skip
        self.faraday = self.analyzer.rm_synthesis(np.arange(-50, 51, 5.0))
        self.cylinders = self.analyzer.cylindrical()
        self.window = self.analyzer.eor_window(self.signal)
        self.remover = ins.load("foregrounds", "polynomial", terms=2)
        self.loss = ins.signal_loss(self.remover, self.cube, self.cube, bins=4)
        self.recovered = ins.recovered_power(self.cube, self.cube, bins=4)
        self.spheres, self.plane = self.analyzer.spherical(), self.analyzer.spectrum_2d()
        self.split = self.remover.split(self.cube)
        self.solution = ins.SelfCal().solve(self.vis, self.vis)
        self.leak = ins.Analyzer(visibilities=self.vis, sky=self.sky).leakage()


@cache
def world():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return World()


def calls():
    """(what, call by keyword, valid arguments) of everything exported that takes any."""
    w = world()
    names, hba = ["CS001HBA0", "CS002HBA0"], {"stations": ["CS001HBA0", "CS002HBA0"]}
    times, freq = Time(["2012-12-07T23:00:00"]), [150] * u.MHz
    lofar = ins.load("telescopes", "lofar-hba", **hba)
    station = next(t for t in lofar.chain().terms if isinstance(t, ins.StationBeam))
    beam = {"directions": CENTRE, "times": times, "frequencies": freq, "pointing": CENTRE}
    depths, eye = np.arange(-20.0, 21.0), np.eye(2)[None]
    out = [
        ("available", ins.available, {"kind": "skies"}),
        ("load", lambda kind, name: ins.load(kind, name), {"kind": "skies", "name": "grid"}),
        ("Layout.geodetic", ins.Layout.geodetic, {"names": w.layout.names, "positions_m": w.layout.positions_m}),
        ("Layout.from_enu", ins.Layout.from_enu, {
            "names": ["a", "b"], "enu": [[0, 0, 0], [9, 0, 0]] * u.m, "longitude": 0 * u.rad, "latitude": 0 * u.rad,
            "height": 0 * u.m}),
        ("Layout.index", w.layout.index, {"name": "a"}),
        ("Layout.select", w.layout.select, {"names": ["a", "b"]}),
        ("Observation.times", w.observation.times, {"layout": w.layout}),
        ("Sampling.build", ins.Sampling.build, {
            "layout": w.layout, "times": times, "freq_hz": np.array([1.5e8]), "ra_rad": np.array([2.1]),
            "dec_rad": np.array([0.8]), "centre": ins.Direction(2.1, 0.8)}),
        ("Sampling.block", w.at.block, {"times": slice(0, 1), "channels": slice(0, 1)}),
        ("Sampling.towards", w.at.towards, {"ra_rad": np.array([2.1]), "dec_rad": np.array([0.8])}),
        ("PointSky.read", ins.PointSky.read, {"path": "none.csv", "centre": CENTRE}),
        ("PointSky.write", w.sky.write, {"path": "none.dat", "overwrite": False, "preset": "LoTSS"}),
        ("PointSky.at", ins.PointSky.at, {
            "directions": CENTRE, "stokes_jy": [1.0], "frequency": 150 * u.MHz, "names": ["x"]}),
        ("PointSky.select", w.sky.select, {"rows": [0]}),
        ("PointSky.brightest", w.sky.brightest, {"count": 1}),
        ("PointSky.about", w.sky.about, {"centre": ins.Direction(2.1, 0.8)}),
        ("PointSky.stokes", w.sky.stokes, {"freq_hz": np.array([1.5e8])}),
        ("PointSky.brightness", w.sky.brightness, {"at": w.at}),
        ("PointSky.distance_rad", w.sky.distance_rad, {"centre": ins.Direction(2.1, 0.8)}),
        ("PointSky.shape_axes", w.sky.shape_axes, {"centre": ins.Direction(2.1, 0.8)}),
        ("PointSky.nonzero", w.sky.nonzero, {"freq_hz": np.array([1.5e8])}),
        ("ImageGrid", ins.ImageGrid, {"pixels": 4, "pixel": 1 * u.arcmin, "centre": CENTRE}),
        ("ImageSky", ins.ImageSky, {
            "grid": w.pixels.grid, "stokes": np.ones((1, 4, 4, 4)), "frequencies": [150] * u.MHz}),
        ("SumSky", ins.SumSky, {"skies": {"points": w.sky, "pixels": w.pixels}}),
        ("SumSky.about", ins.SumSky(skies={"a": w.sky}).about, {"centre": ins.Direction(2.1, 0.8)}),
        ("ImageSky.about", w.pixels.about, {"centre": ins.Direction(2.1, 0.8)}),
        ("ImageSky.planes", w.pixels.planes, {"freq_hz": np.array([1.5e8])}),
        ("ImageSky.total_jy", w.pixels.total_jy, {"freq_hz": np.array([1.5e8])}),
        ("GainTerm.jones", w.terms.terms[0].jones, {"at": w.at}),
        ("BeamError.jones", ins.BeamError(rms=0.1).jones, {"at": w.at}),
        ("BeamError.simplify", ins.BeamError(rms=0.1).simplify, {"at": w.at, "tolerance": 0.0}),
        ("GainTerm.simplify", w.terms.terms[0].simplify, {"at": w.at, "tolerance": 0.0}),
        ("GainTerm.peak", w.terms.terms[0].peak, {"at": w.at}),
        ("GainTerm.sharing", w.terms.terms[0].sharing, {"at": w.at}),
        ("FeedTerm.jones", ins.FeedTerm(rms=0.1).jones, {"at": w.at}),
        ("Parallactic.jones", ins.Parallactic().jones, {"at": w.at}),
        ("Parallactic.peak", ins.Parallactic().peak, {"at": w.at}),
        ("Chain.jones", w.terms.jones, {"at": w.at}),
        ("Chain.peak", w.terms.peak, {"at": w.at}),
        ("Chain.simplified", w.terms.simplified, {"at": w.at, "tolerance": 0.0}),
        ("Chain.factors", w.terms.factors, {"at": w.at}),
        ("StationBeam.jones", station.jones, {"at": lofar.sampling(**beam)}),
        ("Towards.jones", ins.Towards(chain=lofar.chain()).jones, {"at": lofar.sampling(**beam)}),
        ("Instrument.beam", lofar.beam, {**beam, "state": "absolute"}),
        ("Instrument.mueller", lofar.mueller, {**beam, "baseline": tuple(names), "state": "differential"}),
        ("Instrument.sampling", lofar.sampling, beam),
        ("Scene.plan", w.scene.plan, {
            "tolerance": 0.0, "engine": "direct", "memory": "1 GB", "workers": 1, "uv_range": (0.0, 1e6)}),
        ("Plan.run", w.plan.run, {"executor": None, "progress": None}),
        ("Plan.blocks", lambda **k: list(w.plan.blocks(**k)), {"executor": None, "progress": None}),
        ("Plan.verify", w.plan.verify, {"samples": 8, "seed": 0}),
        ("Visibilities.with_data", w.vis.with_data, {"data": w.vis.data}),
        ("Visibilities.flagged", w.vis.flagged, {"flag": w.vis.flag}),
        ("Visibilities.weighted", w.vis.weighted, {"weight": w.vis.weight}),
        ("Visibilities.noise_jy", w.vis.noise_jy, {"sefd": 100 * u.Jy}),
        ("Visibilities.with_noise", w.vis.with_noise, {"sefd": 100 * u.Jy, "seed": 1}),
        ("Visibilities.corrected", w.vis.corrected, {"term": w.solution.term}),
        ("Visibilities.corrupted", w.vis.corrupted, {"term": w.solution.term}),
        ("Visibilities.block", w.vis.block, {"times": slice(0, 1), "channels": slice(0, 1)}),
        ("Visibilities.save", w.vis.save, {"path": "none/v.h5", "overwrite": True}),
        ("Visibilities.open", ins.Visibilities.open, {
            "path": "none.h5", "times": slice(0, 1), "channels": slice(0, 1)}),
        ("VisibilityFile", ins.VisibilityFile, {"path": "none.h5"}),
        ("MeasurementSet", ins.MeasurementSet, {"path": "none.MS", "column": "DATA", "window": 0, "field": 0}),
        ("UVFile", ins.UVFile, {"path": "none.uvh5", "window": 0, "field": 0, "centre": "0h 0d"}),
        ("write_uvbeam", ins.write_uvbeam, {
            "path": "none/b.beamfits", "telescope": w.instrument, "time": "2012-12-07", "frequencies": 150 * u.MHz,
            "station": None, "pointing": CENTRE, "step": 45 * u.deg, "overwrite": True}),
        ("write_mueller", ins.write_mueller, {
            "path": "none/m.fits", "telescope": w.instrument, "times": "2012-12-07", "frequencies": 150 * u.MHz,
            "grid": ins.ImageGrid(pixels=2, pixel=1 * u.deg, centre=CENTRE), "baseline": "mean", "state": "absolute",
            "overwrite": True}),
        ("write_uv", ins.write_uv, {
            "path": "none/v.uvh5", "visibilities": w.vis, "overwrite": True, "precision": "single", "telescope": "X"}),
        ("write_calfits", ins.write_calfits, {
            "path": "none/v.calfits", "solution": w.solution, "at": w.at, "interval": 10 * u.s,
            "channel_width": 1 * u.MHz, "overwrite": True}),
        ("Msv4File", ins.Msv4File, {"path": "none.zarr", "name": "a", "group": "base"}),
        ("write_msv4", ins.write_msv4, {"path": "none/v.zarr", "visibilities": w.vis, "overwrite": True}),
        ("Visibilities.without_beam", w.vis.without_beam, {"instrument": w.instrument}),
        ("JonesTable.jones", w.solution.term.jones, {"at": w.at}),
        ("SelfCal.solve", ins.SelfCal().solve, {"data": w.vis, "model": w.vis}),
        ("DirectionalCal.solve", ins.DirectionalCal().solve, {"data": w.vis, "models": {"a": w.vis}}),
        ("Solution.truth", w.solution.truth, {"term": w.terms, "at": w.at}),
        ("Solution.aligned", w.solution.aligned, {"to": w.solution.truth(w.terms, w.at)}),
        ("Solution.joined", ins.Solution.joined, {"parts": [w.solution]}),
        ("IncompleteModel.run", ins.IncompleteModel(models=(1,)).run, {"plan": w.plan}),
        ("read_cube", ins.read_cube, {"stokes": "I", "unit": "K", "frequencies": freq}),
        ("read_h5parm", ins.read_h5parm, {
            "path": "none.h5", "layout": None, "direction": None, "solset": None, "soltabs": None, "missing": "error"}),
        ("write_h5parm", ins.write_h5parm, {"path": "out.h5", "solution": w.solution, "pattern": "full", "at": None}),
        ("read_frequencies", ins.read_frequencies, {"path": "none.txt"}),
        ("read_psf", ins.read_psf, {"path": "none.fits", "cube": w.cube}),
        ("recovered_power", ins.recovered_power, {
            "recovered": w.cube, "injected": w.cube, "noise": w.cube, "bins": 4, "bins_par": 3,
            "shape": "cylindrical"}),
        ("Recovered.write", w.recovered.write, {"path": "recovered.ecsv"}),
        ("SignalLoss.within", w.loss.within, {"k_par": (0.0, 1.0), "k_perp": (0.0, 9.0)}),
        ("Separation.nothing", ins.Separation.nothing, {
            "maps": np.zeros((2, 3)), "outcome": ins.Outcome.REFUSED, "remark": "none"}),
        ("StokesMaps", ins.StokesMaps, {
            "stokes": "I", "planes": {"I": w.cube.data[:, 0]}, "freq_hz": w.cube.freq_hz, "pixel_rad": 1e-3,
            "unit": "K", "psf": None}),
        ("Imager.image", ins.Imager(pixels=16, pixel=8 * u.arcmin).image, {"visibilities": w.vis}),
        ("SourceCatalogue.sky", w.found.sky, {"channel": 0}),
        ("SourceCatalogue.against", w.found.against, {"reference": w.sky, "within": 1 * u.arcmin, "least": 1 * u.Jy}),
        ("Imager.psf", ins.Imager(pixels=16, pixel=8 * u.arcmin).psf, {"visibilities": w.vis}),
        ("StokesCube", ins.StokesCube, {
            "data": np.zeros((2, 4, 3, 3)), "frequencies": [150, 151] * u.MHz, "pixel": 1 * u.arcmin, "unit": "K",
            "centre": ins.Direction(2.1, 0.8), "psf": None}),
        ("StokesCube.channels", w.cube.channels, {"keep": [0, 1]}),
        ("StokesCube.with_data", w.cube.with_data, {"data": w.cube.data}),
        ("StokesCube.write", w.cube.write, {"path": "cube.fits"}),
        ("Psf.gaussian", ins.Psf.gaussian, {"major": 3 * u.arcmin, "minor": 3 * u.arcmin, "angle": 0 * u.deg}),
        ("Psf.of", ins.Psf.gaussian(3 * u.arcmin).of, {"channels": 3}),
        ("polarized_screens", ins.polarized_screens, {
            "pixels": 16, "pixel": 8 * u.arcmin, "frequencies": [150, 151] * u.MHz, "seed": 1, "centre": CENTRE}),
        ("leaked", ins.leaked, {"cube": w.cube, "fraction": 0.01, "radius": 1 * u.deg, "frequency": 150 * u.MHz}),
        ("leaked_through", ins.leaked_through, {
            "cube": w.cube.channels([0, 1]), "instrument": lofar, "times": times, "baseline": None, "nodes": 3,
            "channels": 2}),
        ("noise_cube", ins.noise_cube, {"like": w.cube, "sigma": 1 * u.K, "psf_shaped": False, "seed": 1}),
        ("ForegroundRemover.split", w.remover.split, {"cube": w.cube}),
        ("Split.score", w.split.score, {
            "foreground": None, "k_par": 0.06, "k_perp": (0.02, 0.5), "taper": "hann", "seed": 0}),
        ("signal_loss", ins.signal_loss, {
            "remover": w.remover, "cube": w.cube, "signal": w.cube, "taper": "hann", "bins": 4, "bins_par": None,
            "infill": None}),
        ("Analyzer", ins.Analyzer, {"cube": w.cube, "visibilities": None, "sky": None, "fluxes": None, "centre": None}),
        ("Analyzer.leakage", ins.Analyzer(visibilities=w.vis, sky=w.sky).leakage, {"photometry": None, "channel": 0}),
        ("Analyzer.spectrum_2d", w.analyzer.spectrum_2d, {
            "stokes": "I", "channel": 0, "uv_range": (10.0, 100.0), "taper": "hann", "bins": 5, "log": True,
            "redshift": 8.5, "cosmology": None}),
        ("Analyzer.cylindrical", w.analyzer.cylindrical, {
            "stokes": "I", "taper": "hann", "taper_space": "hann", "uv_range": (10.0, 400.0), "bins": 4, "bins_par": 3,
            "log": True, "paper_axis": False, "cross": None, "psf_corrected": False, "infill": None, "redshift": 8.5,
            "cosmology": None}),
        ("Analyzer.spherical", w.analyzer.spherical, {
            "stokes": "I", "taper": "hann", "taper_space": "hann", "uv_range": (10.0, 400.0), "bins": 4, "log": True,
            "wedge": 1 * u.deg, "k_par_min": 0.01, "cross": None, "psf_corrected": False, "infill": None,
            "redshift": 8.5, "cosmology": None}),
        ("Analyzer.delay_spectrum", ins.Analyzer(visibilities=w.vis).delay_spectrum, {
            "solid_angle": 0.1 * u.sr, "stokes": "I", "taper": None, "across_times": False,
            "bins": 4, "redshift": 8.5, "cosmology": None}),
        ("Analyzer.eor_window", w.analyzer.eor_window, {
            "signal": w.signal, "stokes": "I", "noise": None, "wedge": 1 * u.deg, "k_par_min": 0.01, "bins": 4,
            "bins_par": 3}),
        ("Analyzer.rm_synthesis", w.analyzer.rm_synthesis, {
            "depths": depths, "stokes": "P", "weights": None, "lambda2_0": None, "spectral_index": None,
            "divide_by_i": False, "precision": None, "out": None, "noise": None, "progress": None}),
        ("Leakage.inside", w.leak.inside, {"radius_deg": 1.0}),
        ("Leakage.rings", w.leak.rings, {"edges_deg": (0.1, 1.0)}),
        ("Leakage.write", w.leak.write, {"path": "leakage.ecsv"}),
        ("FaradayBand.of", ins.FaradayBand.of, {
            "frequencies": [150, 151] * u.MHz, "weights": None, "channel_width": 0.2 * u.MHz}),
        ("FaradayCube.rmsf_at", w.faraday.rmsf_at, {"depths": depths}),
        ("FaradayCube.clean", w.faraday.clean, {
            "cutoff": None, "sigmas": 5.0, "gain": 0.1, "iterations": 3, "progress": None}),
        ("FaradayCube.peaks", w.faraday.peaks, {"snr": 8.0, "noise": 1.0}),
        ("FaradayCube.write", w.faraday.write, {"path": "faraday.fits"}),
        ("depth_of_k_par", ins.depth_of_k_par, {"k_par": 0.1, "freq_hz": 1.5e8, "cosmology": None}),
        ("k_par_of_depth", ins.k_par_of_depth, {"depths": 1.0, "freq_hz": 1.5e8, "cosmology": None}),
        ("Cylindrical.wedge", w.cylinders.wedge, {"angle": 1 * u.deg}),
        ("Cylindrical.average", w.cylinders.average, {"model": np.ones_like}),
        ("Signal21cm.table", ins.Signal21cm.table, {"name": w.signal.name}),
        ("Signal21cm.inside", w.signal.inside, {"k": 0.1}),
        ("Signal21cm.delta2", w.signal.delta2, {"k": 0.1}),
        ("Signal21cm.power", w.signal.power, {"k": 0.1}),
        ("Signal21cm.cylindrical", w.signal.cylindrical, {"k_perp": 0.1, "k_par": 0.1}),
        ("Signal21cm.cube", w.signal.cube, {
            "pixels": 8, "pixel": 4 * u.arcmin, "frequencies": [150, 150.5, 151] * u.MHz, "seed": 1, "periodic": True,
            "redshift": 8.5, "cosmology": None}),
        ("EoRWindow.ratio", w.window.ratio, {"removed": 0.5}),
        ("EoRWindow.mask", w.window.mask, {"removed": 0.5}),
        ("EoRWindow.area", w.window.area, {"removed": 0.5}),
        ("EoRWindow.reach", w.window.reach, {"removed": 0.5, "share": 1.0}),
        ("EoRWindow.removal_needed", w.window.removal_needed, {"k_par": 0.5}),
        ("EoRWindow.write", w.window.write, {"path": "window.ecsv"}),
        ("CubeAnalysis.run", ins.CubeAnalysis(products=("spherical",)).run, {"cube": w.cube, "noise": None}),
        ("CubeAnalysis.refusals", ins.CubeAnalysis().refusals, {"cube": w.cube}),
        ("ixr.ixr_of_leakage", ins.ixr.ixr_of_leakage, {"leakage": 0.1}),
        ("mueller.mueller", ins.mueller.mueller, {"jones_a": eye, "jones_b": eye}),
        ("mueller.leakage", ins.mueller.leakage, {"matrices": np.eye(4)[None]}),
        ("ixr.leakage_of_ixr", ins.ixr.leakage_of_ixr, {"ixr_db": 20.0}),
        ("mueller.brightness", ins.mueller.brightness, {"stokes": np.ones((1, 4))}),
        ("mueller.stokes", ins.mueller.stokes, {"matrices": eye}),
        ("mueller.di_errors", ins.mueller.di_errors, {"jones_a": eye, "jones_b": eye}),
        ("mueller.ixr_jones", ins.mueller.ixr_jones, {"jones": eye}),
        ("Component.to_json", w.scene.to_json, {"indent": 1}),
        ("Component.from_json", ins.Component.from_json, {"text": w.sky.to_json()}),
    ]  # fmt: skip
    things = [w.layout, w.observation, w.sky, w.terms, w.instrument, w.scene, w.solution.term, ins.SelfCal(), lofar]
    things += [
        ins.DirectionalCal(),
        ins.IncompleteModel(models=(1,)),
        ins.Imager(pixels=16, pixel="1 arcmin"),
        ins.CleanImager(pixels=16, pixel="1 arcmin"),
        ins.BeamImager(pixels=16, pixel="1 arcmin"),
        ins.SourceFinder(),
        ins.GainTerm(),
    ]
    things += [ins.FeedTerm(), ins.CubeAnalysis(), station, ins.load("skies", "grid"), w.remover]
    things += [
        ins.load("skies", "random", count=3),
        ins.load("skies", "faraday"),
        ins.load("elements", "dipole", height="0.5 m"),
    ]
    things += [ins.load("stages", "noise", sefd="100 Jy", seed=1), ins.load("stages", "analyze")]
    things += [ins.load("foregrounds", n) for n in ("gmca", "pca", "faraday-filter", "gpr")]
    things += [*station.parts(), station.levels[0]]
    for thing in things:
        named = {info.alias or k: None for k, info in type(thing).model_fields.items()}
        out.append((type(thing).__name__, thing.with_fields, named))
    for thing in (w.vis, w.leak, w.cylinders, w.window, w.signal, w.spheres, w.plane, w.loss, ins.BeamState()):
        given = {f.name: getattr(thing, f.name) for f in fields(thing) if f.init}
        out.append((type(thing).__name__, type(thing), given))
    return out


def poisoned():
    """(what, call, arguments with one of them poisoned, its name, the poison's name, its annotation)."""
    for what, call, valid in calls():
        one_by_one = isinstance(getattr(call, "__self__", None), Component) and call.__name__ == "with_fields"
        hints = inspect.signature(call).parameters
        for name in valid:
            hint = str(hints[name].annotation) if name in hints else "Any"
            for poison, value in POISON.items():
                given = {name: value} if one_by_one else {**valid, name: value}
                yield what, call, given, name, poison, hint


def silently_taken(what, name, poison, hint, thing):
    """Whether an accepted value has no business there."""
    if (what, name, poison) in MEANT:
        return False
    if poison in ("nan", "inf"):
        return True
    if poison == "True":
        return "bool" not in hint and not _field_is(thing, name, "bool")
    if poison == "-1":
        return name in COUNTS
    return False


def _field_is(call, name, word):
    owner = getattr(call, "__self__", None)
    info = getattr(type(owner), "model_fields", {}).get(name)
    return info is not None and word in str(info.annotation)


def walk(one_each=False):
    """(refused in one line, accepted, each traceback and silent acceptance in words)."""
    refused, taken, faults = 0, 0, []
    for number, (what, call, given, name, poison, hint) in enumerate(poisoned()):
        if one_each and (number // len(POISON) - number) % len(POISON):
            continue
        label = f"{what}({name}={poison})"
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                call(**given)
        except InstrumentError as error:
            refused += 1
            if "\n" in str(error) or len(str(error)) > 500:
                faults.append(f"{label}: not one line: {str(error)[:200]!r}")
        except Exception as error:  # what a user would see as a traceback
            faults.append(f"{label}: {type(error).__name__}: {str(error)[:120]}")
        else:
            taken += 1
            if silently_taken(what, name, poison, hint, call):
                faults.append(f"{label}: accepted")
    return refused, taken, faults


@pytest.mark.long
def test_b7_every_argument_of_the_public_api_is_accepted_with_a_meaning_or_refused_in_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # "2" is a fine name of a file
    refused, taken, faults = walk()
    assert faults == []
    assert refused > 2500
    assert taken > 200


def test_b7_one_poison_at_each_argument(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refused, _, faults = walk(one_each=True)
    assert faults == []
    assert refused > 350


def test_b7_the_walk_reaches_every_class_and_function_that_is_exported():
    walked = {what.split(".")[0] for what, _, _ in calls()} | {type(w).__name__ for w in vars(world()).values()}
    walked |= {c.__name__ for _, call, _ in calls() for c in type(getattr(call, "__self__", None)).__mro__}
    missing = [
        name
        for name in ins.__all__
        if name not in walked | NOT_WALKED and not inspect.ismodule(getattr(ins, name)) and callable(getattr(ins, name))
    ]
    assert missing == []


def test_b7_the_walk_can_fail():
    def careless(seed=0):
        return 1 / seed

    given = [("careless", careless, {"seed": 1})]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(globals(), "calls", lambda: given)
        _, _, faults = walk()
    assert len(faults) >= 4
    assert is_dataclass(ins.Visibilities)
