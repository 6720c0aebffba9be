"""pyuvdata: opened when it is needed, quiet, without downloads; what it refuses is one line of ours."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from instrument.errors import FileError, InputError
from instrument.files_in import harmless

MISSING = "UVFITS and UVH5 need pyuvdata: pip install 'instrument[uv]'"
KINDS = {".uvfits": "uvfits", ".uvh5": "uvh5"}
# its numbers of correlations, those of AIPS, and casacore's
CORRELATIONS = {1: 1, 2: 2, 3: 3, 4: 4, -1: 5, -3: 6, -4: 7, -2: 8, -5: 9, -7: 10, -8: 11, -6: 12}


def library() -> Any:
    """The module; raises `InputError` with the way to get it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import pyuvdata
    except ImportError:
        raise InputError(MISSING) from None
    return pyuvdata


@contextmanager
def told(path: str | os.PathLike[str]) -> Iterator[None]:
    """Its failures as `FileError`s about a file; its warnings are kept back, and nothing is downloaded."""
    from astropy.utils import iers

    try:
        with warnings.catch_warnings(), iers.conf.set_temp("auto_download", False):
            warnings.simplefilter("ignore")
            yield
    except (InputError, MemoryError):
        raise
    except Exception as error:  # of fifty kinds, KeyError to UnicodeError, as files are broken
        text = " ".join((str(error) or type(error).__name__).split())
        raise FileError(f"{harmless(path)}: {harmless(text, 300)}") from None
