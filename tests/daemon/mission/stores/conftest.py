"""A small flown mission, and an S3 server whose faults a test chooses."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import FlightLog
from daemon.mission.log.log_seals import seal_logs
from tests.daemon.mission.stores.faulty_s3 import BUCKET, REGION, Faults, serving
from tests.daemon.small_camera import fly, new_mission


@pytest.fixture
def mission(tmp_path: Path) -> Mission:
    mission = new_mission(tmp_path / "flown")
    fly(mission, range(1, 9))
    log = FlightLog.create(mission.log_dir)
    log.append("raw/gnss", 1, b"bytes" * 100)
    log.close()
    seal_logs(mission)
    return mission


@pytest.fixture
def store(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., str]]:
    """Starts the server: `store(faults)` is the address of a folder in its bucket."""
    pytest.importorskip("obstore", reason="pip install 'syntopic[stores]'")
    pytest.importorskip("moto.server")
    with ExitStack() as stack:

        def start(faults: Faults | None = None) -> str:
            endpoint = stack.enter_context(serving(faults or Faults()))
            for name, value in {
                "AWS_ENDPOINT_URL": endpoint,
                "AWS_ALLOW_HTTP": "true",
                "AWS_REGION": REGION,
                "AWS_ACCESS_KEY_ID": "test",
                "AWS_SECRET_ACCESS_KEY": "test",
            }.items():
                monkeypatch.setenv(name, value)
            return f"s3://{BUCKET}/missions"

        yield start
