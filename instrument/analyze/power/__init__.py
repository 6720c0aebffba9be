"""Power spectra: Fourier cells, bins, spectra of images and cubes, the EoR window."""
