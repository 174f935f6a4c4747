"""What Foxglove opens: read back by the mcap library, held against the schemas as published."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jsonschema_rs
import pytest
from mcap.reader import make_reader

from daemon.mission.exposure import Exposure, exposure_bytes
from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import FlightLog
from daemon.mission.log.log_records import message_of
from daemon.onboard.service.command_execution import audit_message
from daemon.onboard.service.messages import Answer, ServiceCommand
from daemon.postflight.export.foxglove import export_foxglove, utc_ns
from drivers.contract import DeviceEvent
from tests.daemon.onboard.flight.test_flight import GPS_NS, nav

PUBLISHED = {
    "foxglove.LocationFix": {
        *("timestamp", "frame_id", "latitude", "longitude", "altitude"),
        *("position_covariance", "position_covariance_type"),
    },
    "foxglove.CompressedImage": {"timestamp", "frame_id", "data", "format"},
    "foxglove.Log": {"timestamp", "level", "message", "name", "file", "line"},
}
"""Fields of the schemas at docs.foxglove.dev, by name."""

JPEG = b"\xff\xd8 a picture \xff\xd9"


@pytest.fixture
def mission(tmp_path: Path) -> Mission:
    mission = Mission.create(
        tmp_path, "small", rig_toml=b"", service_toml=b"", started_utc=datetime.now(UTC)
    )
    log = FlightLog.create(mission.log_dir, boot_id="b")
    sample = nav(0.0)
    lost = DeviceEvent("SU02", "lost", True, "SU02 is gone; look.", sample.mono_ns + 1_000_000_000)
    command = ServiceCommand(1, "start", {}, "operator")
    audit = audit_message(command, Answer(1, True, "the line runs"))
    for record in (sample, nav(0.2), lost, replace(sample, gps_ns=0, time_valid=False)):
        message = message_of(record)
        log.append(message.topic, message.mono_ns, message.payload)
    log.append(audit.topic, sample.mono_ns, audit.payload)
    log.close()
    folder = mission.level0(7)
    folder.mkdir(parents=True)
    exposure = Exposure(number=7, mark_gps_ns=GPS_NS + 100_000_000, line_id="A7")
    (folder / "exposure.json").write_bytes(exposure_bytes(exposure))
    products = mission.level2(7)
    products.mkdir(parents=True)
    (products / "thumbnail.jpg").write_bytes(JPEG)
    report = {"verdict": "refly", "findings": [{"sentence": "Saturated."}]}
    (products / "quality.json").write_text(json.dumps(report))
    return mission


def messages_of(path: Path) -> list[tuple[str, str, int, dict[str, Any]]]:
    """Schema, topic, time and content of every message; each is valid under its own schema."""
    found = []
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            content = json.loads(message.data)
            own = json.loads(schema.data)
            jsonschema_rs.validate(own, content)
            assert set(own["properties"]) == set(content) == PUBLISHED[schema.name]
            assert own["title"] == schema.name
            # Foxglove's own reader refuses a field that has neither.
            assert all("type" in field or "oneOf" in field for field in own["properties"].values())
            stamp = content["timestamp"]
            assert stamp["sec"] * 10**9 + stamp["nsec"] == message.log_time
            found.append((schema.name, channel.topic, message.log_time, content))
    return found


def test_track_thumbnails_and_messages_are_written_in_utc_in_order(mission: Mission) -> None:
    done = export_foxglove(mission)
    assert done.messages == {"/fix": 2, "/log": 3, "/thumbnail": 1}
    found = messages_of(done.file)
    assert [time_ns for *_, time_ns, _ in found] == sorted(time_ns for *_, time_ns, _ in found)
    fixes = [content for name, _, _, content in found if name == "foxglove.LocationFix"]
    assert (fixes[0]["latitude"], fixes[0]["longitude"]) == (48.0, 11.0)
    assert fixes[0]["position_covariance"][8] == pytest.approx(0.9**2)
    (image,) = [content for name, _, _, content in found if name == "foxglove.CompressedImage"]
    assert base64.b64decode(image["data"]) == JPEG
    assert image["format"] == "jpeg"
    logs = {c["name"]: (c["level"], c["message"], t) for n, _, t, c in found if n == "foxglove.Log"}
    assert logs["SU02"][:2] == (4, "SU02 is gone; look.")
    assert logs["exposures"][:2] == (4, "exposure 7, line A7: complete, refly. Saturated.")
    assert logs["operator"][:2] == (2, "start: the line runs")
    # A second after the first position had arrived, in UTC.
    assert logs["SU02"][2] == pytest.approx(utc_ns(GPS_NS) + 10**9, abs=1000)


def test_gps_instants_are_utc_less_leap_seconds() -> None:
    # 2017-01-01T00:00:18 GPS is the UTC midnight after the 18th leap second.
    midnight = datetime(2017, 1, 1, tzinfo=UTC).timestamp()
    gps_ns = round((midnight - 315_964_800 + 18) * 1e9)
    assert utc_ns(gps_ns) == round(midnight * 1e9)


def test_a_mission_without_anything_is_an_empty_file_that_opens(tmp_path: Path) -> None:
    empty = Mission.create(
        tmp_path, "small", rig_toml=b"", service_toml=b"", started_utc=datetime.now(UTC)
    )
    done = export_foxglove(empty)
    assert done.messages == {}
    assert messages_of(done.file) == []
