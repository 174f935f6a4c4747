"""Calibration of heads from pictures of a flat board: views, coverage, adjustment, near focus."""
