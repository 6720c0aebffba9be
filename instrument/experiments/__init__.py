"""Experiments: a scene predicted, corrupted and solved many times, and what that tells."""
