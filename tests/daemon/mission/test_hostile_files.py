"""Foreign TIFFs, flight logs and missions: refused with a message, in bounded time and memory."""

from __future__ import annotations

import os
import socket
import sqlite3
import struct
import time
import tracemalloc
import zlib
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from daemon.mission.catalog.catalog import Catalog, CatalogError
from daemon.mission.layout import Mission, MissionError
from daemon.mission.log.flight_log import RECORD_MAX_NBYTES, FlightLog, read
from daemon.mission.log.log_records import record_of
from daemon.mission.store.level0 import RasterError, read_description, read_tiff, tiff_parts
from daemon.mission.store.store import verify
from daemon.mission.verification.recovery import recover
from daemon.planning.plan_readers import PlanError, read_plan
from tests.daemon.small_camera import complete_from_log, fly, new_mission

MEMORY_BYTES = 40_000_000
"""What reading any small hostile file may take at most."""
SECONDS = 5.0

QUIET = settings(
    max_examples=150,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def mutated(seed: bytes) -> st.SearchStrategy[bytes]:
    """The bytes with some of them changed, left out, put in, or the end cut off."""
    positions = st.integers(0, len(seed) - 1)
    # Sizes and offsets are where it hurts.
    values = st.one_of(
        st.binary(min_size=1, max_size=8),
        st.sampled_from([2**32 - 1, 2**31, 2**31 - 1, 2**16, 0, 1]).map(
            lambda number: struct.pack("<I", number)
        ),
        st.sampled_from([2**64 - 1, 2**63, 2**40]).map(lambda number: struct.pack("<Q", number)),
    )
    changes = st.lists(st.tuples(positions, values, st.integers(0, 8)), min_size=1, max_size=6)

    def apply(changed: list[tuple[int, bytes, int]]) -> bytes:
        data = bytearray(seed)
        for position, value, kind in changed:
            if kind == 0:
                del data[position : position + len(value)]
            elif kind == 1:
                data[position:position] = value
            elif kind == 2:
                del data[position:]
            else:
                data[position : position + len(value)] = value
        return bytes(data)

    return changes.map(apply)


def held(act) -> None:
    """Do it, within the CPU time and the memory that a small file deserves."""
    begun_s = time.process_time()
    tracemalloc.start()
    try:
        act()
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < MEMORY_BYTES, f"{peak} bytes"
    assert time.process_time() - begun_s < SECONDS


# TIFFs


def own_tiff() -> bytes:
    pixels = np.arange(64 * 48, dtype=np.uint16).reshape(48, 64)
    return b"".join(tiff_parts([pixels], {"sensor": "SU00"}))


def foreign_tiff(**options) -> bytes:
    buffer = BytesIO()
    pixels = np.arange(64 * 48, dtype=np.uint16).reshape(48, 64)
    tifffile.imwrite(buffer, pixels, **options)
    return buffer.getvalue()


def try_tiff(path: Path) -> None:
    try:
        assert read_tiff(path).dtype == np.uint16
    except RasterError as error:
        assert str(error)
    read_description(path)


HEAD = 4096
"""Of our TIFF: everything before its pixels."""
TIFFS = st.one_of(
    mutated(own_tiff()[:HEAD]).map(lambda head: head + own_tiff()[HEAD:]),
    mutated(own_tiff()[:400]).map(lambda head: head.ljust(HEAD, b"\0") + own_tiff()[HEAD:]),
    mutated(foreign_tiff(compression="zlib", predictor=True)),
    mutated(foreign_tiff(bigtiff=True)),
    mutated(foreign_tiff(tile=(16, 16), compression="zlib")),
)


@given(data=TIFFS)
@QUIET
def test_a_mutated_tiff_is_read_or_refused_in_bounds(tmp_path, data):
    path = tmp_path / "SU00.tif"
    path.write_bytes(data)
    held(lambda: try_tiff(path))


def test_a_tiff_that_unpacks_to_more_than_its_size_is_refused(tmp_path):
    """A few hundred kB that would unpack to 300 MB in the place of one small strip."""
    seed = foreign_tiff(compression="zlib", rowsperstrip=48)
    with tifffile.TiffFile(BytesIO(seed)) as tiff:
        page = tiff.pages[0]
        places = [page.tags[code].valueoffset for code in (273, 279)]
    squeezer = zlib.compressobj(9)
    bomb = b"".join(squeezer.compress(bytes(1_000_000)) for _ in range(300)) + squeezer.flush()
    data = bytearray(seed)
    for place, value in zip(places, (len(seed), len(bomb)), strict=True):
        data[place : place + 4] = struct.pack("<I", value)
    path = tmp_path / "SU00.tif"
    path.write_bytes(bytes(data) + bomb)

    def attempt():
        with pytest.raises(RasterError, match="unpacks to more than its pixels"):
            read_tiff(path)

    held(attempt)


@pytest.mark.parametrize("side", [40_000, 2**31])
def test_a_tiff_that_declares_more_pixels_than_it_holds_is_refused(tmp_path, side):
    data = bytearray(own_tiff())
    with tifffile.TiffFile(BytesIO(own_tiff())) as tiff:
        places = [tiff.pages[0].tags[code].valueoffset for code in (256, 257, 278)]
    for place in places:
        data[place : place + 4] = struct.pack("<I", side)
    path = tmp_path / "SU00.tif"
    path.write_bytes(data)

    def attempt():
        with pytest.raises(RasterError):
            read_tiff(path)

    held(attempt)


# Flight logs


def log_bytes(tmp_path: Path) -> bytes:
    log = FlightLog.create(tmp_path / "seed", boot_id="boot")
    for number in range(20):
        log.append("event/SU00", number, {"name": "opened", "number": number})
        log.append("raw/gnss", number, bytes(range(40)))
        if number % 5 == 0:
            log.sync()
    log.close()
    return log.path.read_bytes()


def chunked(compression: CompressionType) -> bytes:
    buffer = BytesIO()
    writer = Writer(buffer, compression=compression, chunk_size=1000)
    writer.start()
    channel = writer.register_channel("event/x", "json", 0)
    for number in range(50):
        writer.add_message(channel, number, b'{"name":"x"}' * 4, number, number)
    writer.finish()
    return buffer.getvalue()


def try_log(path: Path) -> None:
    reader = read(path)
    for message in reader:
        record_of(message)
    assert 0 <= reader.cut_nbytes <= path.stat().st_size


@given(data=st.data())
@QUIET
def test_a_mutated_log_is_read_as_far_as_it_goes(tmp_path, data):
    seeds = [
        *(chunked(c) for c in (CompressionType.LZ4, CompressionType.ZSTD, CompressionType.NONE)),
    ]
    if not (tmp_path / "seed").exists():
        (tmp_path / "bytes").write_bytes(log_bytes(tmp_path))
    seeds.append((tmp_path / "bytes").read_bytes())
    path = tmp_path / "hostile.mcap"
    path.write_bytes(data.draw(mutated(data.draw(st.sampled_from(seeds)))))
    held(lambda: try_log(path))


@pytest.mark.parametrize("compression", [CompressionType.LZ4, CompressionType.ZSTD])
def test_a_chunk_that_unpacks_to_more_than_it_declares_ends_the_log_there(tmp_path, compression):
    buffer = BytesIO()
    writer = Writer(buffer, compression=compression, chunk_size=400_000_000)
    writer.start()
    channel = writer.register_channel("raw/x", "", 0)
    writer.add_message(channel, 1, bytes(300_000_000), 1, 1)
    writer.finish()
    data = buffer.getvalue()
    path = tmp_path / "bomb.mcap"
    path.write_bytes(data)
    assert len(data) < 5_000_000
    reader = read(path)
    tracemalloc.start()
    assert list(reader) == [] and reader.cut_nbytes > 0
    assert tracemalloc.get_traced_memory()[1] < 2.5 * RECORD_MAX_NBYTES
    tracemalloc.stop()


# Missions and plans


@pytest.fixture
def mission(tmp_path):
    new = new_mission(tmp_path / "missions")
    fly(new, [1, 2])
    return new


@pytest.mark.parametrize(
    "place", ["L0/000001/SU00.tif", "L2", "export", "mission.db", "log/x.mcap"]
)
def test_a_mission_with_a_link_is_refused_and_nothing_is_followed(mission, tmp_path, place):
    secret = tmp_path / "secret"
    secret.write_text("of somebody else")
    path = mission.path / place
    if path.is_dir():
        path.rmdir()
    path.unlink(missing_ok=True)
    path.symlink_to(tmp_path if "." not in place else secret)
    with pytest.raises(MissionError, match=f"{place}: is a link"):
        Mission.open(mission.path)
    assert secret.read_text() == "of somebody else"


def test_a_pipe_or_a_socket_in_a_mission_blocks_no_reader(mission):
    pipe = mission.level0(2) / "SU01.tif"
    pipe.unlink()
    os.mkfifo(pipe)
    with pytest.raises(MissionError, match="is a link, a pipe or a device"):
        Mission.open(mission.path)
    pipe.unlink()
    before = Path.cwd()
    os.chdir(mission.path)  # the name of a socket may be 107 bytes
    try:
        with socket.socket(socket.AF_UNIX) as bound:
            bound.bind("s")
    finally:
        os.chdir(before)
    with pytest.raises(MissionError, match="is a link, a pipe or a device"):
        Mission.open(mission.path)


def test_an_index_with_an_endless_view_is_not_queried(mission):
    """A mission.db whose table of exposures is a program."""
    mission.catalog_path.unlink()
    connection = sqlite3.connect(mission.catalog_path)
    connection.execute(
        "CREATE VIEW exposures AS WITH RECURSIVE n(number) AS"
        " (SELECT 1 UNION ALL SELECT number + 1 FROM n) SELECT * FROM n"
    )
    connection.execute("PRAGMA user_version = 2")
    connection.commit()
    connection.close()
    for attempt in (Catalog.open, Catalog.read):
        with pytest.raises(CatalogError, match="views or triggers"):
            attempt(mission.catalog_path)
    assert any("views or triggers" in problem for problem in verify(mission).problems)
    report = recover(mission, complete_from_log)
    assert "built again" in report.done[0] and verify(mission).problems == ()


def test_a_plan_that_is_a_pipe_or_a_device_is_refused(tmp_path):
    pipe = tmp_path / "plan.kml"
    os.mkfifo(pipe)
    endless = tmp_path / "plan.geojson"
    endless.symlink_to("/dev/zero")
    for path in (pipe, endless, tmp_path):
        with pytest.raises(PlanError, match="is no file"):
            read_plan(path)
