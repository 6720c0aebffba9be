"""A scene, its plan, and the check of the fast engine against the definition."""

from astropy import units as u

import instrument
from instrument import FeedTerm, GainTerm, Observation, Scene

lofar = instrument.load(
    "telescopes",
    "lofar-hba",
    stations=["CS001HBA0", "CS001HBA1", "CS002HBA0", "CS301HBA1", "RS106HBA", "RS406HBA"],
    gain=GainTerm(rms=1e-2, seed=1),
    feed=FeedTerm(rms=1e-2, seed=2),
)
night = Observation(
    phase_centre="08h13m36.0s +48d13m03s",
    transit="2012-12-07",
    duration=8 * u.hour,
    interval=5 * u.min,
    frequencies=[140, 150, 160] * u.MHz,
    channel_width=0.2 * u.MHz,
)
sky = instrument.load("skies", "random", count=300, radius=5 * u.deg, polarization=0.1, seed=3)

plan = Scene(name="errors", instrument=lofar, sky=sky, observation=night).plan()
print(plan, "\n")
total = sum(abs(block.data).sum() for block in plan.blocks())  # memory stays that of a block
vis = plan.run()  # or all at once
print(f"{vis.data.shape} (times, channels, baselines, 2, 2); sum of magnitudes {total:.6g} Jy")
print(plan.verify(vis, samples=200, seed=0))  # what was produced, against the definition
