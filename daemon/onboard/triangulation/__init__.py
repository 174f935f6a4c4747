"""Triangulation of a mission while it is flown, or replayed from its files."""
