"""Named extreme cases with right answers: what comes out of each, in digits."""

MODULES = (
    "cases_engines", "cases_beam", "cases_calibration", "cases_imaging", "cases_cubes", "cases_foregrounds",
    "cases_run",
)  # fmt: skip
