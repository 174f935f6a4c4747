"""Trigger outputs and pulses per second."""
