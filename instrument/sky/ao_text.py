"""The text of AO sky models: blocks of keywords between braces, as components with their place, shape and flux."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from instrument.files_in import SHOWN, harmless
from instrument.sky.bbs_text import Line, angle, broken

TOKEN = re.compile(r'"([^"]*)"|([{}])|([^\s{}"]+)')
HERTZ = {"hz": 1.0, "khz": 1e3, "mhz": 1e6, "ghz": 1e9}
KNOWN = {
    "source": ("name", "component"),
    "component": ("type", "position", "shape", "sed", "measurement"),
    "sed": ("frequency", "fluxdensity", "spectral-index"),
    "measurement": ("frequency", "fluxdensity"),
}
VALUES = {"name": 1, "type": 1, "position": 2, "shape": 3, "frequency": 2, "fluxdensity": 5}
LIST = "spectral-index"


@dataclass
class Block:
    """A block or a keyword with its values: its line, and what stands in it by keyword, in the order of the file."""

    line: int
    values: list[str] = field(default_factory=list)
    inside: dict[str, list[Block]] = field(default_factory=dict)


@dataclass
class Component:
    """One component: radians, Jy, Hz, the spectral index as a list of one or none."""

    line: int
    name: str
    patch: str
    place: tuple[float, float]
    shape: tuple[float, float, float]
    freq_hz: float
    stokes: list[float]
    terms: list[float]


class _Tokens:
    """What stands in a file, one after the other, with the line of the latest."""

    def __init__(self, path: Path, lines: Sequence[str]) -> None:
        self.path, self.line = path, 0
        self.rest = self._all(lines)

    def _all(self, lines: Sequence[str]) -> Iterator[tuple[str, bool]]:
        started = False
        for self.line, text in enumerate(lines, 1):
            if not started:
                started = bool(text.strip()) and not text.lstrip().startswith("#")
                continue  # the line that names the format
            if text.lstrip().startswith("#"):
                continue
            for found in TOKEN.finditer(text):
                yield (found[1], True) if found[1] is not None else (found[2] or found[3], False)

    def next(self, what: str) -> tuple[str, bool]:
        """The next one and whether it was quoted; raises `FileError` at the end of the file."""
        found = next(self.rest, None)
        if found is None:
            raise broken(self.path, self.line, f"the file ends where {what} is due: it is cut off")
        return found

    def value(self, what: str) -> str:
        """The next one, which must be no brace."""
        text, quoted = self.next(what)
        if text in ("{", "}") and not quoted:
            raise broken(self.path, self.line, f"'{text}' where {what} is due")
        return text

    def open(self, keyword: str) -> None:
        """The brace after a keyword."""
        if self.next("{") != ("{", False):
            raise broken(self.path, self.line, f"{keyword} without {{")


def _block(tokens: _Tokens, kind: str) -> Block:
    """A block whose opening brace has been read."""
    out = Block(tokens.line)
    while True:
        word, quoted = tokens.next("}")
        if word == "}" and not quoted:
            return out
        if quoted or word not in KNOWN[kind]:
            shown = harmless(word, SHOWN)
            raise broken(tokens.path, tokens.line, f"'{shown}' in a {kind}: known are {', '.join(KNOWN[kind])}")
        if word in KNOWN:
            tokens.open(word)
            out.inside.setdefault(word, []).append(_block(tokens, word))
            continue
        one = Block(tokens.line)
        if word == LIST:
            tokens.open(word)
            while (found := tokens.next("}")) != ("}", False):
                one.values.append(found[0])
        else:
            one.values = [tokens.value(f"a value of {word}") for _ in range(VALUES[word])]
        if word in out.inside:
            raise broken(tokens.path, tokens.line, f"{word} stands twice in a {kind}")
        out.inside[word] = [one]


def components(path: Path, lines: Sequence[str]) -> list[Component]:
    """Every component of the file; raises `FileError` with the line."""
    tokens, out = _Tokens(path, lines), []
    while (found := next(tokens.rest, None)) is not None:
        if found != ("source", False):
            raise broken(path, tokens.line, f"'{harmless(found[0], SHOWN)}' where a source is due")
        tokens.open("source")
        source = _block(tokens, "source")
        name, parts = _one(path, source, "name", "source").values[0], source.inside.get("component", [])
        for k, part in enumerate(parts):
            several = len(parts) > 1
            out.append(_component(path, part, f"{name}:{k + 1}" if several else name, name if several else ""))
    return out


def _one(path: Path, block: Block, word: str, kind: str) -> Block:
    if word not in block.inside:
        raise broken(path, block.line, f"a {kind} without {word}")
    return block.inside[word][0]


def _reals(path: Path, block: Block, what: str, values: Sequence[str]) -> list[float]:
    out = []
    for text in values:
        try:
            out.append(float(text))
        except ValueError:
            raise broken(path, block.line, f"{what} = '{harmless(text, SHOWN)}' is not a number") from None
        if not np.isfinite(out[-1]):
            raise broken(path, block.line, f"{what} = '{harmless(text, SHOWN)}' is not finite")
    return out


def _component(path: Path, part: Block, name: str, patch: str) -> Component:
    kind = _one(path, part, "type", "component").values[0].lower()
    if kind not in ("point", "gaussian"):
        raise broken(path, part.line, f"type '{harmless(kind, SHOWN)}' cannot be kept; point and gaussian can")
    position = _one(path, part, "position", "component")
    line = Line(path, position.line, dict(zip(("ra", "dec"), position.values, strict=True)))
    ra, dec = angle(line, "Ra"), angle(line, "Dec")
    assert ra is not None and dec is not None  # both are there, or `angle` raises
    size = (0.0, 0.0, 0.0)
    if kind == "gaussian":
        shape = _one(path, part, "shape", "gaussian")
        a, b, c = _reals(path, shape, "shape", shape.values)
        size = (float(np.deg2rad(a / 3600)), float(np.deg2rad(b / 3600)), float(np.deg2rad(c)))
    spectra = part.inside.get("sed", []) + part.inside.get("measurement", [])
    if len(spectra) != 1:
        what = f"has fluxes at {len(spectra)} frequencies" if spectra else "has no sed or measurement"
        raise broken(path, part.line, f"'{harmless(name, SHOWN)}' {what}; give it one sed with a spectral-index")
    return Component(part.line, name, patch, (ra, dec), size, *_spectrum(path, name, spectra[0]))


def _spectrum(path: Path, name: str, block: Block) -> tuple[float, list[float], list[float]]:
    freq, flux = (_one(path, block, word, "spectrum") for word in ("frequency", "fluxdensity"))
    if freq.values[1].lower() not in HERTZ or flux.values[0].lower() != "jy":
        unit = freq.values[1] if freq.values[1].lower() not in HERTZ else flux.values[0]
        raise broken(path, block.line, f"unit '{harmless(unit, SHOWN)}'; frequencies in MHz and fluxes in Jy are read")
    hertz = _reals(path, freq, "frequency", freq.values[:1])[0] * HERTZ[freq.values[1].lower()]
    if hertz <= 0:
        raise broken(path, freq.line, f"frequency = {hertz:g} Hz must be above 0")
    given: Any = block.inside.get(LIST)
    terms = _reals(path, given[0], LIST, given[0].values) if given else []
    if any(terms[1:]):
        raise broken(
            path, given[0].line, f"'{harmless(name, SHOWN)}' has a curved spectrum, which programs take with natural "
            "or common logarithms; write it as BBS text"
        )  # fmt: skip
    return hertz, _reals(path, flux, "fluxdensity", flux.values[1:]), terms[:1]
