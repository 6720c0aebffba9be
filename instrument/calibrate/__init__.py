"""Calibration: solvers of gains and Jones matrices from data and a model, and what they leave undetermined."""
