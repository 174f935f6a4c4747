"""Ground points and blocks from a landed mission."""
