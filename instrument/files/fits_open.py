"""Opens FITS files from outside: regular files, packed or not, whose declared sizes fit what is there."""

from __future__ import annotations

import bz2
import gzip
import lzma
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from instrument.errors import FileError, InputError
from instrument.files_in import harmless, open_regular
from instrument.units import si_prefix

PACKED: dict[bytes, Any] = {b"\x1f\x8b": gzip.GzipFile, b"BZh": bz2.BZ2File, b"\xfd7zXZ": lzma.LZMAFile}
MOST_TIMES = 100  # a packed file may unpack to: images of noise shrink to 0.8, masks to 0.05; a bomb to 0.001
MOST_UNITS = 4096  # HDUs of a file
MOST_COLUMNS = 999  # of a table, as the standard has it: more are made one by one, for hours


class _Unpacked:
    """A packed file as a plain one that refuses to be longer than a limit, before it is unpacked so far."""

    def __init__(self, file: Any, limit: int, name: str) -> None:
        self.file, self.limit, self.name, self.mode = file, limit, name, "rb"

    def _within(self, end: int) -> None:
        if end > self.limit:
            size = si_prefix(self.limit, "B")
            raise FileError(f"{self.name} unpacks to more than {size}, {MOST_TIMES} times its size: unpack it first")

    def read(self, size: int = -1) -> bytes:
        """Some bytes, or all of them."""
        found: bytes = self.file.read(self.limit + 1 - self.tell() if size is None or size < 0 else size)
        self._within(self.tell())
        return found

    def seek(self, offset: int, whence: int = 0) -> int:
        """Go to a place; from the end, all is unpacked, piece by piece."""
        if whence == 2:
            while self.read(1 << 20):
                pass
            whence = 1
        self._within(offset + (self.tell() if whence == 1 else 0))
        return int(self.file.seek(offset, whence))

    def tell(self) -> int:
        """The place."""
        return int(self.file.tell())

    def close(self) -> None:
        """Close it."""
        self.file.close()


@contextmanager
def opened(path: Path, what: str = "is not a readable FITS file") -> Iterator[Any]:
    """The HDUs of a FITS file; anything that its parser raises becomes a `FileError` of one line.

    Its own handle is passed on, never its name: a name such as "http://..." would be fetched.
    """
    from astropy.io import fits
    from astropy.utils.exceptions import AstropyWarning

    name = harmless(path.name or path)
    try:
        with open_regular(path, what="FITS file") as handle, warnings.catch_warnings():
            warnings.simplefilter("ignore", AstropyWarning)  # of keywords that it mends
            with fits.open(_plain(handle, name)) as hdus:
                yield hdus
    except (InputError, MemoryError):
        raise
    except Exception as error:  # its parser raises of every kind on headers that are broken
        raise FileError(f"{name} {what}: {_said(error)}") from None


def _plain(handle: BinaryIO, name: str) -> Any:
    size = handle.seek(0, 2)
    handle.seek(0)
    if not size:
        raise FileError(f"{name} is not a readable FITS file: it is empty")
    start = handle.read(6)
    handle.seek(0)
    for magic, kind in PACKED.items():
        if start.startswith(magic):
            packed = kind(fileobj=handle) if kind is gzip.GzipFile else kind(handle)
            return _Unpacked(packed, MOST_TIMES * size, name)
    if start.startswith(b"PK\x03\x04") or start.startswith(b"\x1f\x9d"):
        raise FileError(f"{name} is packed (zip or compress): unpack it first")
    return handle


def units_of(hdus: Any, name: str) -> Iterator[tuple[int, Any]]:
    """The HDUs with their numbers; raises `FileError` for one whose declared data are more than the file holds."""
    for k in range(MOST_UNITS):
        try:
            hdu = hdus[k]
        except IndexError:
            return
        if not hdu.is_image and not 0 <= int(hdu.header.get("TFIELDS", 0)) <= MOST_COLUMNS:
            raise FileError(f"{name}: a table of {hdu.header['TFIELDS']} columns, FITS has at most {MOST_COLUMNS}")
        place = hdu.fileinfo()
        there, start = int(place["file"].size), int(place["datLoc"])
        declared = int(hdu.size)
        # tiles of an image may be packed well, but not without end
        holds = MOST_TIMES * int(place["datSpan"]) if hasattr(hdu, "compression_type") else there - start
        if declared > holds:
            shape = f"{' x '.join(str(n) for n in reversed(hdu.shape))}, " if hdu.is_image else ""
            said = (
                f"declares data of {shape}{si_prefix(float(declared), 'B')}, more than it has ({si_prefix(there, 'B')})"
            )
            raise FileError(f"{name}: its header {said}: fetch it again, or correct NAXISn")
        yield k, hdu
    raise FileError(f"{name} has more than {MOST_UNITS} parts (HDUs): take out the image that is meant")


def _said(error: Exception) -> str:
    """First line of what an error says, harmless and not long."""
    return harmless((str(error) or type(error).__name__).splitlines()[0], 120)
