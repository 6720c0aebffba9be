"""What Asad et al. (2015) did, run again: an experiment a file; add one in `experiments.py`."""
