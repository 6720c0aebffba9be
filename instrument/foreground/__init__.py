"""Removers of foregrounds: their base, what a split says of itself, and how much signal they lose."""
