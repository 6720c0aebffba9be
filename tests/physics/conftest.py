"""Quick forms of the paper's experiments, and which of its numbers they are known to miss: no others, and no fewer."""

import pytest

from instrument.paper.bench import Bench
from instrument.paper.experiments import experiment
from instrument.paper.finding import NOT

MISSED = {
    "beam": {"length of the baseline"},  # 129.0 m by survey, the paper 127
    "di-errors": {
        "S as in the paper, rms 1e-3",  # 0.0046 %: the gauge, and how the paper's solver leaves it is not known
        "QU as in the paper, rms 1e-3",  # 0.0023, of 60 intervals; 0.0019 of 960
        "image, corrupted less corrected, rms 1e-3",  # takes two changes
    },
    "galactic": {
        "I at Faraday depth 0 over I at that of P, power",  # 0.43: the bright place of so small a mock decides
        "peak of the leakage for 5 K of P, inside half power",  # 9.1 mK, in channels and pixels that are coarse
        "k up to which the spherical leakage is below the signal, field of 4 deg",  # 3.5 times the noise is asked
    },
    "gmca": {"power below k_par 0.06 /Mpc before over after, quiet"},  # 21; 50 with all channels and pixels
    "aw-correction": {"leakage removed, the best source, normalised"},  # more than the paper's 80 %
    "3c196": {
        "U over I in the 2D spectrum, rms",  # 0.042; 0.065 without the taper, the range ends there
        "V below Q and U, orders of the rms",  # 2.9, the paper almost 4
    },
    "incomplete-model": {"3C196 alone: residual image, of its rms"},  # 1.5 with 32 integrations; 1.13 with 96
}


@pytest.fixture(scope="session")
def paper_quick():
    """`paper_quick(name, folder, seed=None)`: findings of an experiment by what they are."""
    return _found


def _found(name, folder, seed=None):
    """Findings of an experiment by what they are."""
    bench = Bench(folder, quick=True, seed=seed)
    findings = experiment(name)(bench)
    missed = {f.what for f in findings if f.agreement == NOT}
    known = MISSED.get(name, set())
    assert missed == known if seed is None else missed <= known  # other skies may come out right
    assert len({f.what for f in findings}) == len(findings)  # the keys of run.json
    assert bench.figures
    return {f.what: f for f in findings}
