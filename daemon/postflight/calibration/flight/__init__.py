"""Calibration of heads from the frames of a flight."""
