"""A receiver's recorded observations as RINEX, with the event marks of the exposures.

Bytes come from the flight log as they were received. `marks.csv` next to the file keeps the
nanoseconds and standard deviations that RINEX's 100 ns do not hold.
"""

from __future__ import annotations

import csv
import io
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from daemon import DaemonError
from daemon.mission.exposure import Exposure
from daemon.mission.exposure_batch import ExposureFailure
from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import logs_of, read
from daemon.mission.store.level2 import write_folder
from daemon.orientation.exterior_orientation import mount_of, sealed_exposures
from daemon.orientation.geodesy import ECEF_FROM_GEODETIC
from daemon.postflight.exchange.rinex import (
    VERSIONS,
    RinexHeader,
    RinexText,
    observation_text,
    written_ns,
)
from daemon.postflight.exchange.rinex_navigation import navigation_text
from drivers.receivers.broadcast_ephemeris import (
    BroadcastEphemeris,
    RawPage,
    broadcast_ephemerides,
)
from drivers.receivers.gps_ephemeris import GpsEphemeris, Subframe, ephemerides_of
from drivers.receivers.novatel.observations import novatel_observations, novatel_subframes
from drivers.receivers.observations import WEEK_NS, ObservationCounts, ObservationEpoch
from drivers.receivers.septentrio.observations import (
    has_meas3,
    septentrio_observations,
    septentrio_pages,
    septentrio_subframes,
    septentrio_unread,
)
from drivers.receivers.ublox.observations import (
    ublox_observations,
    ublox_pages,
    ublox_subframes,
    ublox_unread,
)

Decoder = Callable[[bytes, ObservationCounts], Iterator[ObservationEpoch]]

DECODERS: Mapping[str, Decoder] = {
    "ublox": ublox_observations,
    "novatel": novatel_observations,
    "septentrio": septentrio_observations,
}
"""Decoders of raw observations by driver."""
SUBFRAMES: Mapping[str, Callable[[bytes], Iterator[Subframe]]] = {
    "ublox": ublox_subframes,
    "novatel": novatel_subframes,
    "septentrio": septentrio_subframes,
}
"""Decoders of the legacy navigation message of GPS and QZSS by driver."""
PAGES: Mapping[str, Callable[[bytes], Iterator[RawPage]]] = {
    "ublox": ublox_pages,
    "septentrio": septentrio_pages,
}
"""Decoders of the navigation messages of Galileo, GLONASS and BeiDou by driver."""
UNREAD: Mapping[str, Callable[[bytes], tuple[str, ...]]] = {
    "ublox": ublox_unread,
    "septentrio": septentrio_unread,
}
"""Names of recorded navigation messages that are not written, by driver."""
MESSAGES = {"ublox": "RXM-RAWX", "novatel": "RANGE", "septentrio": "MeasEpoch"}
NAVIGATION_MESSAGES = {"ublox": "RXM-SFRBX", "novatel": "RAWEPHEM", "septentrio": "GPSRawCA"}
MARK_SOURCE = "event-mark"
_GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)


class GnssExportError(DaemonError):
    """Observations that cannot be exported; the message states what to record or to choose."""


@dataclass(frozen=True)
class GnssExport:
    """The folder, the written file, its figures, and exposures without a mark of the receiver.

    `other_receivers` have observations, too, and were not asked for. `navigation_message` names
    what a receiver records for `ephemerides`, `unread_messages` recorded ones that are not written.
    """

    folder: Path
    name: str
    written: RinexText
    counts: ObservationCounts
    without_mark: tuple[int, ...]
    crowded: int
    failures: tuple[ExposureFailure, ...]
    ephemerides: tuple[GpsEphemeris | BroadcastEphemeris, ...]
    navigation_message: str
    unread_messages: tuple[str, ...] = ()
    other_receivers: tuple[str, ...] = ()


