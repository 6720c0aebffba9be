"""Faraday depth: synthesis, RM-CLEAN, peaks, and the files of cubes in depth."""
