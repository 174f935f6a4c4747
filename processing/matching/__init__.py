"""Matching of small patches, and the tie points that come of it."""
