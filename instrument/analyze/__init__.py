"""Analysis of images and visibilities: leakage, Faraday depth, power spectra, the EoR window."""
