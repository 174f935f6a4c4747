"""What becomes of a landed mission's frames: bands, heads, Level-3."""
