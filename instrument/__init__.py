"""A radio interferometer as an object composed of Jones terms, and its errors followed the whole way.

Everything a script needs is importable from here; modules are loaded when a name is first used. The names stand in
`__init__.pyi`, which type checkers read as well.
"""

import lazy_loader

__version__ = "0.1.0"
__getattr__, _, _names = lazy_loader.attach_stub(__name__, __file__)
__all__ = sorted([*_names, "__version__"])


def __dir__() -> list[str]:
    return __all__
