"""What can be set of a V4L2 head, and which settings contradict each other."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Final

from drivers.base.settings import Configured, Setting
from drivers.cameras.v4l2.formats import FORMATS
from drivers.cameras.v4l2.module_parameters import ASSIGNMENT as MODULE_ASSIGNMENT

ASSIGNMENT: Final = re.compile(r"([a-z0-9_]+)=(-?\d+)")


class V4l2Settings(Configured):
    """The settings of `drivers.cameras.v4l2.v4l2_head.V4l2Head`."""

    device = Setting(
        "",
        required=True,
        help="path of the node, best below /dev/v4l, or its bus as printed by v4l2-ctl",
    )
    serial = Setting("", help="serial number the head must have (USB); empty takes any")
    width_px = Setting(0, minimum=0, help="columns; 0 takes what the head is set to")
    height_px = Setting(0, minimum=0, help="rows; 0 takes what the head is set to")
    pixel_format = Setting("Y12", choices=tuple(FORMATS), help="V4L2 name of the pixel format")
    video_input = Setting(-1, minimum=-1, maximum=255, help="number of the input; -1 leaves it")
    frame_interval_s = Setting(
        0.0, minimum=0, maximum=3600, help="from frame to frame of a free-running head; 0 leaves it"
    )
    exposure_time_us = Setting(
        0.0, minimum=0, maximum=60e6, help="exposure time, us; 0 leaves what the head is set to"
    )
    exposure_control = Setting(
        "", help="name of its control; empty finds it, none where it is set elsewhere"
    )
    exposure_unit_us = Setting(
        0.0, minimum=0, maximum=1e6, help="unit of that control, us; 0 finds it"
    )
    gain = Setting(
        -1, minimum=-1, maximum=1 << 31, help="gain in the head's own unit; -1 leaves it"
    )
    gain_control = Setting("", help="name of its control; empty finds it")
    gain_unit_db = Setting(
        0.0,
        minimum=0,
        maximum=60,
        help="a step of that control, dB; 0: not known, gain is not changed in flight",
    )
    controls = Setting(
        tuple[str, ...](), help="further controls to be set, each name=number, in this order"
    )
    module_parameters = Setting(
        tuple[str, ...](),
        help="parameters of kernel modules that must have a value, each module/parameter=value",
    )
    temperature_control = Setting("", help="control that reports the head's temperature")
    temperature_unit_c = Setting(1.0, minimum=1e-6, maximum=1000, help="unit of that control, degC")
    trigger_source = Setting("line", choices=("line", "software"), help="what starts an exposure")
    trigger_control = Setting("", help="button control that is pressed for a software trigger")
    readout_us = Setting(
        0.0,
        minimum=0,
        maximum=60e6,
        help="end of exposure to end of frame, where frames are stamped at their end, us",
    )
    stamp_sigma_us = Setting(
        500.0, minimum=0, maximum=1e6, help="standard deviation of the kernel's time of a frame, us"
    )
    buffers = Setting(4, minimum=2, maximum=32, help="buffers of the kernel")
    silence_s = Setting(
        0.0,
        minimum=0,
        maximum=3600,
        help="time without a frame after which a free-running head is reopened; "
        "0 for triggered ones",
    )
    check_interval_s = Setting(
        2.0, minimum=0.2, maximum=60, help="time between looks at the head's controls and health"
    )

    @classmethod
    def setting_conflicts(cls, values: Mapping[str, Any]) -> list[str]:
        found = []
        if (values["width_px"] == 0) != (values["height_px"] == 0):
            found.append(
                f"width_px is {values['width_px']} and height_px is {values['height_px']}; "
                "give both or neither"
            )
        found += [
            f"controls has {text!r}; name=number as in 'trigger_mode=1', the name as printed by "
            "v4l2-ctl"
            for text in values["controls"]
            if not ASSIGNMENT.fullmatch(text)
        ]
        found += [
            f"module_parameters has {text!r}; module/parameter=value as in 'imx296/trigger_mode=1'"
            for text in values["module_parameters"]
            if not MODULE_ASSIGNMENT.fullmatch(text)
        ]
        if values["trigger_source"] == "software" and not values["trigger_control"]:
            found.append(
                "trigger_source is 'software' and trigger_control is ''; name the button that "
                "triggers, or let the line do it"
            )
        return found


def assignments(controls: tuple[str, ...]) -> list[tuple[str, int]]:
    """Names and numbers of the setting `controls`.

    Args:
        controls: texts of the form name=number; others are omitted.

    Returns:
        Name and value of each, in the order of the setting.
    """
    found = [ASSIGNMENT.fullmatch(text) for text in controls]
    return [(match[1], int(match[2])) for match in found if match]
