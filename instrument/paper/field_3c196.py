"""The field of 3C196 without gain errors: leakage of its brightest sources, and Q, U, V over I in its spectra."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.analyze.analyzer import Analyzer
from instrument.analyze.power.spectra import Spectrum2D
from instrument.analyze.sources.leakage import Leakage
from instrument.paper.bench import Bench
from instrument.paper.finding import Finding
from instrument.pipeline.record import Result
from instrument.report.figures import bubbles
from instrument.report.spectra import spectra_2d

BRIGHT = 33
RANGE = (30.0, 800.0)  # wavelengths


def field(bench: Bench) -> tuple[str, ...]:
    """Settings of the sky: the shipped catalogue, or for a seed another field of the recipe that it was made by."""
    return () if bench.seed is None else (f'sky={{kind="mock-3c196", components=true, seed={bench.seed}}}',)


def run(bench: Bench) -> list[Finding]:
    """The scene `3c196` in both forms of the spectrum, and what its V is made of."""
    result = _seen(bench)
    found: Leakage = result.stages["analyze"].parts[0].leakage  # type: ignore[attr-defined]
    assert found.expected is not None
    bright = np.argsort(-found.model_jy[:, 0])[:BRIGHT]
    of_beam, measured = found.expected[bright, 0], found.linear_percent[bright]
    clear = found.measured[bright] & ~found.near_null[bright]
    cube = result.stages["image"].cube  # type: ignore[attr-defined]
    seen, plain = _spectra(cube, "hann"), _spectra(cube, None)
    q, u, v = _shares(seen)
    rims = dict(zip("QUV", _shares(plain), strict=True))
    orders = float(np.log10(np.hypot(q, u) / np.sqrt(2) / v))
    q_real, u_real, v_real = _shares(_spectra(_dipoles(bench), "hann"))
    real = float(np.log10(np.hypot(q_real, u_real) / np.sqrt(2) / v_real))
    bench.draw("linear", bubbles(found, kind="linear"), "Leakage of I into linear polarization, source by source.")
    bench.draw("spectra", spectra_2d(seen), "2D power spectra of the images, Hann taper.")
    # 0.05 to 0.06: to half a digit of what is printed
    both = (0.045, 0.065)
    return [
        # "up to 4 %", and "most" below 2: none above 4, some above 2
        Finding("largest leakage of the 33 brightest, by the beam", float(of_beam.max()), "%", "up to 4", (2.0, 4.0)),
        Finding("share of them below 2 %, by the beam", 100 * float(np.mean(of_beam < 2)), "%", "most", (50.0, 100.0)),
        Finding("the same, measured", 100 * float(np.mean(measured < 2)), "%"),
        Finding("largest measured, of those known to 0.25 % of I", float(measured[clear].max()), "%"),
        Finding("how many of the 33 those are", float(clear.sum())),
        *[
            Finding(
                f"{stokes} over I in the 2D spectrum, rms", value, "%", "0.05 to 0.06", both,
                f"{rims[stokes]:.3f} % without the taper, which weighs the rim of the field down"
                if not both[0] <= value <= both[1] else "", changed=rims[stokes],
            )
            for stokes, value in (("Q", q), ("U", u))
        ],
        Finding("V over I, rms", v, "%"),
        Finding(
            "V below Q and U, orders of the rms", orders, "", "almost 4", (3.5, 4.0),
            f"{2 * orders:.1f} orders of the power; V is what the element's complex patterns make: with dipoles of "
            f"real patterns it is {real:.1f} orders below; the paper's own grid has 0.003 % of V at most to 0.5 % of "
            "P, 2.2 orders",
        ),
    ]  # fmt: skip


def _seen(bench: Bench) -> Result:
    """Fluxes of 4567 sources take seconds an integration: of the catalogue the quick form has the 400 brightest."""
    some = ("sky.brightest=400", "analyze.every=1") if bench.seed is None else ("analyze.every=2",)
    quick = ("observation.interval=1200 s", "observation.duration=8 h", *some)
    return bench.run("3c196", *field(bench), *bench.choose(quick, ("analyze.every=60",)))


def _dipoles(bench: Bench) -> Any:
    """Images of the 400 brightest by stations of crossed dipoles, whose patterns are real."""
    few = ("sky.brightest=400", "observation.interval=1200 s", "observation.duration=8 h")
    dipole = 'instrument.element={kind="dipole", height="0.45 m"}'
    found = bench.run("3c196", *few, dipole, 'analyze={products=["spectrum-2d"]}')
    return found.stages["image"].cube  # type: ignore[attr-defined]


def _spectra(cube: Any, taper: Any) -> dict[str, Spectrum2D]:
    return {s: Analyzer(cube).spectrum_2d(s, uv_range=RANGE, taper=taper, bins=10) for s in ("I", "Q", "U", "V")}


def _shares(spectra: dict[str, Spectrum2D]) -> list[float]:
    """Rms of Q, U and V over that of I in %, over all k."""
    mean = {name: float(np.nanmean(one.power)) for name, one in spectra.items()}
    return [float(100 * np.sqrt(mean[s] / mean["I"])) for s in "QUV"]
