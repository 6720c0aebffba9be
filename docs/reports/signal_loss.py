"""Signal loss of every foreground remover: a 21-cm cube injected into leaked polarization, and what is left of it.

    pip install ".[test,ica]" && python docs/reports/signal_loss.py [--pixels 480]

Writes signal_loss.md beside this file. Per (k_perp, k_par): `signal_loss(remover, cube, signal).write("loss.ecsv")`.
"""

import argparse
import warnings
from importlib.metadata import version
from pathlib import Path

from astropy import units as u
from leakage_cubes import asked, leakage, made, merged, observed, since

from instrument import InstrumentWarning, signal_loss
from instrument.analyze.power.signal import Signal21cm

HERE = Path(__file__).parent
BANDS = ((0.0, 0.03), (0.03, 0.06), (0.06, 0.1), (0.1, 0.3), (0.3, 1.0))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pixels", type=int, default=480)
    parser.add_argument("--only", default="", help="removers, a comma between: their rows in the page that is there")
    given = parser.parse_args()
    truth = leakage(given.pixels, seed=196)
    model = Signal21cm.table()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InstrumentWarning)  # scales outside the table get no power
        signal = model.cube(given.pixels, 0.5 * u.arcmin, truth.freq_hz * u.Hz, seed=21)
    page, tables = HERE / "signal_loss.md", []
    for number, case in enumerate(("quiet (0.2 mK)", "60 mK white", "60 mK PSF-shaped")):
        cube = observed(truth, case, seed=1)
        rows = {}
        for name, remover in asked(given.only).items():
            loss = signal_loss(remover, cube, signal)
            found = [loss.within(band, (0.02, 0.5)) for band in BANDS]
            rows[name] = f"| {name} | " + " | ".join(f"{t:.2f} / {p:.2f}" for t, p in found) + " |"
            print(case, rows[name], flush=True)
        head = " | ".join(f"{a:g} - {b:g}" for a, b in BANDS)
        tables.append(
            f"## {case}\n\n| remover | {head} |\n|---|{'---|' * len(BANDS)}\n" + merged(page, given.only, rows, number)
        )
    text = f"""# Signal left by every foreground remover

{since(page, given.only)}, instrument {version("instrument")}.
Made by `python docs/reports/signal_loss.py --pixels {given.pixels}`.
{made(given.only)}
A 21-cm cube of `{model.name}` ({1e3 * signal.data[:, 0].std():.1f} mK rms a voxel) is added to 7.1 mK of leaked
polarization and noise, {given.pixels} x {given.pixels} x 161, and what the removal leaves of it is compared with it,
for 0.02 < k_perp < 0.5 /Mpc in bands of k_par in 1/Mpc (delay 0 left out). First the transfer Re <d s*> / <s s*>, then
the power ratio <d d*> / <s s*>: 1 is no loss. A power ratio above the square of the transfer is power that is not the
signal's.

{(chr(10) * 2).join(tables)}
"""
    page.write_text(text)
    print(text)


if __name__ == "__main__":
    main()
