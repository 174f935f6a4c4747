"""Stored and sealed: what is on disk afterwards, how it got there, and what is refused."""

from __future__ import annotations

import hashlib
import json
import os
import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daemon.mission.canonical_json import RecordError
from daemon.mission.catalog.catalog import Catalog
from daemon.mission.exposure import Exposure
from daemon.mission.store import durable
from daemon.mission.store.level0 import read_description
from daemon.mission.store.store import Level0Writer, StoreError, load_level0, verify
from tests.daemon.small_camera import (
    HEIGHT_PX,
    SENSORS,
    WIDTH_PX,
    capture_of,
    final_record,
    fly,
    new_mission,
    pixels_of,
    small_rig,
    store_one,
)


@pytest.fixture
def mission(tmp_path):
    return new_mission(tmp_path)


@pytest.fixture
def writer(mission):
    writer = Level0Writer(mission)
    yield writer
    writer.close()


def test_a_stored_exposure_reads_back_pixel_by_pixel(mission, writer):
    stored = store_one(writer, 5)
    frames, exposure = load_level0(mission.level0(5), small_rig())
    for sensor, pixels in pixels_of(5).items():
        assert np.array_equal(frames[sensor], pixels)
    assert exposure.frames == stored.frames
    assert exposure.mark_source == "none"
    for frame in stored.frames:
        data = (mission.level0(5) / frame.file).read_bytes()
        assert frame.sha256 == hashlib.sha256(data).hexdigest()


def test_the_tags_hold_what_the_head_knew_and_no_gps_time(mission, writer):
    store_one(writer, 5)
    description = read_description(mission.level0(5) / "SU01.tif")
    assert description["exposure"] == 5
    assert description["device_ns"] == "5000000000000000005"
    assert description["settings"] == {"gain_db": 0.0, "tdi_shifts": 12}
    assert not any("gps" in key for key in description)


def test_the_record_is_written_once_and_quotes_the_one_before(mission, writer):
    hashes = [writer.seal(final_record(store_one(writer, number))) for number in (1, 2, 3)]
    quoted = [
        json.loads((mission.level0(n) / "exposure.json").read_bytes())["previous_sha256"]
        for n in (1, 2, 3)
    ]
    assert quoted == [mission.genesis_sha256(), *hashes[:2]]
    again = replace(final_record(capture_of(3)), frames=load_level0_frames(mission, 3))
    assert writer.seal(again) == hashes[2]
    with pytest.raises(StoreError, match="sealed already, with other content"):
        writer.seal(replace(again, flags=1))


def load_level0_frames(mission, number):
    return load_level0(mission.level0(number), small_rig())[1].frames


def test_level0_is_immutable(mission, writer):
    store_one(writer, 1)
    with pytest.raises(StoreError, match="stored already"):
        store_one(writer, 1)
    assert oct((mission.level0(1) / "SU00.tif").stat().st_mode & 0o777) == "0o444"


def test_a_record_of_other_frames_than_were_stored_is_refused(writer):
    stored = store_one(writer, 1)
    record = final_record(stored)
    with pytest.raises(StoreError, match="other frames"):
        writer.seal(replace(record, frames=record.frames[:2]))
    with pytest.raises(StoreError, match="never stored"):
        writer.seal(replace(record, number=2))
    with pytest.raises(StoreError, match="the record sealed last is"):
        writer.seal(replace(record, previous_sha256="0" * 64))


def test_a_lost_exposure_has_a_record_and_no_frames(mission, writer):
    lost = replace(
        Exposure(number=2), state="lost", missing=tuple((s, "no frame came") for s in SENSORS)
    )
    writer.seal(lost)
    frames, exposure = load_level0(mission.level0(2), small_rig())
    assert frames == {} and exposure.state == "lost"
    assert verify(mission).problems == ()


