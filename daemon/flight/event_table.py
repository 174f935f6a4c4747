"""What the service tells, as one table: each event's name, severity, cause and cure.

`syntopic explain` and docs/events.md are made of it; a test holds it against what the code tells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

Severity = Literal["note", "caution", "warning"]
"""A note asks for nothing; a caution wants a look when there is time, a warning at once."""


@dataclass(frozen=True)
class Entry:
    """An event. Names of device events begin with "device/", arming's with "arming-"."""

    name: str
    severity: Severity
    cause: str
    cure: str


_NOTHING = "Nothing to do."

TABLE: Final[Sequence[Entry]] = (
    # The service
    Entry("mission", "note", "A mission begins, or goes on after a restart.", _NOTHING),
    Entry("kernels", "note", "The pipeline is compiled and loaded.", _NOTHING),
    Entry(
        "ready",
        "note",
        "All devices deliver, or those that do not are named.",
        "Where something is named as absent, look at it before take-off.",
    ),
    Entry("phase", "note", "The service went from one phase to another.", _NOTHING),
    Entry("status", "note", "The state of the flight, once a second.", _NOTHING),
    Entry("watching", "note", "The page and the API can be reached.", _NOTHING),
    Entry("command", "note", "Somebody gave a command; done says what became of it.", _NOTHING),
    Entry(
        "control-refused",
        "caution",
        "Somebody who may not command asked for something at the Unix socket.",
        "If they should: add them to the group `control_group`, and let them log in anew.",
    ),
    Entry("done", "note", "The planned exposures are made and finished.", _NOTHING),
    Entry("ended", "note", "The service has ended.", "With a failure: read the fault before it."),
    Entry(
        "override",
        "caution",
        "The flight began although something was missing; who took that upon them is recorded.",
        "Put right what is named before the next flight.",
    ),
    Entry(
        "previous-fault",
        "caution",
        "An earlier start of the service ended with a fault that nobody has acknowledged.",
        "Read it, see whether its cause is gone, and acknowledge it.",
    ),
    Entry(
        "fault",
        "warning",
        "A process died, the ledger does not balance, or a head is not the calibrated one.",
        "The service is started again into the same mission. Do as the sentence says; report it "
        "where it says so.",
    ),
    Entry(
        "ledger",
        "warning",
        "At landing something was neither used nor accounted for.",
        "Keep the mission folder and report it; stored exposures are safe.",
    ),
    Entry(
        "power",
        "warning",
        "The supply said that it will be gone in seconds.",
        "Nothing in the air: what is open is being sealed. Check the supply on the ground.",
    ),
    Entry(
        "disk",
        "warning",
        "The disk is low, or has no room for another exposure; the sentence says which.",
        "Free or change the disk; exposures go on by themselves when there is room.",
    ),
    Entry(
        "index",
        "caution",
        "The disk refused changes of mission.db, or has taken them after all; frames are safe.",
        "Look at the disk; the changes are tried again, and the next start makes the index anew.",
    ),
    # Exposures
    Entry("triggered", "note", "An exposure was ordered.", _NOTHING),
    Entry("stored", "note", "Its frames are on disk.", _NOTHING),
    Entry("sealed", "note", "Its record is on disk.", _NOTHING),
    Entry("judged", "note", "Its verdict is known; the products are being written.", _NOTHING),
    Entry("processed", "note", "It has products and a verdict.", _NOTHING),
    Entry(
        "lost",
        "warning",
        "No pulse was given, no head sent a frame, or the disk refused.",
        "Fly its place again; look at the faults of trigger, heads and disk.",
    ),
    Entry(
        "not-written",
        "warning",
        "The disk refused frames or a record.",
        "Look at the disk's cable and its health; change it. A record is tried again each second.",
    ),
    Entry(
        "not-processed",
        "caution",
        "The pipeline could not make an image; the raw frames are safe.",
        "Run `syntopic process` after landing; the sentence says what hindered it.",
    ),
    Entry(
        "frame",
        "caution",
        "A frame was late, double, damaged or nobody's.",
        "If it happens again: cable, network settings and firmware of that head.",
    ),
    Entry(
        "mark",
        "caution",
        "An event mark belongs to no exposure, or came too late.",
        "If it happens again: noise on the strobe line, or its settings in the receiver.",
    ),
    # Arming
    Entry(
        "arming-kernels",
        "caution",
        "The pipeline is still being loaded; nothing may compile in flight.",
        "Wait. Where it takes minutes, run `syntopic kernels` on the ground.",
    ),
    Entry("arming-device", "caution", "A device does not deliver.", "Its power, its cable."),
    Entry(
        "arming-disk",
        "caution",
        "The disk has no room for the planned exposures.",
        "Free the disk or change it.",
    ),
    Entry(
        "arming-time",
        "caution",
        "GPS time is not known yet.",
        "Wait for the receiver's fix; check its antenna.",
    ),
    Entry(
        "arming-navigation",
        "caution",
        "There is no position, or an old one.",
        "Wait for the receiver's fix; check its antenna and its line.",
    ),
    Entry(
        "arming-temperature",
        "caution",
        "A probe was not read, or not lately.",
        "Check the probes and their module.",
    ),
    Entry(
        "arming-serial",
        "caution",
        "A head does not tell its serial number, or a lens or probe is stated to be another than "
        "the calibrated one.",
        "Compare the labels with the calibration.",
    ),
    Entry("exposure-settings", "note", "Exposure time, gain or TDI of heads changed.", _NOTHING),
    # Devices
    Entry("bound", "note", "A device answered; what it said of itself.", _NOTHING),
    Entry("device/opened", "note", "A device delivers.", _NOTHING),
    Entry("device/recovered", "note", "A device delivers again.", _NOTHING),
    Entry(
        "device/absent",
        "warning",
        "A device did not answer when the service started.",
        "Power, cable, address; it is looked for by itself.",
    ),
    Entry(
        "device/lost",
        "warning",
        "A device that was there is gone.",
        "Cable and power; it is opened again by itself.",
    ),
    Entry(
        "device/silent",
        "warning",
        "A device is connected and says nothing.",
        "Its power and settings; it is opened again by itself.",
    ),
    Entry(
        "device/not-fired",
        "warning",
        "The trigger unit gave no pulse, or did not answer.",
        "Cable and power of the trigger unit.",
    ),
    Entry(
        "device/held-by-another",
        "warning",
        "Another computer or a dead program still holds a head.",
        "End it, or wait: the head lets go by itself after some seconds.",
    ),
    Entry(
        "device/refused",
        "caution",
        "A head did not take a setting, or a receiver a command.",
        "Compare the setting with what the device offers.",
    ),
    Entry(
        "device/not-adjusted",
        "caution",
        "A head did not take an exposure time, gain or TDI that was asked of it in flight.",
        "Compare the setting with what the head offers; it goes on with the one before.",
    ),
    Entry(
        "device/frames-missing",
        "caution",
        "A head counts frames that never arrived.",
        "Network: jumbo frames, receive buffers, cable.",
    ),
    Entry(
        "device/underrun",
        "caution",
        "A head had a frame and no memory was free for it.",
        "Something holds up storage; look at the disk. More `exposures_in_memory` bridges pauses.",
    ),
    Entry(
        "device/checksum",
        "caution",
        "A device sends damaged messages.",
        "Cable, ground and speed of the line.",
    ),
    Entry(
        "device/exception",
        "caution",
        "A probe module answers that it cannot do what it is asked.",
        "Register address and count in the configuration.",
    ),
    Entry(
        "device/unreadable",
        "caution",
        "The host's own sensor or the pulse per second cannot be read.",
        "Its driver, and the rights of the service's user.",
    ),
    Entry("device/played-out", "note", "A head that plays a folder has no more frames.", _NOTHING),
    # Clocks
    Entry(
        "device/pps-holdover",
        "caution",
        "No edge of the pulse per second came for a while; the clock coasts.",
        "PPS cable, the receiver's fix.",
    ),
    Entry(
        "device/mark-holdover",
        "caution",
        "No event mark came for a while; times are interpolated.",
        "Strobe cable, and that the receiver sends its marks.",
    ),
    Entry(
        "device/second-unnamed",
        "caution",
        "Which second an edge begins cannot be told.",
        "PPS and messages must come from the same receiver.",
    ),
    Entry(
        "device/clock-stepped",
        "caution",
        "The receiver's time moved against the host's.",
        "If it happens again: receiver and strobe cable.",
    ),
    Entry(
        "device/receiver-stepped",
        "caution",
        "The receiver tells another time than before; the clock is learned anew.",
        "If it happens again: the receiver's antenna, power and firmware.",
    ),
    Entry(
        "device/device-clock-stepped",
        "caution",
        "A head's clock stepped or started again; it is learned anew.",
        "If it happens again: the head's power.",
    ),
)


def entry_of(name: str) -> Entry | None:
    """The entry of an event, by its name; a device event also without "device/"."""
    return _BY_NAME.get(name) or _BY_NAME.get(f"device/{name}")


def as_markdown() -> str:
    """The table as the page docs/events.md."""
    rows = [f"| `{e.name}` | {e.severity} | {e.cause} | {e.cure} |" for e in TABLE]
    return (
        "\n".join((_PREFACE, "| event | severity | cause | what helps |", "|---|---|---|---|"))
        + "\n"
        + "\n".join(rows)
        + "\n"
    )


_BY_NAME = {entry.name: entry for entry in TABLE}
_PREFACE = """# Events

What `syntopic run` tells, line by line, and what the page and the API list as `events`. A *note*
asks for nothing, a *caution* for a look when there is time, a *warning* for one at once.
`syntopic explain NAME` prints a line of this table in the air. Made by
`syntopic explain --markdown`; do not edit.
"""
