"""Right answers of the cases of `instrument stress`, from closed forms in 40 digits: python stress_references.py.

Needs mpmath (in the extra 'test'). Writes instrument/stress/references.json, which the package carries; the test
tests/accuracy/test_stress.py runs it again and compares.
"""

import json
from pathlib import Path

from mpmath import cos, exp, log, matrix, mp, mpc, mpf, pi, sin, sinc, sqrt, svd_c

mp.dps = 40
LIGHT = mpf(299792458)
TARGET = Path(__file__).parents[2] / "instrument" / "stress" / "references.json"


def fringe(cycles):
    return exp(-2j * pi * cycles)


def values():
    found = {}
    # w (n - 1) of l = sin(1e-6) at w = 1e7; exact values of the float64 inputs
    found["near_cycles"] = mpf(10) ** 7 * (cos(mpf(1e-6)) - 1)
    found["far_fringe"] = fringe(mpf(3e8) * sin(mpf(0.3)))
    b = sqrt(mpf(3.125) ** 2 + mpf(4.25) ** 2)
    found["sphere"] = 4 * pi * sin(2 * pi * b) / (2 * pi * b)
    found["cancelled"] = fringe(mpf(1000) * sin(mpf(0.01)))
    d = mpc(0.25, -0.125)
    found["ixr_hermitian"] = 1 / abs(d) ** 2
    a, c = matrix([[1, mpc(0.5, 0.25)], [mpf(0.125), mpf(2)]]), matrix([[mpc(1, -1), mpf(0.5)], [mpf(-0.25), 3]])
    conditions = []
    for one in (a, c):
        s = svd_c(one, compute_uv=False)
        conditions.append(max(s) / min(s))
    found["kron_condition"] = conditions[0] * conditions[1]
    # a Burn slab of depth 8 rad/m2 at 150 MHz: sin(x)/x with x = 8 lambda^2
    x = mpf(8) * (LIGHT / mpf(150e6)) ** 2
    found["burn"] = sinc(x)
    # depolarization by a scatter of 0.1 rad/m2 at 150 MHz
    found["scatter"] = exp(-2 * mpf(0.1) ** 2 * (LIGHT / mpf(150e6)) ** 4)
    # peak of the first side lobe region of a Gaussian source: FWHM 1e-3 rad at 300 wavelengths
    found["gaussian"] = exp(-(pi**2) / (4 * log(2)) * (mpf(1e-3) * 300) ** 2)
    return found


def text():
    numbers = {}
    for name, value in values().items():
        numbers[name] = [float(value.real), float(value.imag)] if isinstance(value, mpc) else float(value)
    held = {"from": "docs/reports/stress_references.py, mpmath, 40 digits", "values": numbers}
    return json.dumps(held, indent=1) + "\n"


if __name__ == "__main__":
    TARGET.write_text(text())
