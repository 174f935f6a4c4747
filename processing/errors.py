"""The root of the error classes of this package."""


class ProcessingError(Exception):
    """Root of what `processing` raises on purpose."""
