"""Lenses and relative orientation of heads from images of a flight and positions of exposures."""
