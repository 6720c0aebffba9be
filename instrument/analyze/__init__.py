"""Analysis of images and visibilities: leakage of sources."""
