"""Faults of the emulated devices, by name and reproducible: on the wire and on a fake clock."""
