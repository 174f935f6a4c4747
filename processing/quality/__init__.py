"""What is said of an exposure: figures, flags, verdict."""
