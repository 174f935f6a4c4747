"""Processes of one machine have calibration maps once, and never other ones than their own."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from daemon.products import shared_maps
from daemon.products.shared_maps import share_maps
from processing.radiometry.calibration import RadiometricCalibration
from processing.radiometry.corrector import Corrector, corrector_for
from processing.rig import find_rig

MAPS = ("bias", "dark", "response")
PROCESS = """
import sys
from tests.daemon.products.test_shared_maps import calibrated
from daemon.products.shared_maps import share_maps
correctors = calibrated(int(sys.argv[1]))
print(share_maps(correctors), flush=True)
print(sum(int(c.response[::64].sum()) + int(c.bias[::64].sum()) + int(c.dark[::64].sum())
    for c in correctors.values()), flush=True)
sys.stdin.readline()
"""


def calibrated(seed: int = 1) -> dict[str, Corrector]:
    """Correctors of a small rig with maps of noise, 27 MB in all."""
    rig = find_rig("ultracam-x-mini")
    found = {}
    for sensor in rig.sensors[:6]:
        noise = np.random.default_rng(seed)
        shape = (sensor.height_px, sensor.width_px)
        found[sensor.name] = corrector_for(
            sensor,
            RadiometricCalibration(
                bias_dn=noise.uniform(60.0, 68.0, shape).astype(np.float32),
                dark_dn_per_s=noise.uniform(0.0, 90.0, shape).astype(np.float32),
                doubling_k=6.0,
                reference_c=20.0,
                gain=noise.uniform(0.9, 1.1, shape).astype(np.float32),
                defect=np.zeros(shape, np.uint8),
            ),
        )
    return found


def nbytes_of(correctors: dict[str, Corrector]) -> int:
    return sum(getattr(one, key).nbytes for one in correctors.values() for key in MAPS)


def is_same(one: dict[str, Corrector], other: dict[str, Corrector]) -> bool:
    return all(
        np.array_equal(getattr(one[name], key), getattr(other[name], key))
        and getattr(one[name], key).dtype == getattr(other[name], key).dtype
        and getattr(one[name], key).flags.writeable
        for name in one
        for key in MAPS
    )


@pytest.fixture
def disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of the maps, below a disk for temporary files of its own."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    held = list(shared_maps._held)
    yield tmp_path / f"syntopic-maps-{os.getuid()}"
    for descriptor in set(shared_maps._held) - set(held):
        os.close(descriptor)
        shared_maps._held.remove(descriptor)


def files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.maps"))


def mapped_kib(pid: int, field: str) -> int:
    """A figure of the mapped files of a process, KiB."""
    total, is_ours = 0, False
    for line in Path(f"/proc/{pid}/smaps").read_text().splitlines():
        if re.match(r"[0-9a-f]+-[0-9a-f]+ ", line):
            is_ours = line.endswith(".maps")
        elif is_ours and line.startswith(f"{field}:"):
            total += int(line.split()[1])
    return total


def started(stack: ExitStack, seed: int = 1) -> tuple[subprocess.Popen[str], str]:
    """A process with shared maps, and the sum of some of its words."""
    process = stack.enter_context(
        subprocess.Popen(
            [sys.executable, "-c", PROCESS, str(seed)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).parents[3],
        )
    )
    stack.callback(process.kill)
    assert process.stdout is not None
    assert process.stdout.readline() == "True\n"
    return process, process.stdout.readline()


def test_two_processes_have_the_maps_in_memory_once(disk: Path) -> None:
    size_kib = nbytes_of(calibrated()) / 1024
    with ExitStack() as stack:
        first, one = started(stack)
        second, two = started(stack)
        assert one == two
        assert len(files(disk)) == 1
        for process in (first, second):
            assert mapped_kib(process.pid, "Rss") == pytest.approx(size_kib, rel=0.01)
            assert mapped_kib(process.pid, "Pss") == pytest.approx(size_kib / 2, rel=0.01)
            assert mapped_kib(process.pid, "Private_Dirty") == 0


def test_a_killed_process_takes_nothing_from_the_others_and_leaves_nothing_for_long(
    disk: Path,
) -> None:
    with ExitStack() as stack:
        first, one = started(stack)
        second, _ = started(stack)
        first.kill()
        first.wait()
        third, three = started(stack)
        assert one == three and len(files(disk)) == 1
        for process in (second, third):
            process.kill()
            process.wait()
        assert len(files(disk)) == 1
        started(stack, seed=2)  # other calibrations: the file that no process holds is removed
        assert len(files(disk)) == 1
        _, four = started(stack)
        assert one == four and len(files(disk)) == 2


def test_maps_are_taken_from_the_file_and_equal_those_that_were_read(disk: Path) -> None:
    correctors = calibrated()
    assert share_maps(correctors)
    assert is_same(correctors, calibrated())
    assert all(not getattr(one, key).flags.owndata for one in correctors.values() for key in MAPS)


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[: len(data) // 2],  # half written
        lambda _data: b"",
        lambda data: data + b"x",
    ],
    ids=("half", "empty", "longer"),
)
def test_a_file_that_is_not_whole_is_written_again(disk: Path, damage) -> None:
    assert share_maps(calibrated())
    (path,) = files(disk)
    whole = path.read_bytes()
    os.close(shared_maps._held.pop())
    path.write_bytes(damage(whole))
    path.rename(disk / "kept")  # `share_maps` removes files that no process holds
    (disk / "kept").rename(path)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(shared_maps, "_remove_unused", lambda _folder: None)
        correctors = calibrated()
        assert share_maps(correctors)
    assert path.read_bytes() == whole and is_same(correctors, calibrated())


def test_an_exchanged_word_in_the_file_reaches_no_product(disk: Path) -> None:
    assert share_maps(calibrated())
    (path,) = files(disk)
    with path.open("r+b") as file:
        file.seek(1000)
        word = file.read(1)
        file.seek(1000)
        file.write(bytes([word[0] ^ 1]))
    correctors = calibrated()
    assert not share_maps(correctors)
    assert is_same(correctors, calibrated())


def test_without_room_each_process_has_its_own(disk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_maps, "FREE_FACTOR", 1e12)
    correctors = calibrated()
    assert not share_maps(correctors) and is_same(correctors, calibrated())


@pytest.mark.parametrize("kind", ["open", "link", "file"])
def test_a_folder_that_others_may_write_to_is_not_used(disk: Path, kind: str) -> None:
    if kind == "open":
        disk.mkdir()
        disk.chmod(0o777)
    elif kind == "link":
        (disk.parent / "elsewhere").mkdir(mode=0o700)
        disk.symlink_to("elsewhere")
    else:
        disk.write_bytes(b"")
    correctors = calibrated()
    assert not share_maps(correctors) and is_same(correctors, calibrated())


def test_neutral_and_small_calibrations_need_no_file(disk: Path) -> None:
    rig = find_rig("ultracam-x-mini")
    neutral = {sensor.name: corrector_for(sensor, None) for sensor in rig.sensors}
    assert not share_maps(neutral) and not share_maps({}) and not disk.exists()
