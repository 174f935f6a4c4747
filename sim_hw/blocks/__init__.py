"""Blocks of image coordinates with their truth, for adjustments without pixels."""
