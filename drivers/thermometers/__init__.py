"""Temperature probes and the host's own sensors."""
