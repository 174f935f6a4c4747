"""The parsers that meet a network or a file of others, each as one function of bytes.

What a parser documents as its errors may be raised; anything else is a crash, and so is an input
that takes more than a second of CPU or 64 MB.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import io
import json
import logging
import shutil
import struct
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np

logging.getLogger("tifffile").setLevel(logging.CRITICAL)

INPUT_MAX_S = 1.0
INPUT_MAX_NBYTES = 64_000_000
INPUT_MAX_SIZE = 16_384
"""No longer inputs are tried: what is long is bounded by the limits of each reader."""


@dataclass(frozen=True)
class Target:
    """A parser, the errors that it documents, and inputs to begin with."""

    parse: Callable[[bytes], object]
    errors: tuple[type[Exception], ...]
    seeds: tuple[bytes, ...]

    def run(self, data: bytes) -> None:
        """Parse; a documented error is an answer."""
        try:
            self.parse(data)
        except self.errors as error:
            # Sentences are made when they are read.
            str(error).encode("utf-8", "backslashreplace")


@functools.cache
def _folder() -> Path:
    place = tempfile.mkdtemp(prefix="fuzz-")
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    return Path(place)


def _file(name: str, data: bytes) -> Path:
    path = _folder() / name
    path.write_bytes(data)
    return path


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
    from daemon.configuration.service_file import from_mapping
    from processing.rig.toml_text import TomlError, parse_toml

    seed = (
        b'[mission]\nroot = "m"\nrig = "ultracam-x-mini"\n[plan]\nelevation = "d.tif"\n'
        b'elevation_crs = "EPSG:25833+7837"\n[trigger]\ndriver = "pulse-bus"\nport = "a"\n'
        b'[[head]]\nsensor = "SU00"\ndriver = "aravis"\naddress = "10.0.0.5"\n'
        b'[[navigator]]\nname = "gnss"\ndriver = "ublox"\nport = "udpin://0.0.0.0:1"\n'
        b"[watch]\nport = 8080\nanonymous_read = true\n[limits]\nexposures_in_memory = 3\n"
    )
    return Target(
        lambda data: from_mapping(parse_toml(data), _folder() / "service.toml"),
        (ConfigurationError, TomlError),
        (seed,),
    )


def tokens() -> Target:
    from daemon.onboard.monitoring.access.tokens import TokenError, read_tokens

    def parse(data: bytes) -> object:
        path = _file("tokens.toml", data)
        path.chmod(0o600)
        return read_tokens(path)

    seed = b'[pilot]\nrole = "command"\nsha256 = "' + b"a" * 64 + b'"\n'
    return Target(parse, (TokenError,), (seed,))


# Records


def exposure_record() -> Target:
    from daemon.mission.canonical_json import RecordError, parse_record
    from daemon.mission.exposure import capture_bytes, capture_from_json, exposure_bytes, from_json
    from tests.daemon.small_camera import capture_of, final_record

    def parse(data: bytes) -> object:
        content = parse_record(data, "exposure.json")
        with contextlib.suppress(RecordError):
            from_json(content)
        return capture_from_json(content)

    stored = capture_of(1)
    seeds = (capture_bytes(stored), exposure_bytes(final_record(stored)))
    return Target(parse, (RecordError,), seeds)


def quality_report() -> Target:
    from daemon.mission.canonical_json import RecordError
    from daemon.mission.store.level2 import read_report
    from processing.quality import valid_area

    def parse(data: bytes) -> object:
        report = read_report(_file("quality.json", data).parent)
        return valid_area.from_json((report or {}).get("valid_area"))

    content = {
        "verdict": "usable",
        "findings": [{"flag": "BLUR", "sentence": "x", "verdict": "usable"}],
        "figures": {"sigma0_um": 0.2},
        "valid_area": {"columns": 4, "rows": 3, "gaps": {"pan": [[0, 0, 2, 1]]}},
    }
    return Target(parse, (RecordError,), (json.dumps(content).encode(),))


def stitch_record() -> Target:
    from daemon.mission.canonical_json import RecordError, parse_record
    from processing.mosaic.stitch_record import StitchRecordError, stitch_record_from_json

    return Target(
        lambda data: stitch_record_from_json(parse_record(data, "mosaic.json")),
        (RecordError, StitchRecordError),
        (
            b'{"format":1,"names":["a","b"],"values":[1,2],"covariance":[1,0,1],"rig":"r",'
            b'"calibration_id":"c","dc_k":{"1":0.5},"measured":["a"],"sigma0":1,"estimated_dc":[],'
            b'"height_m":900}',
        ),
    )


def flight_log() -> Target:
    from mcap.writer import CompressionType, Writer

    from daemon.mission.log.flight_log import read
    from daemon.mission.log.log_records import record_of

    def seed(compression: CompressionType) -> bytes:
        buffer = BytesIO()
        writer = Writer(buffer, compression=compression, chunk_size=200)
        writer.start()
        channel = writer.register_channel("event/x", "json", 0)
        for number in range(6):
            writer.add_message(channel, number, b'{"name":"x"}', number, number)
        writer.finish()
        return buffer.getvalue()

    def parse(data: bytes) -> object:
        return [record_of(message) for message in read(_file("x.mcap", data))]

    kinds = (CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD)
    return Target(parse, (), tuple(seed(kind) for kind in kinds))


def chain() -> Target:
    from daemon.mission.verification.chain_file import first_line, read_history

    return Target(
        lambda data: read_history(_file("chain.jsonl", data)), (), (first_line("a" * 64),)
    )


# Rasters and calibrations


def _small_tiff(**options: object) -> bytes:
    import tifffile

    buffer = BytesIO()
    pixels = np.arange(16 * 24, dtype=np.uint16).reshape(16, 24)
    tifffile.imwrite(buffer, pixels, metadata=None, **options)
    return buffer.getvalue()


def _tiffs() -> tuple[bytes, ...]:
    return (
        _small_tiff(),
        _small_tiff(compression="zlib", predictor=True),
        _small_tiff(bigtiff=True, description='{"syntopic":1}'),
        _small_tiff(tile=(16, 16), compression="zlib"),
    )


def level0_tiff() -> Target:
    from daemon.mission.store.level0 import (
        RasterError,
        check_tiff,
        read_description,
        read_frame,
        read_tiff,
    )

    def parse(data: bytes) -> None:
        path = _file("SU00.tif", data)
        read_description(path)
        for attempt in (
            lambda: read_tiff(path),
            lambda: read_tiff(path, plane=1),
            lambda: read_frame(path, width_px=24, height_px=16),
            lambda: check_tiff(path, width_px=24, height_px=16),
        ):
            try:
                attempt()
            except RasterError as error:
                str(error)

    return Target(parse, (), _tiffs())


def folder_frame() -> Target:
    from drivers.cameras.folder.frames import FrameFileError, read_frame

    return Target(
        lambda data: read_frame(_file("a.tif", data), max_nbytes=1_000_000),
        (FrameFileError,),
        _tiffs(),
    )


def rededge_image() -> Target:
    from daemon.postflight.importers.rededge import ImagesError, read_image
    from tests.daemon.rededge_data import packet, write_tiff

    path = _folder() / "seed.tif"
    write_tiff(path, packet())
    seeds = (path.read_bytes()[:INPUT_MAX_SIZE], *_tiffs())
    return Target(lambda data: read_image(_file("IMG_0001_1.tif", data)), (ImagesError,), seeds)


@functools.cache
def _georeference() -> object:
    from daemon.orientation.georeference import Georeference

    return Georeference("EPSG:32633")


def elevation_tiff() -> Target:
    import rasterio

    from daemon.orientation.elevation import ElevationError, read_elevation

    path = _folder() / "seed.tif"
    place = rasterio.Affine(10, 0, 5e5, 0, -10, 5e6)
    with rasterio.open(
        path, "w", driver="GTiff", width=4, height=3, count=1, dtype="float32",
        crs="EPSG:32633", transform=place, nodata=-9999,
    ) as raster:  # fmt: skip
        raster.write(np.full((3, 4), 300.0, np.float32), 1)
    system = _georeference()
    return Target(
        lambda data: read_elevation(_file("d.tif", data), system),  # type: ignore[arg-type]
        (ElevationError,),
        (path.read_bytes(),),
    )


def elevation_ascii() -> Target:
    from daemon.orientation.elevation import ElevationError, read_elevation

    seed = (
        b"ncols 2\nnrows 2\nxllcorner 500000\nyllcenter 5200000\nxllcenter 1\ncellsize 10\n"
        b"NODATA_value -9999\n1 2.5\n-9999 4e1\n"
    )
    system = _georeference()
    return Target(
        lambda data: read_elevation(_file("d.asc", data), system),  # type: ignore[arg-type]
        (ElevationError,),
        (seed,),
    )


def radiometry() -> Target:
    from processing.radiometry.calibration import CalibrationError, load_radiometry

    maps = {key: np.ones((2, 3), np.float32) for key in ("bias_dn", "dark_dn_per_s", "gain")}
    scalars = {"doubling_k": np.float64(6.0), "reference_c": np.float64(20.0)}
    buffer = BytesIO()
    np.savez(buffer, **maps, **scalars, defect=np.zeros((2, 3), np.uint8))
    return Target(
        lambda data: load_radiometry(_file("SU00.npz", data)),
        (CalibrationError,),
        (buffer.getvalue(),),
    )


# Other documents


def trajectory_csv() -> Target:
    from daemon.orientation.trajectory import TrajectoryError, read_trajectory

    seed = (
        b"gps_ns,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg\n"
        b"1447400000000000000,47.0,15.0,1000,0,0,90\n1447400001000000000,47.0,15.1,1000,0,0,90\n"
    )
    return Target(
        lambda data: read_trajectory(_file("t.csv", data), around_gps_ns=1_447_400_000_000_000_000),
        (TrajectoryError,),
        (seed,),
    )


def trajectory_sbet() -> Target:
    from daemon.orientation.trajectory import TrajectoryError, read_trajectory

    seed = b"".join(struct.pack("<17d", float(t), 0.8, 0.26, 900.0, *[0.1] * 13) for t in (1, 2, 3))
    return Target(
        lambda data: read_trajectory(_file("t.out", data), around_gps_ns=1_447_400_000_000_000_000),
        (TrajectoryError,),
        (seed,),
    )


def xmp() -> Target:
    from daemon.postflight.importers.xmp import XmpError, read_xmp
    from tests.daemon.rededge_data import packet

    def parse(data: bytes) -> object:
        found = read_xmp(data, "a.tif")
        return found.numbers("VignettingPolynomial", 6), found.number("CentralWavelength")

    return Target(parse, (XmpError,), (packet(),))


def dbat_script() -> Target:
    from daemon.postflight.adjustment.csv_tables import ProjectError
    from daemon.postflight.importers.dbat import import_dbat

    seed = (
        b"<document><meta><name>n</name></meta><input><cameras><camera><name>c</name>"
        b"<image>4000,3000</image><sensor>auto,4.5</sensor><model>3</model><focal>8</focal>"
        b'</camera></cameras><images><file format="id,path">i.csv</file></images>'
        b'<image_pts><file format="im,id,x,y,sxy">p.csv</file></image_pts>'
        b'<ctrl_pts><file format="id,label,x,y,z">c.csv</file></ctrl_pts></input></document>'
    )
    _file("i.csv", b"1,a.jpg\n")
    _file("p.csv", b"1,2,3.0,4.0,0.1\n")
    _file("c.csv", b"2,a,1,2,3\n")
    return Target(lambda data: import_dbat(_file("s.xml", data)), (ProjectError,), (seed,))


def adjustment_project() -> Target:
    from daemon.postflight.adjustment.csv_tables import ProjectError
    from daemon.postflight.adjustment.project_file import read_project_file

    seed = b'format = 1\nname = "n"\n[[camera]]\nname = "c"\nf_mm = 50\nfree = ["k1"]\n'
    return Target(lambda data: read_project_file(_file("p.toml", data)), (ProjectError,), (seed,))


def adjustment_table() -> Target:
    from daemon.postflight.adjustment.csv_tables import ProjectError, read_table

    def parse(data: bytes) -> object:
        return read_table(_file("t.csv", data), ("point",), ("x_m",)).numbers("x_m")

    return Target(parse, (ProjectError,), (b'# remark\npoint,x_m\na,1.5\n"b,c",\n',))


def laboratory_series() -> Target:
    from daemon.postflight.calibration.laboratory.laboratory_series import SeriesError, read_series
    from daemon.postflight.calibration.laboratory.radiometric import RadiometricSeries
    from processing.rig import RigError, shipped_rigs

    def parse(data: bytes) -> object:
        return read_series(_file("series.json", data).parent, RadiometricSeries)

    (_folder() / "rig.toml").write_bytes(shipped_rigs()["rededge"].read_bytes())
    content = {"format": 1, "kind": "radiometric", "date": "2026-01-01", "images": [{"file": "a"}]}
    return Target(parse, (SeriesError, RigError), (json.dumps(content).encode(),))


def catalog() -> Target:
    import sqlite3

    from daemon.mission.catalog.catalog import Catalog, CatalogError

    path = _folder() / "seed.db"
    path.unlink(missing_ok=True)
    Catalog.open(path).close()
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
    connection.close()

    def parse(data: bytes) -> None:
        opened = Catalog.read(_file("m.db", data))
        try:
            list(opened.events())
        finally:
            opened.close()

    return Target(parse, (CatalogError,), (path.read_bytes(),))


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
    from rich.console import Console

    from daemon.cli.monitor import MonitorError, _MonitorState
    from daemon.onboard.monitoring.client.telemetry_client import _record

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
        from tests.faults.hostile_parsers import PARSERS

        parser = PARSERS[name]()
        return Target(parser.feed, (), parser.genuine[:8])

    return make


DEVICES = (
    "ublox", "nmea", "novatel", "septentrio", "sbg", "vectornav", "xsens", "applanix", "mavlink", "gpsd",
    "ascii-line", "modbus", "pulse-bus", "gvcp-answer", "gvcp-command",
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