def export_rinex(
    mission: Mission,
    *,
    version: str = "3.04",
    receiver: str | None = None,
    antenna: str = "",
    one_mark_per_epoch: bool = False,
) -> GnssExport:
    """Write `export/rinex/<receiver>/` with `<receiver>.obs` and `marks.csv`.

    Where the receiver recorded navigation messages, `<receiver>.nav` is written, too.

    Args:
        version: of RINEX.
        receiver: which one, where the flight had several with observations.
        antenna: type of the antenna by the names of the IGS.
        one_mark_per_epoch: refuse more than one mark between two epochs, as RTKLIB reads one.

    Raises:
        GnssExportError: no observations of such a receiver, or too many marks in an interval.
        OSError: the disk refused.
    """
    if version not in VERSIONS:
        raise GnssExportError(f"RINEX {version} is not written; {', '.join(VERSIONS)} are")
    name, driver, others = _receiver_of(mission, receiver)
    counts = ObservationCounts()
    recorded = _recorded(mission, name)
    epochs = list(DECODERS[driver](recorded, counts))
    if not epochs and driver == "septentrio" and has_meas3(recorded):
        raise GnssExportError(
            f"{mission.log_dir}: receiver {name} recorded Meas3Ranges, whose compression is not "
            "read, and no MeasEpoch; switch MeasEpoch on in the receiver before the flight, and "
            "convert this recording with Septentrio's sbf2rin (`syntopic export raw`)"
        )
    if not epochs:
        raise GnssExportError(
            f"{mission.log_dir}: receiver {name} recorded no {MESSAGES[driver]}; switch the "
            "message on in the receiver before the flight"
        )
    sealed = sealed_exposures(mission)
    exposures = list(sealed.results.values())
    marked = [e for e in exposures if e.mark_gps_ns is not None and e.mark_source == MARK_SOURCE]
    marks = [e.mark_gps_ns for e in marked if e.mark_gps_ns is not None]
    instants = sorted(epoch.gps_ns for epoch in epochs)
    intervals = Counter(bisect_left(instants, mark) for mark in marks)
    crowded = sum(count > 1 for count in intervals.values())
    if crowded and one_mark_per_epoch:
        raise GnssExportError(
            f"{crowded} intervals between epochs hold more than one event mark, and RTKLIB reads "
            "one in each; record observations more often, or use marks.csv with another program"
        )
    header = _header(mission, name, antenna, exposures)
    written = observation_text(header, epochs, marks, version=version)
    near_week = instants[0] // WEEK_NS
    ephemerides: list[GpsEphemeris | BroadcastEphemeris] = list(
        ephemerides_of(SUBFRAMES[driver](recorded), near_week=near_week)
    )
    if driver in PAGES:
        ephemerides += broadcast_ephemerides(PAGES[driver](recorded), near_week)
    folder = mission.export_dir / "rinex" / name
    texts = {f"{name}.obs": written.text, "marks.csv": _marks_text(marked, version)}
    if ephemerides:
        made = _GPS_EPOCH + timedelta(seconds=instants[0] // 1_000_000_000)
        texts[f"{name}.nav"] = navigation_text(
            ephemerides, version=version, made=made, comments=_simulated(exposures)
        )
    write_folder(folder, {file: [text.encode("utf-8")] for file, text in texts.items()})
    with_mark = {e.number for e in marked}
    without = tuple(e.number for e in exposures if e.number not in with_mark)
    return GnssExport(
        folder, f"{name}.obs", written, counts, without, crowded, tuple(sealed.failures),
        tuple(ephemerides), NAVIGATION_MESSAGES[driver],
        UNREAD[driver](recorded) if driver in UNREAD else (), others,
    )  # fmt: skip


def _receiver_of(mission: Mission, wanted: str | None) -> tuple[str, str, tuple[str, ...]]:
    """Name and driver of the receiver, and the others where none was chosen."""
    flown = {
        section["name"]: section["driver"]
        for section in mission.flown_configuration().get("navigator", [])
    }
    known = {name: driver for name, driver in flown.items() if driver in DECODERS}
    if wanted is not None and wanted not in known:
        raise GnssExportError(
            f"{wanted} is no receiver whose observations are read; this mission has "
            f"{', '.join(known) or 'none'} (drivers {', '.join(DECODERS)})"
        )
    if not known:
        raise GnssExportError(
            f"{mission.path}: no receiver of the drivers {', '.join(DECODERS)}; the recorded bytes "
            "of others are exported by `syntopic export raw`"
        )
    name = wanted if wanted is not None else next(iter(known))
    return name, known[name], tuple(known)[1:] if wanted is None else ()


def _recorded(mission: Mission, receiver: str) -> bytes:
    """All bytes of a receiver, in the order they were received."""
    topic = f"raw/{receiver}"
    return b"".join(
        message.payload
        for path in logs_of(mission.log_dir)
        for message in read(path)
        if message.topic == topic
    )


def _header(mission: Mission, name: str, antenna: str, exposures: list[Exposure]) -> RinexHeader:
    mount, _ = mount_of(mission)
    placed = next(
        (e.navigation for e in exposures if e.navigation and e.navigation.height_m is not None),
        None,
    )
    place = (0.0, 0.0, 0.0)
    if placed is not None:
        x, y, z = ECEF_FROM_GEODETIC.transform(
            placed.longitude_deg, placed.latitude_deg, placed.height_m
        )
        place = (float(x), float(y), float(z))
    return RinexHeader(
        marker=mission.id,
        receiver=(name, "", ""),
        antenna=("", antenna),
        position_m=place,
        lever_m=mount.antenna_m,
        comments=(
            "events of flag 5: mid-exposure of the reference head",
            "ANTENNA: DELTA X/Y/Z: body, forward right down, from rig",
            *_simulated(exposures),
        ),
    )


def _simulated(exposures: list[Exposure]) -> tuple[str, ...]:
    return ("SIMULATED: emulated hardware",) if any(e.simulated for e in exposures) else ()


def _marks_text(marked: list[Exposure], version: str) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("exposure", "gps_ns", "sigma_ns", "rinex_less_mark_ns", "count"))
    for exposure in marked:
        mark = exposure.mark_gps_ns or 0
        off_ns = written_ns(mark, version) - mark
        row = (exposure.number, mark, exposure.mark_sigma_ns, off_ns, exposure.mark_count)
        writer.writerow(row)
    return text.getvalue()
