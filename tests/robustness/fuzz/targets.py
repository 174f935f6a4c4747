"""The parsers that meet a network or a file of others, each as one function of bytes.

What a parser documents as its errors may be raised; anything else is a crash, and so is an input
that takes more than a second of CPU or 64 MB.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
from collections.abc import Callable, Mapping
from pathlib import Path

from tests.robustness.fuzz.mission_targets import (
    chain,
    exposure_record,
    flight_log,
    folder_frame,
    level0_tiff,
    quality_report,
    rededge_image,
    stitch_record,
)
from tests.robustness.fuzz.postflight_targets import (
    adjustment_project,
    adjustment_table,
    catalog,
    dbat_script,
    elevation_ascii,
    elevation_tiff,
    laboratory_series,
    radiometry,
    trajectory_csv,
    trajectory_sbet,
    xmp,
)
from tests.robustness.fuzz.target import Target, scratch_file, scratch_folder

logging.getLogger("tifffile").setLevel(logging.CRITICAL)


def _line(name: str, start: tuple[float, float]) -> dict[str, object]:
    geometry = {"type": "LineString", "coordinates": [start, (start[0] + 0.01, start[1])]}
    return {"type": "Feature", "properties": {"id": name, "strip": "S"}, "geometry": geometry}


# Plans, rigs, configurations


def plan_geojson() -> Target:
    from daemon.planning.plan_readers import PlanError, plan_from_bytes

    place = {"type": "Point", "coordinates": [15.001, 47.0]}
    content = {
        "type": "FeatureCollection",
        "features": [
            _line("L1", (15.0, 47.0)),
            {"type": "Feature", "properties": {"line": "L1"}, "geometry": place},
        ],
        "specification": {"forward_overlap": 0.8, "sun_deg": 10},
    }
    seed = json.dumps(content).encode()
    return Target(lambda data: plan_from_bytes(Path("p.geojson"), data), (PlanError,), (seed,))


def plan_kml() -> Target:
    from daemon.planning.plan_readers import PlanError, plan_from_bytes

    text = (
        '<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark>'
        "<name>7</name><LineString><coordinates>15.43,47.07,900 15.45,47.07,900</coordinates>"
        "</LineString></Placemark></Document></kml>"
    )
    seeds = (text.encode(), text.replace("1.0", "1.0", 1).encode("utf-16"))
    return Target(lambda data: plan_from_bytes(Path("p.kml"), data), (PlanError,), seeds)


def plan_qgroundcontrol() -> Target:
    from daemon.planning.plan_readers import PlanError, plan_from_bytes

    items = [
        {"command": 16, "params": [0, 0, 0, None, 47.0, 15.4, 100]},
        {"command": 206, "params": [25, 0, 1, 0, 0, 0, 0]},
        {"command": 16, "params": [0, 0, 0, None, 47.01, 15.4, 100]},
        {"command": 2000, "params": [0, 0, 1]},
        {
            "TransectStyleComplexItem": {
                "VisualTransectPoints": [[47.1, 15.4], [47.2, 15.4]],
                "CameraCalc": {"AdjustedFootprintFrontal": 20.0},
            }
        },
    ]
    seed = json.dumps({"fileType": "Plan", "mission": {"items": items}}).encode()
    return Target(lambda data: plan_from_bytes(Path("p.plan"), data), (PlanError,), (seed,))


def rig() -> Target:
    from processing.rig import RigError, rig_from_mapping, shipped_rigs
    from processing.rig.toml_text import TomlError, parse_toml

    seeds = tuple(shipped_rigs()[name].read_bytes()[:8000] for name in ("rededge", "midas-mini"))
    return Target(
        lambda data: rig_from_mapping(parse_toml(data), "rig.toml"), (RigError, TomlError), seeds
    )


def configuration() -> Target:
    from daemon.configuration.model import ConfigurationError
    from daemon.onboard.preflight.service_file import from_mapping
    from processing.rig.toml_text import TomlError, parse_toml

    seed = (
        b'[mission]\nroot = "m"\nrig = "ultracam-x-mini"\n[plan]\nelevation = "d.tif"\n'
        b'elevation_crs = "EPSG:25833+7837"\n[trigger]\ndriver = "pulse-bus"\nport = "a"\n'
        b'[[head]]\nsensor = "SU00"\ndriver = "aravis"\naddress = "10.0.0.5"\n'
        b'[[navigator]]\nname = "gnss"\ndriver = "ublox"\nport = "udpin://0.0.0.0:1"\n'
        b"[watch]\nport = 8080\nanonymous_read = true\n[limits]\nexposures_in_memory = 3\n"
    )
    return Target(
        lambda data: from_mapping(parse_toml(data), scratch_folder() / "service.toml"),
        (ConfigurationError, TomlError),
        (seed,),
    )


def tokens() -> Target:
    from daemon.onboard.monitoring.access.tokens import TokenError, read_tokens

    def parse(data: bytes) -> object:
        path = scratch_file("tokens.toml", data)
        path.chmod(0o600)
        return read_tokens(path)

    seed = b'[pilot]\nrole = "command"\nsha256 = "' + b"a" * 64 + b'"\n'
    return Target(parse, (TokenError,), (seed,))


# Records


# Rasters and calibrations


# Other documents


# Networks


def telemetry() -> Target:
    import msgpack

    from daemon.onboard.monitoring.mavlink.datagrams import VERSION, DatagramReceiver

    def parse(data: bytes) -> object:
        received = DatagramReceiver()
        received.receive(data)
        received.receive(data[::-1])
        return [received.thumbnail(number) for number in list(received._pieces)]

    def seed(kind: str, **content: object) -> bytes:
        packed: bytes = msgpack.packb({"version": VERSION, "kind": kind, "content": content})
        return packed

    seeds = (
        seed("brief", sequence=1, exposures=3),
        seed("exposure", number=1, sequence=2),
        seed("thumbnail", number=1, piece=0, pieces=1, sequence=2, data=b"x"),
    )
    return Target(parse, (), seeds)


def monitor() -> Target:
    """What `syntopic monitor` receives over its WebSocket, until it is drawn and printed."""
    import msgpack

    from daemon.cli.monitor import MonitorError, _MonitorState
    from daemon.onboard.monitoring.client.telemetry_client import _record
    from daemon.terminal.console import Console

    console = Console(file=io.StringIO(), width=100)

    def parse(data: bytes) -> object:
        seen = _MonitorState()
        seen.receive(_record(data))
        console.print(seen.drawn("127.0.0.1:8000"))
        console.file.seek(0)
        console.file.truncate()
        return json.dumps(seen.as_json())

    exposure = {"number": 7, "verdict": "good", "step": "judged", "frames": 13}
    fault = {"sentence": "SU00 does not answer; look at its cable", "stands": True}
    status = {"exposures_left": 12, "clock_sigma_ns": 2.5e3}
    brief = {"phase": "flying", "mission": {"id": "m"}, "status": status, "faults": [fault]}
    seed: bytes = msgpack.packb({**brief, "exposures": [exposure], "devices": [{"name": "SU00"}]})
    errors = (MonitorError, ValueError, TypeError, RecursionError, msgpack.UnpackException)
    return Target(parse, errors, (seed, msgpack.packb(brief)))


def control_line() -> Target:
    from daemon.onboard.monitoring.access.control_socket import _is_state_query, _request

    def parse(data: bytes) -> object:
        return _is_state_query(data), _request(data)

    seed = b'{"command": "interval", "arguments": {"interval_s": 2.0, "count": 3}}'
    return Target(parse, (), (seed, b'{"command": "state"}'))


def page_link() -> Target:
    from daemon.onboard.service.messages import CommandRefused, Pong, ServiceCommand, ServiceEvent
    from daemon.onboard.service.page_messages import (
        InvalidMessageError,
        pack_from_page,
        unpack_from_page,
        unpack_to_page,
    )

    def parse(data: bytes) -> object:
        """Both directions: what is a message of one is none of the other."""
        with contextlib.suppress(InvalidMessageError):
            unpack_to_page(data)
        return unpack_from_page(data)

    arguments = {"interval_s": 2.0, "count": 3, "override": False, "reason": "x"}
    seeds = (
        Pong({}),
        ServiceCommand(1, "interval", arguments, "anna", "operator", "10.0.0.9"),
        CommandRefused("land", "unknown", "none", "10.0.0.66", "no"),
        ServiceEvent({"event": "watching", "host": "::", "port": 8080, "tls": True}),
    )
    return Target(parse, (InvalidMessageError,), tuple(map(pack_from_page, seeds)))


def command_body() -> Target:
    from daemon.onboard.monitoring.web.request_body import parse_command_body

    seed = b'{"interval_s": 2.0, "count": 3, "reason": "x"}'
    return Target(parse_command_body, (ValueError,), (seed,))


def signed_mavlink() -> Target:
    from daemon.onboard.monitoring.mavlink.signatures import Signatures

    def parse(data: bytes) -> object:
        return Signatures(bytes(32), None).accept(data)

    return Target(parse, (), (bytes([0xFD, 9, 1, 0, 0, 255, 190]) + bytes(3 + 9 + 2 + 13),))


def device(name: str) -> Callable[[], Target]:
    """A driver's parser; it keeps its state from input to input, as in flight."""

    def make() -> Target:
        from tests.robustness.faults.hostile_parsers import PARSERS

        parser = PARSERS[name]()
        return Target(parser.feed, (), parser.genuine[:8])

    return make


