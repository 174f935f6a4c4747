"""Attitude between two samples: roll, pitch and heading as quaternion, and back.

The capture and service processes interpolate with it. Both run without scipy, whose `Rotation`
converts everywhere else (`processing.geometry.rotation`): it would add 38 MiB to each of them.
The tests compare both.

Source: docs/explanation/mathematics/navigation.md; Shoemake (1985).
"""

from __future__ import annotations

import math

Quaternion = tuple[float, float, float, float]
"""w, x, y, z of the rotation from body to north, east, down."""

GIMBAL_LOCK_COSINE = 1e-7
"""As of `processing.geometry.rotation`: below this cosine of pitch, roll is 0."""


def interpolated_quaternion(first: Quaternion, second: Quaternion, fraction: float) -> Quaternion:
    """The rotation between two others, along the shorter arc.

    Args:
        first: unit quaternion.
        second: unit quaternion.
        fraction: share of the way from `first` to `second`; 0 and 1 give these.

    Returns:
        Unit quaternion.

    Source: Shoemake (1985), slerp.
    """
    cosine = sum(a * b for a, b in zip(first, second, strict=True))
    sign = -1.0 if cosine < 0 else 1.0
    angle = math.acos(min(1.0, abs(cosine)))
    if angle < 1e-9:
        return first
    one = math.sin((1 - fraction) * angle) / math.sin(angle)
    other = sign * math.sin(fraction * angle) / math.sin(angle)
    w, x, y, z = (one * a + other * b for a, b in zip(first, second, strict=True))
    return w, x, y, z


def quaternion_of(roll_rad: float, pitch_rad: float, heading_rad: float) -> Quaternion:
    """The rotation from body to north, east, down of roll, pitch and heading.

    Args:
        roll_rad: rotation about the forward axis, right side down positive, rad.
        pitch_rad: nose up positive, rad.
        heading_rad: clockwise from north, rad.

    Returns:
        Unit quaternion w, x, y, z.

    Source: docs/explanation/mathematics/navigation.md.

    Example:
        >>> quaternion_of(0.0, 0.0, 0.0)
        (1.0, 0.0, 0.0, 0.0)
    """
    (cr, sr), (cp, sp), (ch, sh) = (
        (math.cos(angle / 2), math.sin(angle / 2)) for angle in (roll_rad, pitch_rad, heading_rad)
    )
    return (
        cr * cp * ch + sr * sp * sh,
        sr * cp * ch - cr * sp * sh,
        cr * sp * ch + sr * cp * sh,
        cr * cp * sh - sr * sp * ch,
    )


def angles_of(q: Quaternion) -> tuple[float, float, float]:
    """Roll, pitch and heading of a rotation.

    Args:
        q: unit quaternion of the rotation from body to north, east, down.

    Returns:
        Roll (-pi to pi), pitch (-pi/2 to pi/2) and heading (0 to 2 pi), rad. Where the cosine of
        pitch is below GIMBAL_LOCK_COSINE, roll is 0.

    Source: docs/explanation/mathematics/navigation.md.

    Example:
        >>> [round(angle, 6) for angle in angles_of((1.0, 0.0, 0.0, 0.0))]
        [0.0, 0.0, 0.0]
    """
    w, x, y, z = q
    north, east = 1 - 2 * (y * y + z * z), 2 * (w * z + x * y)
    cosine = math.hypot(north, east)
    pitch = math.atan2(2 * (w * y - z * x), cosine)
    if cosine < GIMBAL_LOCK_COSINE:
        return 0.0, pitch, math.atan2(2 * (w * z - x * y), 1 - 2 * (x * x + z * z)) % math.tau
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return roll, pitch, math.atan2(east, north) % math.tau
