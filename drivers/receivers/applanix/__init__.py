"""Applanix POS AV inertial systems: groups into records, and the device on a line."""