DEVICES = (
    "ublox", "nmea", "novatel", "septentrio", "sbg", "vectornav", "xsens", "applanix", "gsof",
    "mavlink", "gpsd", "ascii-line", "modbus", "pulse-bus", "gvcp-answer", "gvcp-command",
)  # fmt: skip

TARGETS: Mapping[str, Callable[[], Target]] = {
    "plan-geojson": plan_geojson,
    "plan-kml": plan_kml,
    "plan-qgroundcontrol": plan_qgroundcontrol,
    "rig": rig,
    "configuration": configuration,
    "tokens": tokens,
    "exposure-record": exposure_record,
    "quality-report": quality_report,
    "stitch-record": stitch_record,
    "flight-log": flight_log,
    "chain": chain,
    "level0-tiff": level0_tiff,
    "folder-frame": folder_frame,
    "rededge-image": rededge_image,
    "elevation-tiff": elevation_tiff,
    "elevation-ascii": elevation_ascii,
    "radiometry": radiometry,
    "trajectory-csv": trajectory_csv,
    "trajectory-sbet": trajectory_sbet,
    "xmp": xmp,
    "dbat-script": dbat_script,
    "adjustment-project": adjustment_project,
    "adjustment-table": adjustment_table,
    "laboratory-series": laboratory_series,
    "catalog": catalog,
    "telemetry": telemetry,
    "monitor": monitor,
    "control-line": control_line,
    "command-body": command_body,
    "page-link": page_link,
    "signed-mavlink": signed_mavlink,
    **{f"device-{name}": device(name) for name in DEVICES},
}
