"""Emulated probes and trigger units, and the lines on which devices are."""
