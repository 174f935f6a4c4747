"""Devices that people own, by driver, and the proof of each.

`python -m drivers.base.device_support` prints the table of docs/reference/devices.md. `syntopic
check` states the proofs of the devices that are configured. What a driver does is on its page in
docs/reference/drivers.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Final


class ProofKind(enum.Enum):
    """What a driver was held against, the strongest first."""

    RECORDING = "recorded bytes"
    """Bytes of the real device, recorded by others."""
    PEER = "another program"
    """A program that we did not write reads or writes the same messages."""
    DESCRIPTION = "the maker's description"
    """A description of the real device in a standard form, such as GenICam, or the kernel's
    header."""
    EXAMPLE = "the manual's example"
    """A worked example that the manual prints, byte by byte."""
    MANUAL = "the manual only"
    """Nothing but the manual: our reading of it may be wrong."""


@dataclass(frozen=True)
class Proof:
    """What one part of a driver was held against.

    Args:
        subject: what was proved, such as "event marks".
        kind: what it was held against.
        source: the recording, program or manual.
    """

    subject: str
    kind: ProofKind
    source: str


@dataclass(frozen=True)
class DriverSupport:
    """Devices of one driver, by makers and models, and the proofs of the driver."""

    kind: str
    driver: str
    devices: str
    proofs: tuple[Proof, ...]


_RECORDING, _PEER, _DESCRIPTION, _EXAMPLE, _MANUAL = ProofKind

SUPPORT: Final = (
    DriverSupport(
        "navigator", "ublox",
        "u-blox M8, M9, F9 and X20, and boards with them (ArduSimple, SparkFun, Emlid)",
        (
            Proof("navigation", _RECORDING, "gpsd's NEO-M8L, ZED-F9R and M8T"),
            Proof("event marks", _PEER, "pyubx2"),
        ),
    ),
    DriverSupport(
        "navigator", "septentrio", "Septentrio mosaic, AsteRx, PolaRx",
        (
            Proof("navigation, attitude, event marks", _PEER, "pysbf2"),
            Proof("INSNavGeod", _MANUAL, "AsteRx-i3 reference guide"),
        ),
    ),
    DriverSupport(
        "navigator", "novatel", "NovAtel OEM7, OEM6 and SPAN",
        (
            Proof("inertial solutions", _RECORDING, "NovAtel's ins2.gps, read by novatel_edie"),
            Proof("MARK1PVA", _RECORDING, "a published line, read by novatel_edie"),
            Proof("other marks, BESTPOS, TIME", _PEER, "novatel_edie"),
        ),
    ),
    DriverSupport(
        "navigator", "nmea", "receivers with NMEA 0183; event marks of Trimble ($PTNL,EVT)",
        (
            Proof("navigation", _RECORDING, "30 receivers of gpsd's tests, with gpsd's answers"),
            Proof("event marks", _EXAMPLE, "a published $PTNL,EVT"),
            Proof("PASHR", _PEER, "pynmeagps"),
        ),
    ),
    DriverSupport(
        "navigator", "gpsd", "whatever gpsd reads; no event marks",
        (Proof("navigation", _PEER, "gpsd 3.22 with 52 recordings"),),
    ),
    DriverSupport(
        "navigator", "sbg", "SBG Systems Ellipse, Ekinox, Quanta, Apogee",
        (
            Proof("navigation, attitude, time", _MANUAL, "sbgECom reference, version 5"),
            Proof("event marks", _MANUAL, "sbgECom reference, version 5"),
        ),
    ),
    DriverSupport(
        "navigator", "vectornav", "VectorNav VN-200, VN-210, VN-300, VN-310",
        (
            Proof("framing, attitude", _EXAMPLE, "VN-100 user manual, section 5.3.7"),
            Proof("time, position", _MANUAL, "UM004, UM005"),
            Proof("event marks", _MANUAL, "UM004, UM005"),
        ),
    ),
    DriverSupport(
        "navigator", "xsens", "Xsens (Movella) MTi-G-710, MTi-670, MTi-680",
        (
            Proof(
                "navigation, attitude, time",
                _RECORDING,
                "Einride's MTi-G-710, read by xsens-go",
            ),
            Proof("event marks", _MANUAL, "MT0101P"),
        ),
    ),
    DriverSupport(
        "navigator", "applanix", "Applanix POS AV, POS MV, AP",
        (
            Proof("navigation, attitude, time", _MANUAL, "PUBS-ICD-004089"),
            Proof("event marks", _MANUAL, "PUBS-ICD-004089"),
        ),
    ),
    DriverSupport(
        "navigator", "gsof", "Trimble BD, BX, R, SPS and Alloy, Applanix AP+ and APX, with GSOF",
        (
            Proof("navigation, attitude, time", _MANUAL, "OEM GNSS receiver help, GSOF messages"),
            Proof("event marks", _MANUAL, "OEM GNSS receiver help, GSOF message 51"),
        ),
    ),
    DriverSupport(
        "navigator", "mavlink", "autopilots with PX4 or ArduPilot (Pixhawk, Cube, ...)",
        (Proof("navigation, CAMERA_TRIGGER, CAMERA_FEEDBACK", _PEER, "pymavlink"),),
    ),
    DriverSupport(
        "pps", "kernel", "a pulse per second on a pin that Linux reads",
        (Proof("pulses", _DESCRIPTION, "linux/pps.h, compiled"),),
    ),
    DriverSupport(
        "thermometer", "modbus-rtu",
        "RTD and thermocouple modules with Modbus RTU (Advantech, ICP DAS, Seneca, Waveshare, ...)",
        (
            Proof("input and holding registers, floats", _PEER, "pymodbus"),
            Proof("framing", _EXAMPLE, "Modbus Application Protocol V1.1b3"),
        ),
    ),
    DriverSupport(
        "thermometer", "ascii-line", "instruments that send lines of text",
        (Proof("patterns", _PEER, "Python's re on random patterns and lines"),),
    ),
    DriverSupport(
        "thermometer", "host", "sensors that Linux knows",
        (Proof("files", _MANUAL, "the kernel's hwmon ABI"),),
    ),
    DriverSupport(
        "head", "aravis",
        "GigE Vision and USB3 Vision cameras (Basler, FLIR, Allied Vision, Lucid, JAI, ...)",
        (
            Proof("names and order of settings", _DESCRIPTION, "62 cameras' GenICam descriptions"),
            Proof("stream and control of GigE Vision", _PEER, "Aravis 0.8.26"),
        ),
    ),
    DriverSupport(
        "head", "v4l2", "cameras with a V4L2 driver (MIPI CSI-2, USB)",
        (
            Proof("control and stream", _PEER, "the kernel's vivid driver"),
            Proof("a sensor with its pipeline", _PEER, "the kernel's vimc driver"),
        ),
    ),
    DriverSupport(
        "head", "folder", "frames that were taken before",
        (Proof("TIFF", _PEER, "tifffile"),),
    ),
    DriverSupport(
        "trigger", "pulse-bus",
        "trigger units with the protocol of docs/reference/drivers/pulse-bus.md",
        (Proof("protocol", _MANUAL, "our own page of the protocol"),),
    ),
    DriverSupport(
        "trigger", "software", "heads without a trigger cable",
        (Proof("as of the head", _DESCRIPTION, "the driver of each head"),),
    ),
    DriverSupport(
        "trigger", "gige-action", "GigE Vision cameras with action commands",
        (Proof("commands", _PEER, "Aravis 0.8.26"),),
    ),
)  # fmt: skip
"""One entry per driver, in the order of the page."""


def support_of(kind: str, driver: str) -> DriverSupport | None:
    """The devices and proofs of a driver.

    Args:
        kind: kind of device, such as "navigator".
        driver: name of the driver.

    Returns:
        Its entry; None for a driver that has none.

    Example:
        >>> support_of("navigator", "sbg").driver
        'sbg'
    """
    return next((one for one in SUPPORT if (one.kind, one.driver) == (kind, driver)), None)


def proof_summary(kind: str, driver: str) -> str:
    """The proofs of a driver in one line.

    Args:
        kind: kind of device, such as "navigator".
        driver: name of the driver.

    Returns:
        Such as "event marks: the manual only (MT0101P)"; empty without an entry.

    Example:
        >>> proof_summary("navigator", "gpsd")
        'navigation: another program (gpsd 3.22 with 52 recordings)'
    """
    found = support_of(kind, driver)
    if found is None:
        return ""
    return "; ".join(f"{p.subject}: {p.kind.value} ({p.source})" for p in found.proofs)


def is_from_manual_only(kind: str, driver: str, subject: str) -> bool:
    """Whether nothing but a manual proves one subject of a driver.

    Args:
        kind: kind of device, such as "navigator".
        driver: name of the driver.
        subject: such as "event marks".

    Returns:
        True if all proofs of the subject are of the kind MANUAL, and there is one.

    Example:
        >>> is_from_manual_only("navigator", "xsens", "event marks")
        True
        >>> is_from_manual_only("navigator", "ublox", "event marks")
        False
    """
    found = support_of(kind, driver)
    kinds = {p.kind for p in found.proofs if subject in p.subject} if found is not None else set()
    return kinds == {ProofKind.MANUAL}


def markdown_table() -> str:
    """The table of devices.

    Returns:
        Markdown with a header and a row per proof; the page of a driver is linked.
    """
    lines = ["| kind | driver | devices | what | proof | by |", "|---|---|---|---|---|---|"]
    for one in SUPPORT:
        page = PAGES.get(one.driver, one.driver)
        for number, proof in enumerate(one.proofs):
            first = (one.kind, f"[{one.driver}](drivers/{page}.md)", one.devices)
            cells = first if number == 0 else ("", "", "")
            mark = f"**{proof.kind.value}**" if proof.kind is _MANUAL else proof.kind.value
            lines.append(f"| {' | '.join((*cells, proof.subject, mark, proof.source))} |")
    return "\n".join(lines) + "\n"


PAGES: Final = {"kernel": "pps", "software": "pulse-bus", "gige-action": "aravis"}
"""Pages in docs/reference/drivers, where they are not named as the driver is."""

if __name__ == "__main__":
    print(markdown_table(), end="")
