"""The index of a mission: one SQLite file that can be rebuilt from the records."""
