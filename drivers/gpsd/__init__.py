"""A gpsd as navigator."""
