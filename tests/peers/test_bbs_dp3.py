import subprocess, sys, warnings
import numpy as np, pytest
from astropy import units as u
import instrument
from instrument import Observation, Scene
from instrument.sky.readers import read
from instrument.sky.bbs import write_bbs
import casacore.tables as tables

PREDICT = "from dp3 import entrypoint; import sys; sys.exit(entrypoint())"
HEAD = "FORMAT = Name, Type, Ra, Dec, I, Q, U, V, ReferenceFrequency='150e6', SpectralIndex='[]', LogarithmicSI, MajorAxis, MinorAxis, Orientation, OrientationIsAbsolute, RotationMeasure, PolarizedFraction, PolarizationAngle, ReferenceWavelength"
P = "08:20:13.5, +46.10.03"
C = "08:13:40, +48.13.30"
F = "08:40:13.5, +49.10.03"
CASES = {
    "log": f"a, POINT, {P}, 2, 0.3, -0.2, 0.1, , [-0.7, 0.3, -0.1], , , , , , , , ,",
    "linear": f"a, POINT, {P}, 2, 0.3, -0.2, 0.1, , [-0.7, 0.3], false, , , , , , , ,",
    "fraction": f"a, POINT, {P}, 2, , , 0.1, , [], , , , , , 1.3, 0.4, 0.7,",
    "fraction_si": f"a, POINT, {P}, 2, , , , , [-0.7, 0.2], , , , , , 1.3, 0.4, 0.7,",
    "qu_ref": f"a, POINT, {P}, 2, 0.5, -0.3, , , [-0.7, 0.2], , , , , , 1.3, , ,",
    "qu_wave": f"a, POINT, {P}, 2, 0.5, -0.3, , , [-0.7, 0.2], , , , , , 1.3, , , 2.5",
    "negra": "a, POINT, -15:46:24, -00.30.15, 2, 0, 0, 0",
    "gauss_abs": f"a, GAUSSIAN, {F}, 2, 0, 0, 0, , [], , 90, 30, 33, true, , , ,",
    "gauss_abs_swapped": f"a, GAUSSIAN, {F}, 2, 0, 0, 0, , [], , 30, 90, 33, true, , , ,",
    "gauss_centre": f"a, GAUSSIAN, {C}, 2, 0, 0, 0, , [], , 90, 30, 33, , , , ,",
    "gauss_rel": f"a, GAUSSIAN, {F}, 2, 0, 0, 0, , [], , 90, 30, 33, , , , ,",
}


@pytest.fixture(scope="module")
def rig(make_ms, peer_environment, tmp_path_factory):
    folder = tmp_path_factory.mktemp("dp3")
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s",
        transit="2012-12-07",
        duration=8 * u.hour,
        interval=80 * u.min,
        frequencies=[120, 180] * u.MHz,
        channel_width=0.2 * u.MHz,
    )
    tel = instrument.load(
        "telescopes",
        "lofar-hba",
        beam=None,
        stations=["CS001HBA0", "CS002HBA0", "CS005HBA0", "CS011HBA1", "CS302HBA0", "CS501HBA0", "CS103HBA0"],
    )
    make_ms(folder / "night.MS", instrument.load("telescopes", "lofar-hba", stations=list(tel.stations)), night)

    def predict(text):
        (folder / "sky.txt").write_text(text)
        s = {
            "msin": folder / "night.MS",
            "msout": ".",
            "msout.datacolumn": "PREDICTED",
            "steps": "[predict]",
            "predict.sourcedb": folder / "sky.txt",
            "numthreads": 2,
        }
        done = subprocess.run(
            [sys.executable, "-c", PREDICT, *(f"{k}={v}" for k, v in s.items())],
            env=peer_environment,
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
        with tables.table(str(folder / "night.MS"), ack=False) as ms:
            f = ms.getcol("PREDICTED")
        return f.reshape(night.count, -1, 2, 2, 2).swapaxes(1, 2)

    return folder, night, tel, predict


@pytest.mark.parametrize("case", CASES)
def test_case(rig, case):
    folder, night, tel, predict = rig
    text = HEAD + "\n" + CASES[case] + f"\nb, POINT, {P}, 1e-7, 0, 0, 1e-7\n"
    theirs = predict(text)
    (folder / "x.skymodel").write_text(text)
    sky = read(folder / "x.skymodel", night.phase_centre)

    def ours(s):
        return Scene(instrument=tel, sky=s, observation=night).plan(engine="direct").run().data

    rms = lambda a, b: np.sqrt(np.mean(abs(a - b) ** 2) / np.mean(abs(b) ** 2))
    o = ours(sky)
    print(case, "error %.2e" % rms(o, theirs), "mean |V|/S %.3f" % (abs(theirs[..., 0, 0]).mean() / 2))
    if "gauss" in case and case != "gauss_centre":
        for d in (-10, 10):
            print("   turned", d, "%.2e" % rms(ours(sky.with_fields(angle_rad=sky.angle_rad + np.deg2rad(d))), theirs))
        print(
            "   unconverted %.2e" % rms(ours(sky.with_fields(angle_rad=[np.deg2rad(33), 0])), theirs),
            np.rad2deg(sky.angle_rad),
        )
    write_bbs(folder / "y.skymodel", sky)
    print("   written, by DP3: %.2e" % rms(predict((folder / "y.skymodel").read_text()), o))


def test_spectra(rig):
    folder, night, tel, predict = rig
    for case in ("fraction", "fraction_si", "qu_ref", "qu_wave"):
        text = (
            HEAD
            + "\n"
            + CASES[case].replace(P, "08:13:36.0, +48.13.03")
            + f"\nb, POINT, 08:13:36.0, +48.13.03, 1e-7, 0, 0, 1e-7\n"
        )
        b = predict(text)[0, :, 0]
        print(
            case,
            "DP3",
            np.stack(
                [
                    (b[:, 0, 0] + b[:, 1, 1]).real / 2,
                    (b[:, 0, 0] - b[:, 1, 1]).real / 2,
                    b[:, 0, 1].real,
                    b[:, 0, 1].imag,
                ],
                1,
            ),
        )
        (folder / "x.skymodel").write_text(text)
        print("ours", read(folder / "x.skymodel", night.phase_centre).stokes(np.array([120e6, 180e6]))[:, 0])
