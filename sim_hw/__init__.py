"""Emulated devices with the real protocols, and the world that they observe.

Projection and codecs are written here a second time, from the specifications: an emulator that
shared the pipeline's code would repeat its errors.
"""


class SimulatorError(Exception):
    """Root of what the emulator raises on purpose; the message gives the reason."""
