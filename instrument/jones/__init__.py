"""Jones terms: gains, feeds, element and station beams, parallactic rotation, and chains of them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules=["mueller"])
