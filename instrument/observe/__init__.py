"""Where antennas are, when and at what frequency they look, and where a source is seen from there."""
