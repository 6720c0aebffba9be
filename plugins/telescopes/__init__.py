"""Telescopes: layouts and chains of real arrays."""
