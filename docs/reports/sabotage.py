"""One station, baseline, time or channel with a flipped sign in what the engine produced: is it found?

    python docs/reports/sabotage.py [--times 288] [--channels 64] [--cases 40] [--small]

A scene of 59 stations is planned; its blocks stream by once for each case with the sign of one thing flipped, as a run
sees them, and are checked as they pass. A thing that was among the times and channels looked at must be found, so the
share that is found is to be the share that the check prints. Writes sabotage.md beside this file.
"""

import argparse
import platform
import time
from dataclasses import replace
from datetime import date
from importlib.metadata import version
from pathlib import Path

import numpy as np
from astropy import units as u

import instrument
from instrument import Observation, Scene

HERE = Path(__file__).parent
KINDS = ("station", "baseline", "time", "channel")
TIMES = {"station": 1, "baseline": 1, "time": 5, "channel": 1}  # more cases of what is found by chance


def scene(times, channels, stations=()):
    lofar = instrument.load("telescopes", "lofar-hba", **({"stations": stations} if stations else {}))
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s",
        transit="2012-12-07",
        duration=times * 100 * u.s,
        interval=100 * u.s,
        frequencies=(150 + 0.2 * np.arange(channels)) * u.MHz,
        channel_width=0.2 * u.MHz,
    )
    sky = instrument.load("skies", "grid", shape=(2, 2), spacing=1 * u.deg, flux=1 * u.Jy)
    return Scene(name="sabotage", instrument=lofar, sky=sky, observation=night)


def flipped(block, kind, k, plan):
    """A block with the sign of the k-th station, baseline, time or channel turned."""
    data = block.data.copy()
    if kind == "station":
        data[:, :, (block.antenna1 == k) | (block.antenna2 == k)] *= -1
    elif kind == "baseline":
        data[:, :, k] *= -1
    elif kind == "time":
        data[block.at.slots_s == plan.problem.at.slots_s[k]] *= -1
    else:
        data[:, block.freq_hz == plan.problem.at.freq_hz[k]] *= -1
    return block.with_data(data)


def piece(blocks, plan, t, f):
    """One time and channel of the blocks."""
    times, channels = plan.block_shape
    block = blocks[(t // times) * -(-plan.problem.shape[1] // channels) + f // channels]
    i, j = slice(t % times, t % times + 1), slice(f % channels, f % channels + 1)
    return replace(block, data=block.data[i, j], at=block.at.block(i, j))


def hunt(plan, cases, rng):
    """Cases found and looked at of each kind, the check of whole data, processor seconds of prediction and check."""
    begin = time.process_time()
    blocks = list(plan.blocks())
    predicted = time.process_time() - begin
    times, channels, baselines = plan.problem.shape
    sizes = dict(zip(KINDS, (len(plan.problem.at.layout), baselines, times, channels), strict=True))
    found, looked = dict.fromkeys(KINDS, 0), dict.fromkeys(KINDS, 0)
    for kind in KINDS:
        for seed in range(cases * TIMES[kind]):
            checker = plan.watched(seed=seed).checker
            k = int(rng.integers(sizes[kind]))
            for t, f in checker.chosen():  # of the blocks, what the check looks at
                checker.see(flipped(piece(blocks, plan, t, f), kind, k, plan))
            found[kind] += not checker.result().passed
            axis = {"time": 0, "channel": 1}.get(kind)
            looked[kind] += axis is None or k in {cell[axis] for cell in checker.chosen()}
    watched = plan.watched(seed=0)
    begin = time.process_time()
    for block in blocks:
        watched.checker.see(block)
    return found, looked, watched.check, predicted, time.process_time() - begin


def looked_at(plan, cases=4000):
    """Of so many times drawn, how many are among those that a check looks at, every check with a seed of its own."""
    times, rng = plan.problem.shape[0], np.random.default_rng(1)
    checks = [plan.watched(seed=seed).checker.cells for seed in range(200)]
    return sum(int(rng.integers(times)) in checks[k % 200] for k in range(cases)), cases


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=288)
    parser.add_argument("--channels", type=int, default=64)
    parser.add_argument("--cases", type=int, default=40)
    given = parser.parse_args()
    plan = scene(given.times, given.channels).plan(memory="12 GB")
    few = replace(plan, problem=plan.problem.block(slice(0, 2), slice(None)))
    for _ in few.blocks():
        pass  # compiled
    found, looked, check, predicted, spent = hunt(plan, given.cases, np.random.default_rng(0))
    hits, drawn = looked_at(plan)
    share = {"station": 1.0, "baseline": 1.0}
    share |= {"time": check.times.seen / check.times.of, "channel": check.channels.seen / check.channels.of}
    rows = [
        f"| {kind} | {found[kind]} of {(n := given.cases * TIMES[kind])} | {looked[kind]} | {share[kind] * n:.1f} |"
        for kind in KINDS
    ]
    text = f"""# Flipped signs in what an engine produced

{date.today()}, {platform.machine()}, Python {platform.python_version()}, numpy {version("numpy")},
numba {version("numba")}, instrument {version("instrument")}.
Made by `python docs/reports/sabotage.py --times {given.times} --channels {given.channels} --cases {given.cases}`.

59 stations, {given.times} times, {given.channels} channels, 4 sources. One thing has its sign turned in the data
as they stream by; every case has its own seed. Unspoilt data: {check}.

| flipped | found | was looked at | due by the share that is printed |
|---|---|---|---|
""" + "\n".join(rows)
    text += f"""

Times are looked at by chance: of {drawn} drawn {hits} were among those looked at, {drawn * share["time"]:.0f} are due.

Processor time: the check {spent:.2f} s, the prediction {predicted:.1f} s, {100 * spent / predicted:.1f} %
of it, and of a run that does nothing else.
"""
    (HERE / "sabotage.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
