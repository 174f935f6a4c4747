"""What a new configuration assumes, and how each assumption is replaced by a known value."""

from __future__ import annotations

from typing import Final, NamedTuple

from daemon.initialization.answers import Answers

FLIGHT: Final = "calibrate flight"
"""`syntopic calibrate flight` with the first flight; `calibrate board` finds the same."""


class Assumption(NamedTuple):
    """A value that nobody measured: what it is, what it is taken as, and what replaces it."""

    what: str
    taken_as: str
    replaced_by: str


def assumptions(
    answers: Answers, *, has_receiver: bool, has_trigger_unit: bool
) -> list[Assumption]:
    """All assumptions of the files that are written for these answers."""
    found = [
        Assumption("calibration", "none: every product is marked", FLIGHT),
        Assumption("lens distortion", "none", FLIGHT),
        Assumption("focal length", "as printed on the lens", f"{FLIGHT}, at two heights"),
        Assumption("exposure time", "1000 us", "exposure_time_us, or [exposure] control"),
        Assumption("black level, gain", "0 DN, 1 electron per DN", "calibrate radiometric"),
        Assumption("antenna and boresight", "at the camera, level", "[mount], calibrate boresight"),
    ]
    if len(answers.heads) > 1:
        found.insert(
            3,
            Assumption(
                "place and angle of heads",
                f"{answers.distance_mm:g} mm and {answers.angle_deg:g} degrees apart",
                FLIGHT,
            ),
        )
    if not has_trigger_unit:
        found.append(
            Assumption("instant of exposure", "software trigger, milliseconds", "a trigger unit")
        )
    if not has_receiver:
        found.append(
            Assumption("time and position", "this computer's time, no position", "a receiver")
        )
    cropped = [head.model or head.place for head in answers.heads if head.is_cropped]
    if cropped:
        found.append(
            Assumption(
                f"size of {', '.join(dict.fromkeys(cropped))}",
                "as it is set: less than its sensor",
                "width_px and height_px in both files",
            )
        )
    return found
