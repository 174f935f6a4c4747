"""The root of the error classes of this package."""


class SimulatorError(Exception):
    """Root of what the emulator raises on purpose; the message gives the reason."""
