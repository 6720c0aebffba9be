"""Provenance: what made a file, and of which scene and seed where a run says so; every writer asks here."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from importlib import metadata

FITS_KEYS = {  # of what is known, and what it is
    "object": ("OBJECT", "name of the scene"),
    "start": ("DATE-OBS", "start of the observation, UTC"),
    "seed": ("SEED", "of all that the scene draws"),
    "scene": ("SCENE", "hash of the scene: run.json has it"),
    "software": ("CREATOR", "what wrote this file"),
    "written": ("DATE", "when, UTC"),
}
_KNOWN: ContextVar[dict[str, str | int] | None] = ContextVar("provenance", default=None)
_COMMAND: ContextVar[str] = ContextVar("command", default="")


@contextmanager
def provenance(**known: str | int | None) -> Iterator[None]:
    """Files written inside say what is known: `object`, `start`, `seed`, `scene`."""
    token = _KNOWN.set({name: value for name, value in known.items() if value is not None})
    try:
        yield
    finally:
        _KNOWN.reset(token)


@contextmanager
def commanded(words: str) -> Iterator[None]:
    """What is done inside, a command line has asked for."""
    token = _COMMAND.set(words)
    try:
        yield
    finally:
        _COMMAND.reset(token)


def command() -> str:
    """The command line at work, "" for none."""
    return _COMMAND.get()


def written_by() -> dict[str, str | int]:
    """What a file that is written now says of itself, by name, the keys of `FITS_KEYS`."""
    now = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S")
    return {**(_KNOWN.get() or {}), "software": f"instrument {metadata.version('instrument')}", "written": now}


def fits_cards() -> list[tuple[str, str | int, str]]:
    """The same as cards of a FITS header: keyword, value, comment."""
    out = []
    for name, value in written_by().items():
        text = value if isinstance(value, int) else value.encode("ascii", "replace").decode()[:67]  # what a card holds
        out.append((FITS_KEYS[name][0], text, FITS_KEYS[name][1]))
    return out
