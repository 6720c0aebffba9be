"""Sources: their fluxes and positions out of visibilities, and the leakage that they show."""
