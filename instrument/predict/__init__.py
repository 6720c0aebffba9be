"""Engines that predict visibilities: `direct` is the definition, the others are fast."""
