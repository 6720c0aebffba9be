"""Analysis of images and visibilities: leakage, Faraday depth, power spectra, the EoR window."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules=["ixr"])
