"""Products of a mission's frames: bands, heads, Level-3."""
