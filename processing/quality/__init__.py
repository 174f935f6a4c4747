"""The quality of an exposure: figures, flags, verdict."""
