"""Emulated receivers and autopilots, and their protocols as bytes."""
