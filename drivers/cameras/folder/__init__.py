"""A folder of frames as a head."""
