"""Memory that a machine has for exposures: its own, and the limits of control groups."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from daemon.cli.batch_options import ExecutorOptions
from daemon.configuration.model import ConfigurationError
from daemon.postflight.batch import capacity
from daemon.postflight.batch.control_groups import group_free_nbytes
from processing.rig import find_rig

UNLIMITED_V1 = "9223372036854771712"


def group(folder: Path, limit: object, used: int, inactive: int = 0, *, version: int = 2) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    names = {
        1: ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
        2: ("memory.max", "memory.current", "inactive_file"),
    }[version]
    (folder / names[0]).write_text(f"{limit}\n")
    (folder / names[1]).write_text(f"{used}\n")
    (folder / "memory.stat").write_text(f"anon 5\n{names[2]} {inactive}\n")


def free(tmp_path: Path, membership: str) -> int | None:
    (tmp_path / "membership").write_text(membership)
    return group_free_nbytes(tmp_path / "membership", tmp_path / "cgroup")


def test_the_least_free_group_from_the_process_to_the_root_counts(tmp_path: Path) -> None:
    root = tmp_path / "cgroup"
    group(root / "user.slice/job.scope", "max", 500)
    group(root / "user.slice", 10_000, 4_000, 1_000)
    assert free(tmp_path, "0::/user.slice/job.scope\n") == 7_000
    group(root / "user.slice/job.scope", 6_000, 500)
    assert free(tmp_path, "0::/user.slice/job.scope\n") == 5_500
    (root / "user.slice/job.scope/memory.high").write_text("3000\n")
    assert free(tmp_path, "0::/user.slice/job.scope\n") == 2_500
    group(root, 1_000, 2_000)
    assert free(tmp_path, "0::/user.slice/job.scope\n") == 0
    assert free(tmp_path, "0::/\n") == 0


def test_groups_of_another_process_do_not_count(tmp_path: Path) -> None:
    group(tmp_path / "cgroup/other", 1_000, 900)
    assert free(tmp_path, "0::/own\n") is None


def test_groups_of_version_1_are_read_where_memory_is_theirs(tmp_path: Path) -> None:
    root = tmp_path / "cgroup/memory"
    group(root, UNLIMITED_V1, 10, version=1)
    group(root / "slurm/job_1", 9_000, 1_000, 500, version=1)
    group(root / "slurm/job_1/step_0", UNLIMITED_V1, 700, version=1)
    lines = "5:cpu:/elsewhere\n4:memory:/slurm/job_1/step_0\n0::/\n"
    assert free(tmp_path, lines) == 8_500
    assert free(tmp_path, "4:cpuset,memory:/slurm/job_1\n") == 8_500
    assert free(tmp_path, "5:cpu:/slurm/job_1\n") is None


@pytest.mark.parametrize("path", ["/docker/0123", "/../../docker/0123"])
def test_a_path_of_the_host_falls_back_to_the_root_that_is_mounted(
    tmp_path: Path, path: str
) -> None:
    group(tmp_path / "cgroup", 5_000, 1_000)
    assert free(tmp_path, f"0::{path}\n") == 4_000


def test_what_cannot_be_read_is_no_limit(tmp_path: Path) -> None:
    assert group_free_nbytes(tmp_path / "nothing", tmp_path / "cgroup") is None
    assert free(tmp_path, "nonsense\n") is None
    group(tmp_path / "cgroup", "many", 1_000)
    assert free(tmp_path, "0::/\n") is None


def test_a_group_limits_the_memory_of_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(capacity, "group_free_nbytes", lambda: 1_000)
    assert capacity.available_memory_nbytes() == 1_000
    monkeypatch.setattr(capacity, "group_free_nbytes", lambda: None)
    assert capacity.available_memory_nbytes() > 10_000_000


@pytest.mark.parametrize(
    ("name", "measured_mib"),
    [
        # Of one exposure without its frames (bench-shared-cells.json).
        ("ultracam-x", 2_416),
        # Of two exposures (memory.json): one occupies less.
        ("ultracam-x-mini", 451.3 / 2),
    ],
)
def test_the_estimate_of_an_exposure_is_not_below_what_was_measured(
    name: str, measured_mib: float
) -> None:
    rig = find_rig(name)
    frames_nbytes = sum(2 * sensor.width_px * sensor.height_px for sensor in rig.sensors)
    measured_nbytes = measured_mib * 2**20 + frames_nbytes
    assert measured_nbytes <= capacity.exposure_nbytes(rig)
    if name == "ultracam-x":
        assert capacity.exposure_nbytes(rig) <= 1.05 * measured_nbytes


@pytest.mark.parametrize(("available_gb", "count"), [(4.05, 1), (4.3, 2), (6.1, 2)])
def test_two_exposures_in_one_process_need_what_was_measured(
    monkeypatch: pytest.MonkeyPatch, available_gb: float, count: int
) -> None:
    """`ultracam-x`: 4.1 GB measured for two in work, not twice the 3.0 GB of one."""
    rig = find_rig("ultracam-x")
    monkeypatch.setattr(capacity, "available_memory_nbytes", lambda: int(available_gb * 1e9))
    placed = ExecutorOptions(processes=0).place(
        capacity.exposure_nbytes(rig), 20, further_nbytes=capacity.further_exposure_nbytes(rig)
    )
    assert placed.executor.capacity == count


def test_maps_that_processes_share_are_planned_once(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = find_rig("ultracam-x")
    task, shared = capacity.exposure_nbytes(rig), capacity.shared_maps_nbytes(rig)
    assert shared == pytest.approx(824 * 2**20, rel=0.01)  # shared-maps.json
    for available_gb in (2, 4, 8, 16, 64, 128):
        planned = [
            capacity.plan_processes(
                task, 1000, cores=64, available_nbytes=available_gb * 10**9, shared_nbytes=nbytes
            ).processes
            for nbytes in (0, shared)
        ]
        needed = shared + planned[1] * (task - shared)
        limit = available_gb * 1e9 * capacity.MEMORY_SHARE
        assert planned[1] == 1 or needed <= limit < needed + task - shared
        assert planned[1] >= planned[0]
    assert planned == [34, 48]
    monkeypatch.setattr(capacity, "available_memory_nbytes", lambda: 10**10)
    monkeypatch.setattr(capacity, "usable_cores", lambda: 64)
    placed = ExecutorOptions(processes=4).place(task, 20, shared_nbytes=shared)
    assert placed.allocation.processes == 4  # 9.3 GB
    with pytest.raises(ConfigurationError, match=r"--processes 5 needs 11\.4 GB"):
        ExecutorOptions(processes=5).place(task, 20, shared_nbytes=shared)
    with pytest.raises(ConfigurationError, match=r"--processes 4 needs 11\.9 GB"):
        ExecutorOptions(processes=4).place(task, 20)


def test_without_room_for_their_file_each_process_has_maps_of_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = find_rig("ultracam-x")
    maps_nbytes = capacity.shared_maps_nbytes(rig)
    for blocks, expected in ((2 * maps_nbytes, maps_nbytes), (2 * maps_nbytes - 1, 0), (0, 0)):
        disk = SimpleNamespace(f_bavail=blocks, f_frsize=1)
        monkeypatch.setattr("daemon.products.shared_maps.os.statvfs", lambda _path, d=disk: d)
        assert capacity.shared_maps_nbytes(rig) == expected
