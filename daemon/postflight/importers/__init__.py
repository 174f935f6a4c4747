"""Cameras of others: what they wrote becomes a mission folder, and their calibration a rig file."""
