"""A radio interferometer as an object composed of Jones terms, and its errors followed the whole way.

Everything a script needs is importable from here; modules are loaded when a name is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_HOME = {
    "Component": "component",
    "available": "registry",
    "load": "registry",
    "InputError": "errors",
    "InstrumentError": "errors",
    "InstrumentWarning": "errors",
    "Outcome": "errors",
    "Direction": "units",
    "Layout": "observe.layout",
    "Observation": "observe.observation",
    "Sampling": "observe.sampling",
    "ImageGrid": "observe.grid",
    "Sky": "sky.base",
    "PlacedSky": "sky.base",
    "PointSky": "sky.points",
    "ImageSky": "sky.image",
    "JonesTerm": "jones.base",
    "ScalarTerm": "jones.base",
    "ElementBeam": "jones.base",
    "Simplified": "jones.base",
    "Chain": "jones.chain",
    "GainTerm": "jones.gain",
    "FeedTerm": "jones.feed",
    "Parallactic": "jones.parallactic",
    "StationBeam": "jones.station",
    "ArrayFactor": "jones.station",
    "Level": "jones.station",
    "Towards": "jones.towards",
    "Instrument": "model",
    "Composed": "model",
    "Predictor": "predict.base",
    "Prepared": "predict.base",
    "Work": "predict.base",
    "ImageOperator": "predict.operator",
    "Scene": "scene",
    "Plan": "plan",
    "Visibilities": "visibilities",
    "BeamState": "beam_state",
    "VisibilitySet": "visibilities",
    "VisibilityFile": "visibility_sets",
    "JonesTable": "jones.table",
    "Calibrator": "calibrate.base",
    "Solution": "calibrate.base",
    "DirectionalCal": "calibrate.directional",
    "IncompleteModel": "experiments.incomplete_model",
    "Spectrum2D": "analyze.power.spectra",
    "SelfCal": "calibrate.selfcal",
    "read_cube": "files.fits",
    "read_frequencies": "files.number_list",
    "read_h5parm": "files.solutions",
    "read_psf": "files.fits_psf",
    "write_h5parm": "files.solutions",
    "AnyImager": "image.base",
    "Imager": "image.dirty",
    "StokesCube": "image.cube",
    "Psf": "image.cube",
    "polarized_screens": "image.mocks",
    "leaked": "image.mocks",
    "leaked_through": "image.beam_leakage",
    "noise_cube": "image.mocks",
    "ForegroundRemover": "foreground.base",
    "Separation": "foreground.separation",
    "StokesMaps": "foreground.maps",
    "Split": "foreground.base",
    "signal_loss": "foreground.loss",
    "SignalLoss": "foreground.loss",
    "Analyzer": "analyze.analyzer",
    "Leakage": "analyze.sources.leakage",
    "FaradayBand": "analyze.faraday.band",
    "FaradayCube": "analyze.faraday.cube",
    "depth_of_k_par": "analyze.faraday.band",
    "k_par_of_depth": "analyze.faraday.band",
    "Cylindrical": "analyze.power.cylinders",
    "Spherical": "analyze.power.cylinders",
    "Signal21cm": "analyze.power.signal",
    "EoRWindow": "analyze.power.window",
    "CubeAnalysis": "pipeline.stages.cube",
    "Stage": "pipeline.stage",
    "StageRun": "pipeline.stage",
    "StageResult": "pipeline.stage",
}
_MODULES = ("conformance", "ixr", "mueller", "units")
__all__ = [*_HOME, *_MODULES, "__version__"]

if TYPE_CHECKING:
    from instrument.component import Component as Component
    from instrument.errors import InputError as InputError
    from instrument.registry import available as available
    from instrument.registry import load as load


def __getattr__(name: str) -> Any:
    if name in _HOME:
        found = getattr(import_module(f"instrument.{_HOME[name]}"), name)
        globals()[name] = found
        return found
    if name in _MODULES:
        home = {"mueller": "jones.mueller", "ixr": "analyze.ixr"}
        return import_module(f"instrument.{home.get(name, name)}")
    raise AttributeError(f"module 'instrument' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted(__all__)
