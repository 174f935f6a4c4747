"""Commands that walk a mission: one exposure that fails takes nothing from the others."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from daemon.mission.layout import Mission
from tests.daemon.diverging_camera import GPS_NS, ROOT, copied, flown_mission, syntopic

pytestmark = pytest.mark.trust
L2_FILES = {
    "LEFT.tif", "RIGHT.tif", "histogram.json", "orientation.json", "quality.json",
    "quicklook.jpg", "thumbnail.jpg",
}  # fmt: skip


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    return flown_mission(tmp_path_factory.mktemp("flown"))


@pytest.fixture(scope="module")
def processed(flown, tmp_path_factory):
    mission = copied(flown, tmp_path_factory.mktemp("processed"))
    done = syntopic("process", str(mission.path), "--json")
    assert done.returncode == 0, done.stderr
    output = json.loads(done.stdout)
    assert [e["exposure"] for e in output["exposures"]] == [1, 2, 3, 4] and output["failures"] == []
    return mission


def truncate(path: Path) -> None:
    cut = path.read_bytes()[:5000]
    path.unlink()
    path.write_bytes(cut)


def empty(path: Path) -> None:
    path.unlink()
    path.write_bytes(b"")


def forbid(path: Path) -> None:
    path.chmod(0)


def as_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def text(content: str) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        path.unlink()
        path.write_text(content)

    return write


def frame(pixel_type: str, shape: tuple[int, int]) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        import numpy as np
        import tifffile

        path.unlink()
        tifffile.imwrite(path, np.zeros(shape, pixel_type))

    return write


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.unlink()
    path.write_bytes(data)


def tdi_as_text(path: Path) -> None:
    text(path.read_text().replace('"TdiShifts":0', '"TdiShifts":"many"'))(path)


def text_with(key: str, value: str) -> Callable[[Path], None]:
    """The record with another value of the same length behind a key."""

    def write(path: Path) -> None:
        before, _, behind = path.read_text().partition(key)
        text(f"{before}{key}{value}{behind[len(value) :]}")(path)

    return write


DAMAGES = {
    "truncated TIFF": ("L0/{}/LEFT.tif", truncate, "LEFT.tif"),
    "empty TIFF": ("L0/{}/LEFT.tif", empty, "LEFT.tif: not a usable TIFF"),
    "no permission": ("L0/{}/LEFT.tif", forbid, "Permission denied"),
    "folder instead of a frame": ("L0/{}/LEFT.tif", as_folder, "LEFT.tif"),
    "wrong word": ("L0/{}/LEFT.tif", frame("uint8", (64, 96)), "holds uint8"),
    "wrong shape": ("L0/{}/LEFT.tif", frame("uint16", (64, 95)), "95 x 64 px"),
    "record is not JSON": ("L0/{}/exposure.json", text("{"), "not a JSON record"),
    "record of wrong types": (
        "L0/{}/exposure.json",
        text('{"number": "2", "frames": 3}'),
        "a whole number is needed",
    ),
    "record without permission": ("L0/{}/exposure.json", forbid, "Permission denied"),
    "folder instead of a record": ("L0/{}/exposure.json", as_folder, "Is a directory"),
    "exposure without permission": ("L0/{}", forbid, "Permission denied"),
    "frame altered in one bit": ("L0/{}/LEFT.tif", flip, "LEFT.tif: was altered after it was"),
    "TDI count is a text": ("L0/{}/exposure.json", tdi_as_text, "TdiShifts is 'many'"),
    "record of another calibration": (
        "L0/{}/exposure.json",
        text_with('"calibration_sha256":"', "0" * 64),
        "was flown with calibration diverging-1",
    ),
}


@pytest.fixture
def damaged(flown, tmp_path):
    """All damages at once, each to an exposure of its own, between healthy ones."""
    mission = flown_mission(tmp_path, range(1, 2 * len(DAMAGES) + 2))
    for index, (path, damage, _) in enumerate(DAMAGES.values()):
        damage(mission.path / path.format(f"{2 * index + 2:06d}"))
    yield mission
    for path in mission.path.rglob("*"):
        if not path.is_symlink() and path.stat().st_mode & 0o777 == 0:
            path.chmod(0o755)


def test_process_lists_damaged_exposures_and_processes_all_others(damaged: Mission) -> None:
    done = syntopic("process", str(damaged.path), "--json")
    assert done.returncode == 1, done.stderr
    output = json.loads(done.stdout)
    count = 2 * len(DAMAGES) + 1
    assert [e["exposure"] for e in output["exposures"]] == list(range(1, count + 1, 2))
    assert [f["exposure"] for f in output["failures"]] == list(range(2, count, 2))
    for failure, (what, (_, _, cause)) in zip(output["failures"], DAMAGES.items(), strict=True):
        assert cause in failure["cause"], what
    assert sorted(p.name for p in damaged.level2_root.iterdir()) == [
        f"{n:06d}" for n in range(1, count + 1, 2)
    ]
    listed = " ".join(done.stderr.split())
    assert f"{len(DAMAGES)} exposures failed" in listed and "Traceback" not in done.stderr


PRODUCT_DAMAGES = {
    "truncated image": ("L2/{}/LEFT.tif", truncate, "cannot be read"),
    "folder instead of an image": ("L2/{}/LEFT.tif", as_folder, "Is a directory"),
    "report is not JSON": ("L2/{}/quality.json", text("{"), "not a JSON record"),
    "report of wrong types": (
        "L2/{}/quality.json",
        text('{"verdict": "good", "figures": {"dc_k": [1]}, "findings": [3]}'),
        "a table is needed",
    ),
    "folder instead of a report": ("L2/{}/quality.json", as_folder, "Is a directory"),
    "record is not JSON": ("L0/{}/exposure.json", text("{"), "not a JSON record"),
    "record of another exposure": ("L0/{}/exposure.json", text('{"number": 1}'), "number is 1"),
    "record without permission": ("L0/{}/exposure.json", forbid, "Permission denied"),
}
RECORDS = {what for what in PRODUCT_DAMAGES if what.startswith("record")}
REPORTS = {what for what in PRODUCT_DAMAGES if "report" in what}
IMAGES = {what for what in PRODUCT_DAMAGES if "image" in what}


@pytest.fixture(scope="module")
def many_processed(processed: Mission, tmp_path_factory: pytest.TempPathFactory) -> Mission:
    """As many exposures as there are damages, each between two healthy ones."""
    mission = flown_mission(tmp_path_factory.mktemp("many"), range(1, 2 * len(PRODUCT_DAMAGES) + 2))
    for number in mission.numbers():
        shutil.copytree(processed.level2(1), mission.level2(number))
    return mission


@pytest.mark.parametrize(
    ("command", "fails"),
    [
        (["orient", "--trajectory", "TRAJECTORY"], RECORDS),
        (["export", "raw"], RECORDS),
        (["export", "certificate"], RECORDS),
        (["export", "foxglove"], RECORDS | REPORTS),
        (["export", "pictures", "--as", "jpeg", "--trajectory", "TRAJECTORY"], RECORDS | IMAGES),
        (["report"], RECORDS | REPORTS),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_other_commands_go_on_too(
    many_processed: Mission, tmp_path: Path, command: list[str], fails: set[str]
) -> None:
    mission = copied(many_processed, tmp_path)
    trajectory = tmp_path / "trajectory.csv"
    trajectory.write_text(trajectory_csv(mission.numbers()))
    for index, (path, damage, _) in enumerate(PRODUCT_DAMAGES.values()):
        damage(mission.path / path.format(f"{2 * index + 2:06d}"))
    name, *options = [str(trajectory) if word == "TRAJECTORY" else word for word in command]
    where = [options.pop(0)] if name == "export" else []
    done = syntopic(name, *where, str(mission.path), *options)
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    listed = done.stderr.splitlines()
    expected = {
        2 * index + 2: cause
        for index, (what, (_, _, cause)) in enumerate(PRODUCT_DAMAGES.items())
        if what in fails
    }
    assert f"{len(expected)} exposures failed" in done.stderr
    named = {int(line.split()[0]) for line in listed if re.match(r" ?\d+ ", line)}
    assert named >= set(expected), done.stderr
    for number in mission.numbers():
        if number not in expected and name == "export" and where == ["pictures"]:
            assert (mission.export_dir / f"jpeg/{number:06d}_RIGHT.jpg").is_file()
    if name == "orient":
        (orientation,) = mission.export_dir.glob("orientation/*/orientation.csv")
        rows = orientation.read_text()
        for number in mission.numbers():
            assert (f"{number:06d}" in rows) == (number not in expected)


def trajectory_csv(numbers: list[int]) -> str:
    """A trajectory file through all exposures."""
    rows = ["gps_ns,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg"]
    for number in range(0, len(numbers) + 2):
        gps_ns = GPS_NS + number * 1_000_000_000
        rows.append(f"{gps_ns},48.0,{11.0 + number * 0.0007:.7f},1000.0,0.0,0.0,90.0")
    return "\n".join(rows) + "\n"


def test_a_missing_frame_is_no_failure(flown: Mission, tmp_path: Path) -> None:
    mission = copied(flown, tmp_path)
    (mission.level0(2) / "LEFT.tif").unlink()
    done = syntopic("process", str(mission.path), "--json")
    assert done.returncode == 0, done.stderr
    second = json.loads(done.stdout)["exposures"][1]
    assert "FRAME_MISSING" in second["flags"] and list(second["heads"]) == ["RIGHT"]


def test_two_process_commands_at_once_leave_every_product_set_complete(
    flown: Mission, tmp_path: Path
) -> None:
    mission = copied(flown, tmp_path)
    command = [sys.executable, "-m", "daemon", "process", str(mission.path), "--json"]
    both = [
        subprocess.Popen(command, cwd=ROOT, text=True, stdout=subprocess.PIPE,
                         stderr=subprocess.PIPE)
        for _ in range(2)
    ]  # fmt: skip
    outputs = [one.communicate(timeout=300) for one in both]
    codes = [one.returncode for one in both]
    assert 0 in codes
    for code, (_, stderr), other in zip(codes, outputs, reversed(both), strict=True):
        if code:  # else one had ended before the other asked for the lock
            assert code == 1
            assert "is held by another process" in stderr and f"process {other.pid} " in stderr
            assert f"process {mission.path}" in stderr.replace("\n", "")
    for number in mission.numbers():
        assert {path.name for path in mission.level2(number).iterdir()} == L2_FILES
    assert len(list(mission.level2_root.iterdir())) == 4


@pytest.mark.parametrize(
    "command",
    [
        ["process"],
        ["repair"],
        ["orient"],
        ["report"],
        ["calibrate", "validity"],
        ["export", "raw"],
        ["export", "foxglove"],
        ["export", "pictures"],
        ["export", "certificate"],
    ],
    ids=" ".join,
)
def test_a_writing_command_is_refused_while_another_one_writes(
    processed: Mission, tmp_path: Path, command: list[str]
) -> None:
    from typer.testing import CliRunner

    from daemon.cli import app
    from daemon.mission.layout import MissionError

    mission = copied(processed, tmp_path)
    before = snapshot(mission)
    with mission.held(), pytest.raises(MissionError, match=r"held by another process: `.+`, proc"):
        CliRunner().invoke(app, [*command, str(mission.path)], catch_exceptions=False)
    assert snapshot(mission) == before


def test_reading_commands_work_while_another_one_writes(processed: Mission, tmp_path: Path) -> None:
    mission = copied(processed, tmp_path / "held")
    with mission.held():
        before = snapshot(mission)
        verified = syntopic("verify", str(mission.path))
        assert verified.returncode == 0, verified.stdout
        out = tmp_path / "elsewhere"
        reported = syntopic("report", str(mission.path), "--bundle", "--out", str(out))
        assert reported.returncode == 0, reported.stderr
        assert sorted(p.name for p in out.iterdir()) == ["report.html", "support.zip"]
        assert snapshot(mission) == before


def snapshot(mission: Mission) -> dict[str, int]:
    return {
        str(path.relative_to(mission.path)): path.stat().st_mtime_ns
        for path in mission.path.rglob("*")
        if path.name not in (".held", "mission.db-wal", "mission.db-shm")
    }


def test_a_killed_holder_holds_nothing(flown: Mission, tmp_path: Path) -> None:
    mission = copied(flown, tmp_path)
    program = (
        "import sys, time; from pathlib import Path; from daemon.mission.layout import Mission\n"
        "with Mission.open(Path(sys.argv[1])).held():\n"
        "    print('held', flush=True); time.sleep(600)\n"
    )
    holder = subprocess.Popen(
        [sys.executable, "-c", program, str(mission.path)], cwd=ROOT, stdout=subprocess.PIPE
    )
    assert holder.stdout is not None and holder.stdout.readline() == b"held\n"
    holder.kill()
    holder.wait()
    with mission.held():
        pass


def test_verify_names_every_damaged_exposure_and_goes_on(damaged: Mission) -> None:
    done = syntopic("verify", str(damaged.path), "--json")
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
    problems = json.loads(done.stdout)["problems"]
    for index, what in enumerate(DAMAGES):
        number = 2 * index + 2
        assert any(re.search(rf"\b0*{number}\b", problem) for problem in problems), what
    healthy = range(1, 2 * len(DAMAGES) + 2, 2)
    frames = {f"{number:06d}, LEFT.tif" for number in healthy}
    assert not [p for p in problems if any(frame in p for frame in frames)]
