"""Foreground removers."""
