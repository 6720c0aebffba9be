"""Plugins of `instrument`: element beams, telescopes and foreground removers, found through entry points."""
