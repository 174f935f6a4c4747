"""Every sentence that can reach the page has a code: none is shown in English elsewhere."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from fnmatch import fnmatch
from functools import cache
from pathlib import Path

import pytest

from daemon.onboard.monitoring.server_messages import CATALOG, english, message_of
from tests.daemon.onboard.monitoring.sentence_literals import (
    ENGLISH,
    codes_of,
    messages_of,
    sentences_of,
    texts_of,
)

ROOT = Path(__file__).parents[4]
WORDS_MIN = 4
FOLDERS = (
    *("drivers", "daemon/onboard", "daemon/planning", "processing/quality"),
    *("daemon/mission/mirror", "daemon/mission/verification"),
)
MODULES = (
    *("daemon/mission/canonical_json.py", "daemon/mission/catalog/catalog.py"),
    *("daemon/mission/store/health.py", "daemon/mission/store/file_tree.py"),
    "daemon/mission/store/product_manifests.py",
    *("daemon/mission/transfer/transfer.py", "daemon/mission/transfer/transfer_manifest.py"),
    *("daemon/postflight/landing_job.py", "processing/pipelines/live_triangulation.py"),
)
CONFIGURATION = "read with the configuration, which is refused before the page is served"
DAMAGED = "a damaged message is counted; its sentence is not shown"
ON_CONSOLE = "printed by a command"
NOT_ON_PAGE = {
    "drivers/base/device_support.py": "tables of the documents",
    "drivers/base/registry.py": CONFIGURATION,
    "drivers/base/settings.py": CONFIGURATION,
    "drivers/cameras/pixels.py": "called with sizes that the driver has checked",
    "drivers/cameras/aravis/formats.py": "called with names that the driver has checked",
    "drivers/thermometers/ascii_line/pattern.py": CONFIGURATION,
    "drivers/detection/*": ON_CONSOLE,
    "drivers/cameras/aravis/broadcast_discovery.py": ON_CONSOLE,
    "drivers/cameras/*/description.py": ON_CONSOLE,
    "drivers/receivers/*/decoder.py": DAMAGED,
    "drivers/receivers/*/framing.py": DAMAGED,
    "drivers/receivers/*/sentences.py": DAMAGED,
    "drivers/receivers/*/epoch.py": DAMAGED,
    "drivers/receivers/*/blocks.py": DAMAGED,
    "drivers/receivers/ascii_numbers.py": DAMAGED,
    "drivers/receivers/broadcast_ephemeris.py": DAMAGED,
    "drivers/receivers/gpsd/reports.py": DAMAGED,
    "drivers/triggers/pps/binding.py": "layout of a structure",
    "daemon/onboard/installation.py": ON_CONSOLE,
    "daemon/onboard/capture/frame_ring.py": "an error of the service's own code",
    "daemon/onboard/capture/link_budget.py": "an error of the service's own code",
    "daemon/onboard/flight/event_table.py": ON_CONSOLE,
    "daemon/onboard/flight/ledger.py": "an error of the service's own code",
    "daemon/onboard/flight/transitions.py": "an error of the service's own code",
    "daemon/onboard/flight/trigger_policies.py": CONFIGURATION,
    "daemon/onboard/monitoring/access/certificate_authority.py": ON_CONSOLE,
    "daemon/onboard/monitoring/access/control_socket.py": "answered on the Unix socket",
    "daemon/onboard/monitoring/access/service_query.py": ON_CONSOLE,
    "daemon/onboard/monitoring/client/*": ON_CONSOLE,
    "daemon/onboard/monitoring/mavlink/datagrams.py": "an error of the service's own code",
    "daemon/onboard/monitoring/metrics.py": "for Prometheus",
    "daemon/onboard/monitoring/web/listener.py": "sent before there is a page",
    "daemon/onboard/monitoring/web/page_files.py": "a header of HTTP",
    "daemon/onboard/preflight/kernel_counters.py": ON_CONSOLE,
    "daemon/onboard/preflight/network_diagnosis.py": ON_CONSOLE,
    "daemon/onboard/preflight/service_file.py": CONFIGURATION,
    "daemon/onboard/preflight/system_check.py": ON_CONSOLE,
    "daemon/onboard/service/message_dispatcher.py": "an error of the service's own code",
    "daemon/onboard/triangulation/live_record.py": "text of a file",
    "daemon/onboard/triangulation/quality_page.py": "a page of its own",
    "daemon/planning/plan_readers.py": CONFIGURATION,
    "daemon/planning/reflight_files.py": "text of a file",
    "daemon/mission/mirror/mirror_repair.py": ON_CONSOLE,
    "daemon/mission/verification/inventory.py": ON_CONSOLE,
    "processing/quality/figures/*": "meanings of figures, for the documents",
    "processing/quality/valid_area.py": "an error of the service's own code",
}
"""Modules without a sentence for the page, with the reason."""
PARTS = (
    r"^[;.,:)( ]|[:(] ?$",
    r"coverage counts as a gap$|^by their places|^by the fixed pattern",
    r"\(common scale .*cone SU11$|^Motion blur SU11|^probe SU11 reads",
    r"^SU11 m SU11 the planned",
    r"^show other ground than|^Columns SU11 to",
    r"^has its computed|^(rejected|accepted); |^was (triggered|stored) but",
    r"^SU11 sent no image|^SU11SU11, SU11: heads or cables|^In the frame of SU11SU11",
    r"^SU11 at SU11: SU11$",
    r"^SU11, which cannot (all )?be loaded|^SU11\. Run: pip install",
    r"^locked by another setting$|^SU11 is SU11 and SU11$|^SU11 = SU11; SU11 is needed$",
    r"^SU11 x SU11 SU11$|^SU11 is in SU11$|^is a USB3 Vision",
    r"^pixel_format is SU11; the head has $",
    r"^media-ctl -d|^set its UTC by|^The autopilot SU11 SU11|^SU11: SU11 came at",
    r"^SU11; check value_type|^The SU11 SU11 at SU11 (sent no valid|was lost)",
    r"^SU11 heads \(.*\) are$|^SU11 on a network shared|^the disk of SU11 refused to write",
    r"^SU11; check the disk$|^syntopic run SU11|^SU11 line SU11: SU11$",
    r"^(Exposures SU11 are not in|There is no block: exposures|SU11 of exposures SU11 contra)",
    r"Nothing checks (its|their) roll|^SU11 and its place in addition",
    r"^SU11 SU11, SU11 standard deviations$|^Fly a turn|^Check antenna_m",
    r"^Check the (event mark's edge|inertial unit's|receiver's cor)",
    r"^Calibrate the (boresight|camera)",
    r"^(boresight|attitude) about the|^lever arm along the",
    r"^(boresight|attitude|time offset|principal distance)( about.*)? per (hour|K)$",
    r"^no disk of Syntopic$|^SU11 is at SU11; mount the right one",
    r"^compute it again: syntopic process",
    r" exposures and SU11 frames are verified$|^SU11; nothing is wrong$",
)
"""Parts of sentences; the sentences themselves are in `COMPOSED`, or elsewhere in the tests."""
NO_SENTENCES = (
    r"^# Hashes of tokens|^SU11: letters, digits|^SU11 has a token; remove",
    r"no token has the name|^health of disk SU11$",
    r"^earlier exposures of %s|^zoom_level = |^SU11 is not a stream$|came twice; each is",
    r"^the configuration \(trigger\.start|^no other computer was seen",
    r"geopandas|obstore|matplotlib|pycolmap|^(INSERT|SELECT) ",
    r"^being flown, or its service|^the flight has ended$|^laid out by hand|^each line's own",
    r"^flight plan of format 1|^seals of logs by|^may be added to until|^mission laid out",
    r"(closed by repair at|is open:).*if the newest|^flight log, |^format 1: the removal",
    r"^the next record, the last|^record of a mission laid|^frame without a hash",
    r"^capture record of format|^As the client has it|is being computed by another process$",
)
"""Refusals and remarks that only a command prints, and SQL."""
COMPOSED = (
    "L2/000001/LEFT.tif: differs from its manifest; compute it again: syntopic process MISSION "
    "--again --only 1",
    "SU07 at 10.0.0.7: exposure_time_us = 4000.0 is refused (ExposureTime = 4000.0 is refused: "
    "SU11); choose a time that the head has\nSU07 at 10.0.0.7: gain_db is 3; the head has no gain "
    "in dB; it has Gain without a unit; set gain_db = 0, or gain_unit to dB or factor as its "
    "manual states\nSU07 at 10.0.0.7: pixel_format is 'Mono12'; the head has Mono8, Mono10. "
    "Retrying automatically.",
    "SU07 at 10.0.0.7: features.Gamma = 3 is refused (Gamma is 1 and locked by another setting); "
    "choose a value that the head has",
    "SU07 at 10.0.0.7: features.A = 1 is refused (A = 1; true or false is needed); choose a value "
    "that the head has\nSU07 at 10.0.0.7: features.B = 'a' is refused (B = 'a'; a whole number is "
    "needed); choose a value that the head has\nSU07 at 10.0.0.7: features.C = 1 is refused "
    "(C = 1; a text is needed); choose a value that the head has",
    "SU07 at 10.0.0.7: ptp is true; PtpEnable is refused (PtpEnable is False and read-only), set "
    "ptp = false",
    "SU07 at 10.0.0.7: gain_db is 3; the head has no gain in dB; it has Gain in 'steps'; set "
    "gain_db = 0, or gain_unit to dB or factor as its manual states",
    "SU07 at 10.0.0.7: the head has no feature TriggerMode for its trigger FrameStart, so it "
    "cannot be used; choose another head",
    "The head SU07 is open at 10.0.0.7; nothing to do. It holds SU11.",
    "thermo: nothing came at /dev/ttyS0 in 3 s; check power, cable, baudrate (9600)",
    "The receiver gnss at /dev/ttyUSB0 was lost (it was unplugged). Check cable and power. "
    "Reconnecting automatically.",
    "The receiver gnss at /dev/ttyUSB0 sent no valid data for 3 s. Check its power, wiring and "
    "baud rate. Reconnecting automatically.",
    "SU07 at 10.0.0.7: features.Gamma = 'a' is refused (Gamma = 'a'; a number is needed); choose a "
    "value that the head has",
    "SU07 at 10.0.0.7: the head is a USB3 Vision camera and has no feature TriggerMode, so it "
    "cannot be used; choose another head",
    "SU07 at 10.0.0.7: the head has no feature that sets its exposure time (Exposure is in 'lx'), "
    "so it cannot be used; choose another head",
    "SU02 at /dev/video2: a link of its media pipeline is disabled; run media-ctl -d /dev/media0 "
    "-l ''a':0->'b':0 [1]'",
    "SU02 at /dev/video2: pixel_format is 'Y12'; the head has no format that is one of ours",
    "The autopilot cube started again (2 so far). Its times are good to 1.5 ms now, and better "
    "after some seconds. If it happens again: check its power and its GPS receiver.",
    "The autopilot cube set its UTC by +0.310 s against its own clock (2 so far). Its times are "
    "good to 1.5 ms now, and better after some seconds. If it happens again: check its power and "
    "its GPS receiver.",
    "probe: no complete line came at /dev/ttyS0 in 3 s; check power, cable, command, command_end "
    "and baudrate (9600)",
    "probe: no complete line came at /dev/ttyS0 in 3 s; check power, cable, baudrate (9600)",
    "probe: nothing came at /dev/ttyS0 in 3 s; check power, cable, command, command_end and "
    "baudrate (9600)",
    "The receiver gnss at /dev/ttyUSB0 sent no valid data for 3 s. Check its power, wiring and "
    "baud rate. Reconnecting automatically. The port is shared: it is in use by gpsd (812); run: "
    "systemctl stop gpsd.socket gpsd, or use driver gpsd.",
    "The receiver gnss at /dev/ttyUSB0 was lost (it was unplugged). Check cable and power. "
    "Reconnecting automatically. The port is shared: it is in use by gpsd (812); run: systemctl "
    "stop gpsd.socket gpsd, or use driver gpsd.",
    "head SU11 is on a network shared with others (a router lies in between, 10.0.0.3): a "
    "computer that forges a head's address there can alter its frames. Give the heads a separate "
    "interface",
    "4 heads (SU10 to SU13) are on a network shared with others (the default route leads there): "
    "a computer that forges a head's address there can alter its frames. Give the heads a "
    "separate interface",
    "120 MB of 4 heads (SU10 to SU13) take 1.2 s of 1 s on eth1 (1000 Mbit/s; 0.90 s are usable); "
    "spread the heads over more or faster interfaces, use a packed pixel format, or expose every "
    "1.4 s",
    "the disk of /data refused to write 4000000 bytes (SU11); check the disk",
    "GigE Vision and USB3 Vision heads need Aravis, which cannot all be loaded (SU11). Run: pip "
    "install 'syntopic[aravis]' and the system library: sudo apt install gir1.2-aravis-0.8",
    "resuming mission M1 with the rig of calibration C1 (2026-05-01); the configured rig differs "
    "in cone[0].f_mm (70 in the mission, 71 now). To fly with the configured rig, close this "
    "mission and begin a new one: syntopic run x.toml --new-mission",
    "mission M1 cannot be resumed: its rig has no sensor SU11, which the configuration has heads "
    "for. Close it and begin a new one: syntopic run x.toml --new-mission",
    "Exposures 3-7 are not in the block: lost, no head delivered an image. Fly them again.",
    "There is no block: exposures 3-7 cannot be used: no attitude. Check the inertial unit and "
    "its configuration.",
    "The block is a single strip. Nothing checks its roll about the flight direction and its place "
    "in addition to GNSS and inertial unit. Not determined by the images: SU11. Fly a cross line "
    "or a second line with side overlap.",
    "The 3 lines do not tie: each is a strip. Nothing checks their roll and its place in addition "
    "to GNSS and inertial unit. Fly a cross line or a second line with side overlap.",
    "Attitude about the camera's x per hour: 120 mdeg/h, 6 standard deviations. Fly a turn of "
    "alignment and check the inertial unit.",
    "Time offset: 1.2 ms, 6 standard deviations. Check the event mark's edge and [mount] "
    "time_offset_ms.",
    "Boresight about the camera's x per K: 1.2 mdeg/K, 6 standard deviations. Calibrate the "
    "boresight near the temperatures of the flight.",
    "Principal distance: 3 um, 6 standard deviations. Calibrate the camera, or run `syntopic "
    "triangulate MISSION --interior`.",
    "Positions of exposures 3-5 contradict the tie points and were left out. Check the receiver's "
    "corrections.",
    "Boresight about the camera's x: 12 mdeg, 6 standard deviations. Calibrate the boresight after "
    "landing.",
    "Lever arm along the camera's z: 0.1 m, 6 standard deviations. Check antenna_m in [mount].",
    "Control points cannot be used: points.csv: line 3: role is 'a'; control or check is right; "
    "line 5: height_m is 'b'; a number is right. The accuracy is stated without them.",
    "The live triangulation was not complete 60 s after landing; exposures 3-5 are not in its "
    "orientations. Run `syntopic triangulate MISSION --live`.",
    "disk b (/disk) cannot be used: another disk is at /disk; mount the right one, or take this "
    "one with: syntopic send accept-disk --set disk=b",
    "12 exposures and 156 frames are verified; chain.jsonl: was altered; it is no line of a chain; "
    "exposure 4: the index names another record; 3 more: run syntopic verify /data/M1",
    "base map /maps/a.pmtiles: is truncated; copy it again. The page shows no such layer",
    "/etc/syntopic/key.pem is not the key of /etc/syntopic/cert.pem; give the two that belong "
    "together. The previous certificate is still used",
)
COMMANDS = ("sudo ", "syntopic ")
"""Beginnings of commands, which are the same in every language."""


@cache
def sources() -> tuple[str, ...]:
    found = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")]
    return tuple(sorted(str(path.relative_to(ROOT)) for path in found)) + MODULES


@cache
def without_code(source: str) -> tuple[str, ...]:
    """The texts of a module that have no code."""
    return tuple(
        variants[0]
        for variants in sentences_of(ROOT / source, WORDS_MIN)
        if next(messages_of(variants), None) is None
    )


def is_on_page(source: str) -> bool:
    return not any(fnmatch(source, pattern) for pattern in NOT_ON_PAGE)


def on_page() -> Iterator[tuple[str, str]]:
    return ((one, text) for one in sources() if is_on_page(one) for text in without_code(one))


def test_every_sentence_that_can_reach_the_page_has_a_code() -> None:
    """A new or changed sentence needs its text in `messages/*/server.json`, in every language.

    A text that is no sentence for the page belongs into the lists of this module.
    """
    known = re.compile("|".join((*PARTS, *NO_SENTENCES)))
    missing = [f"{source}: {text}" for source, text in on_page() if not known.search(text)]
    assert missing == []


def test_no_exception_is_listed_in_vain() -> None:
    texts = [text for _, text in on_page()]
    unused = [
        part
        for listed in (*PARTS, *NO_SENTENCES)
        for part in re.split(r"\|(?![^(]*\))", listed)
        if not any(re.search(part, text) for text in texts)
    ]
    assert unused == []
    for pattern in NOT_ON_PAGE:
        assert any(without_code(one) for one in sources() if fnmatch(one, pattern)), pattern


@pytest.mark.parametrize("sentence", COMPOSED)
def test_a_composed_sentence_has_codes_for_all_of_its_parts(sentence: str) -> None:
    message = message_of(sentence)
    assert message is not None
    assert english(message) == sentence
    texts = [text for text in texts_of(message) if not text.startswith(COMMANDS)]
    assert not ENGLISH.search(" | ".join(texts)), message


def test_every_text_of_a_device_is_one_that_a_driver_writes() -> None:
    """A sentence that a driver changes would otherwise be English on every page."""
    found = {code for one in COMPOSED for code in codes_of(message_of(one))}
    for source in (ROOT / "drivers").rglob("*.py"):
        for variants in sentences_of(source, words_min=2):
            found |= {code for message in messages_of(variants) for code in codes_of(message)}
    texts = json.loads(CATALOG.read_text("utf-8"))
    device = {code.removeprefix("server.") for code in texts if code.startswith("server.device.")}
    assert device - found == set()
