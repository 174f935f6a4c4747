"""Text of `rig.toml` for a new rig, with comments that state which values are provisional."""

from __future__ import annotations

import json
from collections.abc import Sequence

from daemon.configuration.schemas import schema_line
from daemon.initialization.answers import Answers, field_of_view_deg, side_mm
from daemon.initialization.mounting import NominalMounting, RigMounting, mounting_of, radians
from drivers.cameras.head_description import HeadDescription

_BANDS_OF_FILTERS = ("red", "green", "blue")


def sensor_names(answers: Answers) -> tuple[str, ...]:
    """Names of cones and sensors, in the order of the heads."""
    return tuple(head.name for head in mounting_of(answers).heads)


def rig_text(answers: Answers, *, written_by: str) -> str:
    """The rig file.

    Args:
        answers: heads and optics.
        written_by: the command, for the comment at the top.
    """
    mounting = mounting_of(answers)
    lines = [
        schema_line("rig"),
        f"# {answers.name}: {_summary(answers)}. Written by `{written_by}`.",
        "# The rig is uncalibrated: there is no [calibration]. It flies, and every product states "
        "that it is",
        "# uncalibrated. Values marked P are provisional: replace them, or calibrate the camera "
        "with its first",
        "# flight (syntopic calibrate flight). Every key: docs/reference/rig-file.md",
        "",
        "format = 1",
        f"name = {json.dumps(answers.name)}",
        f"title = {json.dumps(_title(answers))}",
        'timing = "synchronous"      # all heads are triggered at one instant',
        f"frame_interval_s = {answers.interval_s!r}      # P: shortest time between two exposures",
        f"master_cone = {json.dumps(mounting.master)}    # angles of the others count from it",
        f"reference_cone = {json.dumps(mounting.master)}",
    ]
    for index, head in enumerate(answers.heads):
        lines += ["", *_cone(answers, mounting, index, head)]
    return "\n".join(lines) + "\n"


def _summary(answers: Answers) -> str:
    count = len(answers.heads)
    if count == 1:
        return "one head"
    return f"{count} heads, {answers.arrangement.value}"


def _title(answers: Answers) -> str:
    models = list(dict.fromkeys(head.model for head in answers.heads if head.model))
    return f"{_summary(answers)}: {', '.join(models)}" if models else _summary(answers)


def _cone(answers: Answers, mounting: RigMounting, index: int, head: HeadDescription) -> list[str]:
    place: NominalMounting = mounting.heads[index]
    focal_mm, pixel_um = answers.focal_lengths_mm[index], answers.pixel_sizes_um[index]
    is_colour = head.filter_array != "none"
    width_mm, height_mm = side_mm(head, pixel_um)
    angle = field_of_view_deg(head, focal_mm, pixel_um)
    lines = [
        "[[cone]]",
        f"name = {json.dumps(place.name)}",
        f'role = "{"colour" if is_colour else "pan"}"',
        f"bands = {json.dumps(_BANDS_OF_FILTERS if is_colour else ['pan'])}",
        f"position_mm = {_list(place.position_mm)}    # P: forward, right, down",
        *_rotation(place),
        'probe = ""               # no temperature probe',
        "calibration_c = 20.0     # P",
        "",
        "[cone.lens]",
        f"f_mm = {focal_mm!r}    # P: as printed on the lens; no distortion is known",
        "",
        "[[cone.sensor]]",
        f"name = {json.dumps(place.name)}",
    ]
    if head.serial:
        lines.append(f"serial = {json.dumps(head.serial)}    # checked when the head connects")
    lines += [
        f"# {width_mm:.2f} x {height_mm:.2f} mm; {angle:.1f} degrees along the longer side",
        f"width_px = {head.width_px}",
        f"height_px = {head.height_px}",
        f"pitch_um = {pixel_um!r}",
        "x_mm = 0.0               # P: the sensor is centred behind the lens",
        "y_mm = 0.0               # P",
        f"bits = {head.bits}                # of {head.pixel_format}",
        "black_dn = 0.0           # P: signal of a covered lens",
        f'colour_filter_array = "{head.filter_array}"',
    ]
    return lines


def _rotation(place: NominalMounting) -> list[str]:
    angles = " ".join(f"{angle:g}" for angle in place.rotation_deg)
    return [
        f"rotation_rad = {_list(radians(place.rotation_deg))}",
        f"# P: omega, phi, kappa against the master: {angles} degrees",
    ]


def _list(values: Sequence[float]) -> str:
    return f"[{', '.join(repr(float(value)) for value in values)}]"
