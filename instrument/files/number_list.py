"""Text files of numbers, one a line: frequencies, weights and the like of the channels of a cube."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from instrument.checked import checked
from instrument.errors import FileError
from instrument.files_in import harmless, read_regular
from instrument.units import Float

MOST_BYTES = 16 << 20  # a million channels of 16 digits


def read_numbers(path: str | os.PathLike[str], what: str = "numbers") -> Float:
    """Finite numbers (N,) of a text file, one a line; empty lines and what follows a '#' are left out.

    Raises `FileError` in one line with the number of the line that is none.
    """
    content = read_regular(path, MOST_BYTES, "list of numbers")
    name = harmless(Path(path).name)
    found = []
    for k, line in enumerate(content.decode("utf-8", errors="replace").splitlines(), 1):
        if not (text := line.partition("#")[0].strip()):
            continue
        try:
            value = float(text)
        except ValueError:
            raise FileError(f"{name}, line {k}: not a number; needed {what}, one a line") from None
        if not np.isfinite(value):
            raise FileError(f"{name}, line {k}: {value} is not finite; needed {what}, one a line")
        found.append(value)
    if not found:
        raise FileError(f"{name} holds no number: needed {what}, one a line")
    return np.array(found)


@checked
def read_frequencies(path: str | os.PathLike[str]) -> Any:
    """Frequencies of a text file, in Hz, one a line, as a `Quantity` (F,): for `read_cube(..., frequencies=...)`."""
    from astropy import units as u

    return read_numbers(path, "frequencies in Hz") * u.Hz
