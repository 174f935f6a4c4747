"""The root of the error classes of this package."""


class DriverError(Exception):
    """Root of what the drivers raise on purpose."""
