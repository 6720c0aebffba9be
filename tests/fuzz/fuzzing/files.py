"""Cases of files that are read: catalogues of every format, FITS cubes, h5parm, and names that are no files."""

import os
import random
import socket
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fuzzing import mutations, seeds
from fuzzing.harness import Case
from fuzzing.settings import verb, written

PRODUCTS = [("--products", "faraday", "--depths=-5,5,1")] * 2 + [
    ("--products", n) for n in ("spectrum-2d", "cylindrical")
]


class Seeds:
    """Healthy files of every format, made once in a folder."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.catalogues = seeds.catalogues(folder)
        self.cubes = seeds.cubes(folder)
        self.solutions = seeds.solutions(folder)


def both(*setups):
    """Several setups in one."""

    def setup(folder: Path) -> None:
        for one in setups:
            one(folder)

    return setup


def catalogues(rng: random.Random, made: Seeds) -> Iterator[Case]:
    """Catalogues mutated, named by a scene."""
    while True:
        ext = rng.choice(["skymodel", "csv", "ecsv", "vot", "fits", "skyh5", *seeds.PROGRAMS])
        how = {"fits": mutations.fits, "skyh5": rng.choice([mutations.flipped, mutations.cut])}.get(ext)
        how = how or rng.choice([mutations.text, mutations.number, mutations.words])
        content = how(rng, made.catalogues[ext])
        scene = seeds.CATALOGUE.replace("PATH", f"c.{ext}")
        setup = both(written(f"c.{ext}", content), written("s.toml", scene))
        yield Case(f"catalogue {ext}", f"catalogues, {ext}", setup, verb(rng), text=how.__name__)


def cubes(rng: random.Random, made: Seeds) -> Iterator[Case]:
    """FITS cubes mutated, given to `analyze`."""
    while True:
        content = made.cubes[rng.choice(["cube", "cube", "beams"])]
        how = mutations.pixels if rng.random() < 0.15 else mutations.fits
        argv = ("analyze", "c.fits", "--out", "o", *rng.choice([*PRODUCTS, ()]))
        yield Case("cube", "FITS cubes", written("c.fits", how(rng, content)), argv, text=how.__name__)


def solutions(rng: random.Random, made: Seeds) -> Iterator[Case]:
    """h5parm files with bytes flipped, or made wrong in structure."""
    while True:
        seed, how = rng.randrange(1 << 30), rng.random()

        def setup(folder: Path, seed: int = seed, how: float = how) -> None:
            inner, path = random.Random(seed), folder / "s.h5"
            path.write_bytes(made.solutions)
            if how < 0.5:
                path.write_bytes(inner.choice([mutations.flipped, mutations.cut])(inner, made.solutions))
            else:
                _restructured(inner, path)

        yield Case("h5parm", "h5parm", setup, call="read_h5parm", path="s.h5", text=f"seed {seed}")


def _restructured(rng: random.Random, path: Path) -> None:
    """One thing of an h5parm replaced by what should not be there."""
    import h5py

    with h5py.File(path, "r+") as file:
        table = file["sol000"][rng.choice(["amplitude000", "phase000"])]
        axis, how = rng.choice(["time", "freq", "ant", "pol", "val", "weight"]), rng.randrange(18)
        values = {
            1: np.array([np.nan] * 3), 2: np.array(5.0), 3: np.array([3.0, 2.0, 1.0]), 4: np.array([b"A"] * 5),
            5: np.zeros(3, dtype=[("a", "f8"), ("b", "S4")]), 6: h5py.SoftLink("/nowhere"),
            7: h5py.ExternalLink("other.h5", f"/sol000/phase000/{axis}"), 8: np.array(["\xe9", "x"], dtype=object),
        }  # fmt: skip
        if how <= 8 or how in (9, 10, 11):
            del table[axis]
        if how == 8:
            table.create_dataset(axis, data=values[8], dtype=h5py.string_dtype())
        elif how in values:
            table[axis] = values[how]
        elif how == 9:
            table.create_group(axis)
        elif how == 10:
            table.create_dataset(axis, shape=(10**9,), dtype="f8", chunks=(1024,))
        elif how == 11:
            table.create_dataset(axis, shape=(10**6, 10**6), dtype="f8", chunks=(1024, 1024))
        elif how == 12:
            table["val"].attrs["AXES"] = rng.choice(
                [b"", b"time", b"time,freq,ant,pol,dir", b"\xff\xfe", 5, b"time,time"]
            )
        elif how == 13:
            table.attrs["TITLE"] = rng.choice([b"amplitude", b"clock", b"\xff", 7, b""])
        elif how == 14:
            table["val"][...] = rng.choice([np.nan, np.inf, -1e308, 1e308])
        elif how == 15:
            table["weight"][...] = rng.choice([np.nan, -1.0, 1e30])
        elif how == 16:
            file.create_group("sol001")
        elif how == 17:
            table["loop"] = table


def _socket(path: Path) -> None:
    bound = socket.socket(socket.AF_UNIX)
    here = os.getcwd()
    os.chdir(path.parent)  # names of sockets are at most 107 characters long
    try:
        bound.bind(path.name)
    finally:
        os.chdir(here)
        bound.close()


def _sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(20 * 10**9)


NO_FILES = {
    "folder": Path.mkdir,
    "pipe": os.mkfifo,
    "dangling": lambda path: path.symlink_to("/nowhere"),
    "loop": lambda path: path.symlink_to(path.name),
    "secret": lambda path: path.symlink_to("/etc/passwd"),
    "zeros": lambda path: path.symlink_to("/dev/zero"),
    "nothing": lambda path: path.symlink_to("/dev/null"),
    "memory": lambda path: path.symlink_to("/proc/self/mem"),
    "terminal": lambda path: path.symlink_to("/dev/tty"),
    "empty": Path.touch,
    "socket": _socket,
    "sparse": _sparse,
    "missing": lambda path: None,
}


def no_files(made: Seeds) -> Iterator[Case]:
    """Every kind of thing that is no regular file, at every place that takes a name."""

    def at(name: str, what: str):
        return lambda folder: NO_FILES[what](folder / name)

    plain = written("s.toml", seeds.SCENE)
    for what in NO_FILES:
        yield Case(f"scene {what}", "no files", at("s.toml", what), ("plan", "s.toml"))
        for ext in made.catalogues:
            scene = written("s.toml", seeds.CATALOGUE.replace("PATH", f"c.{ext}"))
            yield Case(f"{ext} {what}", "no files", both(scene, at(f"c.{ext}", what)), ("plan", "s.toml"))
        yield Case(f"cube {what}", "no files", at("c.fits", what), ("analyze", "c.fits", "--out", "o"))
        noise = both(written("c.fits", made.cubes["cube"]), at("n.fits", what))
        words = ("analyze", "c.fits", "--out", "o", "--products", "faraday", "--depths=-5,5,1", "--noise", "n.fits")
        yield Case(f"noise {what}", "no files", noise, words)
        yield Case(f"h5parm {what}", "no files", at("s.h5", what), call="read_h5parm", path="s.h5")
        run = ("run", "s.toml", "--no-verify", "--out", "o")
        # a folder or a link to one may be written into; its target lies outside of the case for "dangling"
        if what != "dangling":
            yield Case(f"out {what}", "no files", both(plain, at("o", what)), run)
