"""The mathematics: arrays and calibrations in, arrays and figures out.

Nothing here opens a file but a rig or a calibration given by path, and nothing knows a clock, a
thread or a device.
"""


class ProcessingError(Exception):
    """Root of what `processing` raises on purpose."""
