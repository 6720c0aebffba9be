"""Hostile input of every kind is done whole or refused in one line: no traceback, hang, flood of memory or half folder.

The default run takes a small sample; `long` 300; `--fuzz 3000` thousands, with the seed `--fuzz-seed`.
"""

import pytest
from fuzzing.choose import cases

SAMPLE, LONG = 12, 300


def faults(zygote, count, seed):
    """The cases that went wrong, as text."""
    found = (zygote.judge(case) for case in cases(count, seed, zygote.folder / "seeds"))
    return [str(verdict) for verdict in found if not verdict.good]


def test_a_sample_of_hostile_input_is_done_or_refused(zygote):
    assert faults(zygote, SAMPLE, 20261125) == []


@pytest.mark.long
def test_hundreds_of_hostile_inputs_are_done_or_refused(zygote, request):
    count = request.config.getoption("--fuzz", default=None) or LONG
    assert faults(zygote, count, request.config.getoption("--fuzz-seed", default=None) or 1) == []


@pytest.mark.long
def test_what_the_mutations_start_from_is_accepted(zygote):
    """Or nothing behind the door would ever be tried."""
    from fuzzing import files, seeds
    from fuzzing.harness import Case
    from fuzzing.settings import written

    made = files.Seeds(zygote.folder / "seeds")
    run = ("run", "s.toml", "--no-verify", "--out", "o")
    analyze = ("analyze", "c.fits", "--products", "faraday", "--depths=-5,5,1", "--out", "o")
    healthy = [Case(name, "healthy", written("s.toml", text), run) for name, text in seeds.SCENES.items()]
    for ext, content in made.catalogues.items():
        scene = written("s.toml", seeds.CATALOGUE.replace("PATH", f"c.{ext}"))
        healthy.append(Case(ext, "healthy", files.both(scene, written(f"c.{ext}", content)), run))
    healthy += [Case(name, "healthy", written("c.fits", content), analyze) for name, content in made.cubes.items()]
    healthy.append(Case("h5parm", "healthy", written("s.h5", made.solutions), call="read_h5parm", path="s.h5"))
    assert [str(found) for found in map(zygote.judge, healthy) if found.verdict != "done"] == []
