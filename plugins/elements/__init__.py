"""Element beams: the pattern of one antenna."""