def test_frames_and_pixels_that_do_not_fit_are_refused_before_anything_is_written(mission, writer):
    capture = capture_of(1)
    narrow = {**pixels_of(1), "SU00": np.zeros((HEIGHT_PX, WIDTH_PX - 1), np.uint16)}
    for pixels in (pixels_of(1, SENSORS[:2]), narrow):
        with pytest.raises(StoreError):
            writer.write(capture, pixels)
    assert list(mission.level0_root.iterdir()) == []


def test_every_byte_and_name_is_synced_in_order_before_stored_is_reported(
    mission, writer, monkeypatch
):
    """The order is: files, folder, rename, parent, commit.

    docs/reference/results/durability.md states why.
    """
    trace = []
    real = {"fsync": os.fsync, "rename": Path.rename, "add": Catalog.add_stored}

    def fsync(descriptor):
        trace.append(("fsync", Path(f"/proc/self/fd/{descriptor}").readlink()))
        real["fsync"](descriptor)

    def rename(path, target):
        trace.append(("rename", path, target))
        return real["rename"](path, target)

    def add_stored(catalog, capture):
        trace.append(("commit", capture.number))
        real["add"](catalog, capture)

    monkeypatch.setattr(durable.os, "fsync", fsync)
    monkeypatch.setattr(Path, "rename", rename)
    monkeypatch.setattr(Catalog, "add_stored", add_stored)
    writer.write(capture_of(9), pixels_of(9))
    part, final = mission.level0_root / "000009.part", mission.level0(9)
    files = [("fsync", part / f"{sensor}.tif") for sensor in SENSORS]
    assert sorted(trace[:3]) == files
    assert trace[3:] == [
        ("fsync", part / "capture.json"),
        ("fsync", part),
        ("rename", part, final),
        ("fsync", mission.level0_root),
        ("commit", 9),
    ]
    trace.clear()
    writer.seal(final_record(load_level0_capture(final)))
    temporary = trace[0][1]
    assert temporary.parent == final and temporary.suffix == durable.PART_SUFFIX
    assert trace == [
        ("fsync", temporary),
        ("rename", temporary, final / "exposure.json"),
        ("fsync", final),
    ]


def load_level0_capture(folder):
    from daemon.mission.store.level0_folder import read_capture

    return read_capture(folder)


def test_a_new_ancestor_is_synced_into_its_parent(tmp_path, monkeypatch):
    synced = []
    monkeypatch.setattr(durable, "sync_directory", synced.append)
    durable.make_directories(tmp_path / "a" / "b" / "c")
    assert synced == [tmp_path, tmp_path / "a", tmp_path / "a" / "b"]


@pytest.mark.parametrize("refused", range(1, 12))
def test_a_full_disk_at_any_step_leaves_the_exposure_complete_or_absent(
    mission, writer, monkeypatch, refused
):
    writer.seal(final_record(store_one(writer, 1)))
    calls = 0
    is_full = True

    def counting(real):
        def call(*arguments):
            nonlocal calls
            calls += 1
            if is_full and calls == refused:
                raise OSError(28, "No space left on device")
            return real(*arguments)

        return call

    monkeypatch.setattr(durable.os, "writev", counting(os.writev))
    monkeypatch.setattr(durable.os, "fsync", counting(os.fsync))
    failed = False
    try:
        store_one(writer, 2)
    except OSError as error:
        failed = True
        assert error.errno == 28
    is_full = False
    assert failed == (refused <= 10)
    left = {entry.name for entry in mission.level0_root.iterdir()}
    assert left in ({"000001"}, {"000001", "000002"})
    if not failed:
        assert left == {"000001", "000002"}
    if "000002" not in left:
        writer.seal(final_record(store_one(writer, 2)))
        assert verify(mission).problems == ()


