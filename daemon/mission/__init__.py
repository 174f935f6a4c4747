"""What lies on disk and survives the plug: missions, records, logs, index, recovery."""
