"""Skies: point and Gaussian sources, generated fields, and readers of catalogues."""