def test_a_kernel_refusal_within_a_frame_is_reported_and_cleared(tmp_path):
    """A real limit of the kernel (RLIMIT_FSIZE), so that a write ends short."""
    mission = new_mission(tmp_path)
    program = f"""
import resource, sys
from pathlib import Path
sys.path.insert(0, {str(Path.cwd())!r})
from tests.daemon.small_camera import store_one
from daemon.mission.layout import Mission
from daemon.mission.store.store import Level0Writer
writer = Level0Writer(Mission.open(Path({str(mission.path)!r})))
store_one(writer, 1)
resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))
try:
    store_one(writer, 2)
except OSError as error:
    print(error.errno)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.split() == ["27"]  # EFBIG
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[0] == resource.RLIM_INFINITY
    assert [entry.name for entry in mission.level0_root.iterdir()] == ["000001"]


def test_pixels_are_read_where_they_lie(writer):
    """Level-0 of frames in a memory map: what is stored is what the map holds."""
    with os.fdopen(os.memfd_create("frames"), "r+b") as file:
        nbytes = WIDTH_PX * HEIGHT_PX * 2
        file.truncate(len(SENSORS) * nbytes)
        shape = (len(SENSORS), HEIGHT_PX, WIDTH_PX)
        mapped = np.memmap(file, np.uint16, "r+", shape=shape)
        mapped[:] = np.stack(list(pixels_of(3).values()))
        pixels = {sensor: mapped[i] for i, sensor in enumerate(SENSORS)}
        frames = writer.write(capture_of(3), pixels)
        assert all(len(frame.sha256) == 64 for frame in frames)


def test_verification_finds_an_altered_bit_a_missing_frame_and_an_extra_file(mission):
    fly(mission, [1, 2, 3])
    assert verify(mission).problems == ()
    path = mission.level0(2) / "SU01.tif"
    path.chmod(0o644)
    data = bytearray(path.read_bytes())
    data[5000] ^= 1
    path.write_bytes(data)
    (mission.level0(1) / "SU00.tif").unlink()
    (mission.level0(3) / "note.txt").write_text("hello")
    report = verify(mission)
    assert (report.exposures, report.frames) == (3, 9)
    assert report.problems == (
        "exposure 000001, SU00.tif: is missing; according to its record it was stored",
        "exposure 000002, SU01.tif: was altered; its hash differs from the record's",
        "exposure 000003, note.txt: is not in the record; Level-0 is immutable",
    )


def test_verification_finds_an_altered_record_even_when_it_is_the_last(mission):
    fly(mission, [1, 2, 3])
    for number, expected in (
        (2, "chain is broken before exposure 3"),
        (3, "exposure 3: its record"),
    ):
        path = mission.level0(number) / "exposure.json"
        intact = path.read_bytes()
        path.chmod(0o644)
        path.write_bytes(intact.replace(b'"flags":0', b'"flags":1'))
        problems = verify(mission).problems
        assert any(expected in problem for problem in problems)
        path.write_bytes(intact)
    assert verify(mission).problems == ()


def test_verification_finds_a_removed_exposure(mission):
    fly(mission, [1, 2, 3])
    durable.remove_tree(mission.level0(2))
    problems = verify(mission).problems
    assert any("chain is broken before exposure 3" in problem for problem in problems)
    assert any(
        "exposure 2: is in chain.jsonl and the index but its folder is gone" in p for p in problems
    )


def test_progress_ends_at_its_total(mission):
    fly(mission, [1, 2])
    description = []
    report = verify(mission, lambda done, total: description.append((done, total)))
    assert description[-1] == (report.nbytes, report.nbytes)
    assert report.nbytes == 6 * (4096 + WIDTH_PX * HEIGHT_PX * 2)


def test_a_frame_that_changed_is_not_processed(mission):
    fly(mission, [1])
    path = mission.level0(1) / "SU00.tif"
    path.chmod(0o644)
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    with pytest.raises(RecordError, match=r"SU00\.tif: was altered after it was stored"):
        load_level0(mission.level0(1), small_rig())


def test_the_service_side_of_the_store_imports_no_heavy_library():
    program = (
        "import sys, daemon.mission.store.store, daemon.mission.verification.recovery\n"
        "import daemon.mission.log.flight_log, daemon.mission.catalog.catalog\n"
        "import daemon.onboard.flight.ledger, daemon.mission.store.level2\n"
        "print([m for m in ('gi', 'numba', 'cv2', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.strip() == "[]"
