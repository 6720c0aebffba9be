"""Catalogues, sky models and tables that the framework carries; provenance in README.md beside them."""
