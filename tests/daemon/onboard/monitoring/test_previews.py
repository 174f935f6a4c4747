"""Thumbnails and residual vectors reach the thinnest link, behind everything that matters more."""

from __future__ import annotations

import json
from pathlib import Path

import msgpack
import numpy as np
import pytest

from daemon.cli.monitor import _MonitorState
from daemon.onboard.monitoring.flight_state import PARTS, PREVIEW_PARTS, FlightState
from daemon.onboard.monitoring.mavlink.datagrams import (
    DATAGRAM_MAX_BYTES,
    DatagramReceiver,
    DatagramScheduler,
)
from daemon.onboard.monitoring.previews import PIECE_BYTES, VECTORS_MAX, read_preview
from daemon.onboard.monitoring.telemetry import Subscription, packed
from tests.daemon.onboard.monitoring import flight_events

JPEG = bytes(np.random.default_rng(7).integers(0, 256, 3100, dtype=np.uint8))
VECTORS = [[10 * k, 20, 0.123, -0.456, k % 3] for k in range(200)]


@pytest.fixture
def state(tmp_path: Path) -> FlightState:
    for number in (1, 2):
        folder = tmp_path / f"L2/{number:06d}"
        folder.mkdir(parents=True)
        (folder / "thumbnail.jpg").write_bytes(JPEG)
        reported = {"width_px": 3600, "height_px": 2400, "overlaps": [], "vectors": VECTORS}
        (folder / "residuals.json").write_text(json.dumps(reported))
    state = FlightState("syntopic", pictures=read_preview)
    state.apply(flight_events.mission(str(tmp_path)))
    return state


def fly(state: FlightState, number: int) -> None:
    for event in (*flight_events.exposure(number), flight_events.status(triggers=number)):
        state.apply(event)


def test_a_client_with_a_kilobyte_per_second_receives_verdict_then_picture(
    state: FlightState,
) -> None:
    fly(state, 1)
    watcher = Subscription(1000.0, (*PARTS, *PREVIEW_PARTS))
    seen_s: dict[str, float] = {}
    pieces: dict[int, bytes] = {}
    vectors = []
    for tick in range(600):
        record = watcher.record(state, tick * 0.1)
        if record is None:
            continue
        assert len(packed(record)) <= 2 * 1000
        for part in (*PARTS, *PREVIEW_PARTS):
            if record.get(part):
                seen_s.setdefault(part, tick * 0.1)
        vectors += record.get("residuals", [])
        pieces |= {one["piece"]: one["data"] for one in record.get("thumbnails", [])}
    assert b"".join(pieces[k] for k in sorted(pieces)) == JPEG
    assert seen_s["exposures"] <= seen_s["residuals"] <= seen_s["thumbnails"] < 30.0
    assert vectors[0]["number"] == 1
    assert len(vectors[0]["vectors"]) == VECTORS_MAX
    assert list(vectors[0]["vectors"][1][:4]) == [50, 20, 123, -456]


def test_pictures_are_not_part_of_the_snapshot_and_old_ones_are_let_go(state: FlightState) -> None:
    for number in range(1, 30):
        fly(state, 1 + number % 2)
    snapshot = json.dumps(state.snapshot())
    assert "thumbnails" not in snapshot
    assert len(state.changed("thumbnails", 0)) == 40


def test_over_a_link_that_loses_a_third_the_newest_picture_comes_together(
    state: FlightState,
) -> None:
    fly(state, 1)
    fly(state, 2)
    random = np.random.default_rng(3)
    sender, received = DatagramScheduler(4000.0), DatagramReceiver()
    sent_bytes = 0
    for tick in range(600):
        for datagram in sender.due(state, tick * 0.1):
            assert len(datagram) <= DATAGRAM_MAX_BYTES
            sent_bytes += len(datagram)
            if random.random() > 0.3:
                received.receive(datagram)
    assert received.thumbnail(2) == JPEG
    assert received.residuals[2]["size_px"] == [3600, 2400]
    assert sorted(received.exposures) == [1, 2]
    assert sent_bytes <= 4000.0 * 61
    assert received.rejected_count == 0


@pytest.mark.parametrize("text", ["", "[]", '{"vectors": [[1]]}', "{" * 5000, '{"vectors": 7}'])
def test_what_is_no_residuals_file_is_passed_over(tmp_path: Path, text: str) -> None:
    folder = tmp_path / "L2/000001"
    folder.mkdir(parents=True)
    (folder / "residuals.json").write_text(text)
    (folder / "thumbnail.jpg").write_bytes(b"x" * (2 * PIECE_BYTES + 1))
    found = read_preview(str(tmp_path), 1)
    assert found.vectors == ()
    assert [len(piece) for piece in found.pieces] == [PIECE_BYTES, PIECE_BYTES, 1]
    assert read_preview(None, 1).pieces == read_preview(str(tmp_path), 2).pieces == ()


def test_a_piece_is_bytes_in_msgpack(state: FlightState) -> None:
    fly(state, 1)
    piece = msgpack.unpackb(packed(state.changed("thumbnails", 0)[0]))
    assert piece["data"] == JPEG[:PIECE_BYTES]
    assert piece["pieces"] == 5


def test_the_terminal_keeps_what_it_shows_and_can_print_it(state: FlightState) -> None:
    fly(state, 1)
    shown = _MonitorState()
    record = Subscription(parts=(*PARTS, *PREVIEW_PARTS)).record(state, 0.0)
    assert record["thumbnails"]
    shown.receive(dict(record))
    assert json.loads(json.dumps(shown.as_json()))["exposures"][0]["number"] == 1
