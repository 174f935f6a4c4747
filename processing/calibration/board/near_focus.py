"""What a near focus does to a lens: its principal distance, and how sharp the board is.

Source: docs/explanation/mathematics/lens.md#near-focus; the lens equation 1/f = 1/s + 1/s'.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class NearFocus:
    """A thin lens of `f_mm` and a board at `distance_m` from its projection centre.

    `shift_mm` is by how much the principal distance of a lens focused on the board exceeds that at
    infinity, `shift_px` what that is at the corner of the image. `blur_px` is the diameter of the
    blur of the board where the lens is focused at infinity.
    """

    distance_m: float
    f_mm: float
    shift_mm: float
    shift_px: float
    blur_px: float


def near_focus(
    f_mm: float, distance_m: float, *, f_number: float, pitch_mm: float, corner_mm: float
) -> NearFocus:
    """Compare a focus on the board with a focus at infinity.

    Args:
        f_mm: focal length (the principal distance at infinity).
        distance_m: from the projection centre to the board.
        f_number: aperture.
        pitch_mm: pixel size.
        corner_mm: distance of the corner of the image from its middle.

    Returns:
        Both differences. 1/f = 1/s + 1/s' gives s' - f = f^2 / (s - f); the blur of an object at s,
        focused at infinity, has the diameter (f / N) f / s.

    Raises:
        ValueError: the board is within the focal length.

    Example:
        A lens of 50 mm focused at 3 m has a principal distance longer by 0.85 mm.

        >>> found = near_focus(50.0, 3.0, f_number=5.6, pitch_mm=0.005, corner_mm=15.0)
        >>> round(found.shift_mm, 3), round(found.shift_px, 1), round(found.blur_px, 1)
        (0.847, 50.8, 29.8)
    """
    s_mm = distance_m * 1e3
    if not s_mm > f_mm > 0.0:
        raise ValueError(f"a board at {s_mm:g} mm is within the focal length of {f_mm:g} mm")
    shift = f_mm**2 / (s_mm - f_mm)
    return NearFocus(
        distance_m,
        f_mm,
        shift,
        shift / f_mm * corner_mm / pitch_mm,
        f_mm**2 / f_number / s_mm / pitch_mm,
    )
