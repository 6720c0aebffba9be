"""The whole of the cases in one seeded order: so many of each kind, with every fixed one among them."""

import random
from itertools import islice
from pathlib import Path

from fuzzing import commands, files, settings
from fuzzing.harness import Case

SHARES = {  # of the cases that are drawn
    settings.scenes: 0.2,
    settings.sets: 0.18,
    settings.plausible: 0.16,
    files.catalogues: 0.18,
    files.cubes: 0.12,
    files.solutions: 0.08,
    commands.options: 0.08,
}


def cases(count: int, seed: int, folder: Path) -> list[Case]:
    """Cases in random order: all fixed ones where they are fewer than a third of `count`, or a sample of them."""
    rng = random.Random(seed)
    made = files.Seeds(folder)
    fixed = [*files.no_files(made), *commands.odd_words()]
    chosen = fixed if 3 * len(fixed) <= count else rng.sample(fixed, count // 3)
    left = count - len(chosen)
    for source, share in SHARES.items():
        inner = random.Random(rng.randrange(1 << 60))
        given = source(inner) if source.__module__.endswith("settings") else source(inner, made)
        chosen += islice(given, round(share * left))
    rng.shuffle(chosen)
    return chosen
