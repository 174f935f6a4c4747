"""Files written past the page cache hold what was given, wherever it lies in memory."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from daemon.mission.store import direct_io


@pytest.mark.parametrize("offset", [0, 2, 64])
@pytest.mark.parametrize("pixels", [direct_io.DIRECT_MIN_BYTES // 2, 3_000_001])
def test_pixels_reach_the_file_wherever_they_lie(tmp_path: Path, offset: int, pixels: int) -> None:
    memory = np.random.default_rng(offset).integers(0, 256, 2 * pixels + 8192, np.uint8)
    first = -memory.ctypes.data % direct_io.BLOCK + offset
    samples = memory[first : first + 2 * pixels].view(np.uint16)
    header = b"head".ljust(direct_io.BLOCK, b"\0")
    written = direct_io.create_file(
        tmp_path / "pan.tif", [header, samples.data.cast("B"), b"", samples.data.cast("B"), b"end"]
    )
    expected = header + 2 * samples.tobytes() + b"end"
    assert written == len(expected)
    assert (tmp_path / "pan.tif").read_bytes() == expected


def test_a_disk_without_direct_io_still_gets_the_complete_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refusing(descriptor: int, parts: object) -> int:
        raise OSError(errno.EINVAL, "Invalid argument")

    monkeypatch.setattr(direct_io, "_write_all", refusing)
    content = os.urandom(direct_io.DIRECT_MIN_BYTES)
    assert direct_io.create_file(tmp_path / "pan.tif", [content]) == len(content)
    assert (tmp_path / "pan.tif").read_bytes() == content


def test_a_full_disk_is_reported_without_a_retry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int, parts: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(direct_io, "_write_all", full)
    with pytest.raises(OSError, match="No space left"):
        direct_io.create_file(tmp_path / "pan.tif", [bytes(direct_io.DIRECT_MIN_BYTES)])


@pytest.mark.parametrize("leaves_a_file", [False, True])
def test_a_disk_that_refuses_direct_io_still_gets_the_complete_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, leaves_a_file: bool
) -> None:
    plain_open = os.open

    def refusing(path: Path, flags: int, mode: int = 0o777) -> int:
        if flags & os.O_DIRECT:
            if leaves_a_file:
                Path(path).touch()
            raise OSError(errno.EINVAL, "Invalid argument")
        return plain_open(path, flags, mode)

    monkeypatch.setattr(os, "open", refusing)
    content = os.urandom(direct_io.DIRECT_MIN_BYTES)
    assert direct_io.create_file(tmp_path / "pan.tif", [content]) == len(content)
    assert (tmp_path / "pan.tif").read_bytes() == content


def test_a_disk_that_refuses_for_another_reason_is_reported_without_a_retry(tmp_path: Path) -> None:
    (tmp_path / "pan.tif").write_bytes(b"of another writer")
    with pytest.raises(FileExistsError):
        direct_io.create_file(tmp_path / "pan.tif", [bytes(direct_io.DIRECT_MIN_BYTES)])
    assert (tmp_path / "pan.tif").read_bytes() == b"of another writer"


def test_parts_of_any_size_are_counted_and_cut_to_their_length(tmp_path: Path) -> None:
    parts = [os.urandom(nbytes) for nbytes in (direct_io.BLOCK, 3, 2 * direct_io.BLOCK + 1, 5)]
    descriptor = os.open(tmp_path / "parts", os.O_WRONLY | os.O_CREAT)
    try:
        assert direct_io._write_all(descriptor, parts) == 3 * direct_io.BLOCK + 9
    finally:
        os.close(descriptor)
    assert (tmp_path / "parts").read_bytes() == b"".join(parts)
