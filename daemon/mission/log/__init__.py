"""The flight log: every message of a flight with its time."""
