"""Data on disk that survive a power cut: missions, records, logs, index, recovery."""
