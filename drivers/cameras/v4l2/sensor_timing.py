"""Lines and frames of a sensor: how long a line lasts, and how many blank lines a frame needs.

Source: Documentation/driver-api/media/camera-sensor.rst of the kernel, "Raw camera sensors".
"""

from __future__ import annotations

import math


def line_time_us(width_px: int, horizontal_blanking_px: int, pixel_rate_hz: int) -> float:
    """The time of a line.

    Args:
        width_px: columns that are read out.
        horizontal_blanking_px: control `horizontal_blanking`.
        pixel_rate_hz: control `pixel_rate`.

    Returns:
        Time, us; 0 where the sensor reports no rate.

    Example:
        >>> line_time_us(3280, 168, 182_400_000)
        18.903508771929825
    """
    if pixel_rate_hz <= 0:
        return 0.0
    return (width_px + horizontal_blanking_px) / pixel_rate_hz * 1e6


def blanking_for_interval(interval_s: float, line_us: float, height_px: int) -> int:
    """Blank lines of a frame that lasts so long.

    Args:
        interval_s: from frame to frame.
        line_us: the time of a line.
        height_px: rows that are read out.

    Returns:
        Number of lines.

    Example:
        >>> blanking_for_interval(0.1, 20.0, 2464)
        2536
    """
    return round(interval_s * 1e6 / line_us) - height_px


def blanking_for_exposure(exposure_lines: int, exposure_max: int, blanking: int) -> int:
    """Blank lines for which an exposure of so many lines fits into the frame.

    The longest exposure grows by a line with each blank line; the margin between both is the
    sensor's own, and is contained in what the controls report now.

    Args:
        exposure_lines: the exposure that is wanted.
        exposure_max: the largest value of the control `exposure` now.
        blanking: the value of the control `vertical_blanking` now.

    Returns:
        Number of lines.

    Example:
        >>> blanking_for_exposure(5000, 2496, 36)
        2540
    """
    return blanking + max(0, math.ceil(exposure_lines - exposure_max))
