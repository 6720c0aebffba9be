"""Shipped scenes, as TOML files."""
