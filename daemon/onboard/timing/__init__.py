"""Instants: clocks told by one another, and which frame and mark belong to which pulse."""
