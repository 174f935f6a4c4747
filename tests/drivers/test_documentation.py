"""The pages in docs/reference/drivers name every setting with the default the driver really has."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.base import registry
from drivers.base.settings import Setting

DOCUMENTATION = Path(__file__).parents[2] / "docs/reference/drivers"
PAGES = [
    ("head", "aravis", "aravis.md"),
    ("thermometer", "modbus-rtu", "modbus-rtu.md"),
    ("navigator", "ublox", "ublox.md"),
    ("navigator", "nmea", "nmea.md"),
    ("navigator", "novatel", "novatel.md"),
    ("navigator", "septentrio", "septentrio.md"),
    ("navigator", "sbg", "sbg.md"),
    ("navigator", "vectornav", "vectornav.md"),
    ("navigator", "xsens", "xsens.md"),
    ("navigator", "applanix", "applanix.md"),
    ("navigator", "gsof", "gsof.md"),
    ("navigator", "mavlink", "mavlink.md"),
    ("thermometer", "ascii-line", "ascii-line.md"),
    ("thermometer", "host", "host.md"),
    ("navigator", "gpsd", "gpsd.md"),
    ("head", "folder", "folder.md"),
    ("head", "v4l2", "v4l2.md"),
    ("pps", "kernel", "pps.md"),
    ("trigger", "pulse-bus", "pulse-bus.md"),
    ("trigger", "software", "pulse-bus.md"),
    ("trigger", "gige-action", "aravis.md"),
]


def row(setting: Setting[object]) -> str:
    """A line of a page's table of settings."""
    if setting.required:
        default = "required"
    elif isinstance(setting.default, bool):
        default = str(setting.default).lower()
    elif isinstance(setting.default, str):
        default = f'"{setting.default}"'
    else:
        default = f"{setting.default}"
    allowed = ", ".join(f'"{choice}"' for choice in setting.choices)
    if setting.minimum is not None:
        allowed = f"{setting.minimum:g} to " + (
            "any" if setting.maximum is None else f"{setting.maximum:g}"
        )
    return f"| `{setting.name}` | {setting.type_name} | {default} | {allowed} | {setting.help} |"


@pytest.mark.parametrize(("kind", "driver", "page"), PAGES)
def test_the_page_lists_every_setting_as_the_driver_declares_it(
    kind: str, driver: str, page: str
) -> None:
    lines = (DOCUMENTATION / page).read_text(encoding="utf-8").splitlines()
    missing = [
        row(setting)
        for setting in registry.driver_for(kind, driver).settings()
        if row(setting) not in lines
    ]
    assert missing == []
