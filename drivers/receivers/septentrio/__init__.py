"""Septentrio receivers: SBF blocks into records, and the device on a line."""
