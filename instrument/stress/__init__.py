"""Named extreme cases with right answers: what comes out of each, in digits."""

MODULES = (
    "cases_engines", "cases_exact", "cases_beam", "cases_mueller", "cases_places", "cases_sky", "cases_skies",
    "cases_calibration", "cases_solutions", "cases_sources", "cases_imaging", "cases_clean", "cases_images",
    "cases_maps", "cases_cubes", "cases_depths", "cases_power", "cases_scatter", "cases_window", "cases_removal",
    "cases_foregrounds", "cases_run",
)  # fmt: skip
