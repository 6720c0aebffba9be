"""Full-Jones self-calibration of every integration: this package and DP3's gaincal, side by side.

    pip install ".[peers,test]" && python docs/reports/selfcal_speed.py [--times 2874] [--runs 3]

25 sources of 5 Jy, errors of rms 1e-3 in every term of every station, new in each integration, no noise, data and model
stored as complex64. Both are timed as whole processes, in turn: ours reads data and model from a file, solves each
integration and saves the solutions; gaincal reads them from a Measurement Set and writes an h5parm, with
tolerance 1e-8. The error is that of the corrected data against the model. Writes selfcal_speed.md beside this file.
"""

import argparse
import os
import platform
import sys
import tempfile
from datetime import date
from importlib.metadata import version
from pathlib import Path

import numpy as np
from astropy import units as u
from peers import DP3, peer_tools, timed

HERE = Path(__file__).parent
OURS = """
import pickle, sys
import numpy as np
from instrument import SelfCal, write_h5parm
at, a1, a2, interval = pickle.load(open(sys.argv[1] + "/at.pickle", "rb"))
from instrument import Visibilities
load = lambda name: Visibilities(np.load(f"{sys.argv[1]}/{name}.npy").astype(complex), at, a1, a2, interval)
data, model = load("data"), load("model")
solution = SelfCal(tolerance=float(sys.argv[2])).solve(data, model)
solution.check()
write_h5parm(sys.argv[1] + "/ours.h5", solution, at=at, overwrite=True)
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=2874)
    parser.add_argument("--runs", type=int, default=3)
    given = parser.parse_args()
    import pickle

    import instrument
    from instrument import Chain, FeedTerm, GainTerm, Observation, Scene, read_h5parm

    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        lofar_ms = peer_tools(folder)
        import casacore.tables as tables

        lofar = instrument.load("telescopes", "lofar-hba", beam=None)
        night = Observation(
            phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=10 * given.times * u.s,
            interval=10 * u.s, frequencies=[150] * u.MHz, channel_width=0.19 * u.MHz,
        )  # fmt: skip
        sky = instrument.load("skies", "grid", shape=(5, 5), spacing=1 * u.deg, flux=5 * u.Jy)
        model = Scene(instrument=lofar, sky=sky, observation=night).plan().run()
        data = model.corrupted(Chain(GainTerm(rms=1e-3, seed=1), FeedTerm(rms=1e-3, seed=2)))
        stored = {"DATA": data.data.astype(np.complex64), "MODEL_DATA": model.data.astype(np.complex64)}
        lofar_ms.make_ms(folder / "cal.MS", lofar.with_fields(beam_kind="full"), night, columns=tuple(stored))
        with tables.table(str(folder / "cal.MS"), readonly=False, ack=False) as ms:
            for name, values in stored.items():
                ms.putcol(name, values.swapaxes(1, 2).reshape(-1, 1, 4))
        np.save(folder / "data.npy", stored["DATA"])
        np.save(folder / "model.npy", stored["MODEL_DATA"])
        with open(folder / "at.pickle", "wb") as file:
            pickle.dump((model.at, model.antenna1, model.antenna2, model.interval_s), file)
        gaincal = [sys.executable, "-c", DP3, f"msin={folder}/cal.MS", "msout=", "steps=[gaincal]"]
        gaincal += ["gaincal.caltype=fulljones", "gaincal.usemodelcolumn=true", f"gaincal.parmdb={folder}/theirs.h5"]
        gaincal += ["gaincal.solint=1", "gaincal.tolerance=1e-8", "gaincal.maxiter=200", "gaincal.detectstalling=false"]
        gaincal += ["numthreads=2"]
        ways = {f"ours, tolerance {t}": [sys.executable, "-c", OURS, str(folder), t] for t in ("1e-5", "1e-10")}
        ways["DP3 gaincal, tolerance 1e-8"] = gaincal
        timed(ways["ours, tolerance 1e-5"], dict(os.environ))  # compiled once
        spent = {name: [] for name in ways}
        error = {}
        for _ in range(given.runs):
            for name, command in ways.items():
                spent[name].append(timed(command, os.environ | {"OPENBLAS_NUM_THREADS": "1"}))
                file = "ours.h5" if "ours" in name else "theirs.h5"
                term = read_h5parm(folder / file, layout=data.layout)
                left = data.with_data(stored["DATA"].astype(complex)).corrected(term).data - model.data
                error[name] = float(np.sqrt(np.mean(np.abs(left) ** 2) / np.mean(np.abs(model.data) ** 2)))
                print(f"{name}: {spent[name][-1][0]:.1f} s, {error[name]:.1e}", flush=True)
    reference = spent["DP3 gaincal, tolerance 1e-8"]
    rows = []
    for name, runs in spent.items():
        ratio = np.median([d[0] / o[0] for o, d in zip(runs, reference, strict=True)])
        seconds = ", ".join(f"{r[0]:.1f}" for r in runs)
        rows.append(f"| {name} | {min(r[0] for r in runs):.1f} ({seconds}) | {ratio:.1f} | {error[name]:.1e} |")
    used = {"numpy": "numpy", "numba": "numba", "DP3": "dp3", "instrument": "instrument"}
    text = f"""# Full-Jones self-calibration of {given.times} integrations: seconds beside DP3

{date.today()}, {os.cpu_count()} cores ({platform.machine()}), Python {platform.python_version()},
{", ".join(f"{k} {version(v)}" for k, v in used.items())}.
59 stations, 25 sources of 5 Jy, errors of rms 1e-3, complex64 data; whole processes in turn, {given.runs} times.
Made by `python docs/reports/selfcal_speed.py --times {given.times} --runs {given.runs}`.

| solver | best wall time, s (all) | gaincal takes so many times as long | corrected - model, rms relative |
|---|---|---|---|
{chr(10).join(rows)}

Errors are bounded by the rounding of complex64 (2.5e-8 in the data alone); on complex128 data see tests/accuracy.
"""
    (HERE / "selfcal_speed.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
