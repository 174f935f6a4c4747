"""What disks state of themselves becomes a finding, a fault and a figure; nothing is guessed.

The outputs of smartctl below are composed from the field names of its JSON output (smartctl(8),
option `--json`) and from the NVMe specification's health log. They were not recorded from drives.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from daemon.mission.store import health
from daemon.mission.store.health import DiskHealth, HealthError, collect, health_of, physical_disks

pytestmark = pytest.mark.trust

NVME: dict[str, Any] = {
    "json_format_version": [1, 0],
    "smartctl": {"version": [7, 3], "exit_status": 0},
    "device": {"name": "/dev/nvme0", "type": "nvme", "protocol": "NVMe"},
    "model_name": "Composed NVMe 2TB",
    "serial_number": "N0001",
    "smart_status": {"passed": True, "nvme": {"value": 0}},
    "nvme_smart_health_information_log": {
        "critical_warning": 0,
        "temperature": 41,
        "available_spare": 100,
        "available_spare_threshold": 10,
        "percentage_used": 3,
        "media_errors": 0,
    },
    "temperature": {"current": 41},
}
ATA: dict[str, Any] = {
    "json_format_version": [1, 0],
    "device": {"name": "/dev/sda", "type": "sat", "protocol": "ATA"},
    "model_name": "Composed SATA 4TB",
    "serial_number": "S0001",
    "smart_status": {"passed": True},
    "ata_smart_attributes": {
        "table": [
            {"id": 5, "name": "Reallocated_Sector_Ct", "when_failed": "", "raw": {"value": 0}},
            {"id": 197, "name": "Current_Pending_Sector", "when_failed": "", "raw": {"value": 0}},
        ]
    },
    "temperature": {"current": 35},
}


def nvme(**log: object) -> dict[str, Any]:
    return NVME | {
        "nvme_smart_health_information_log": NVME["nvme_smart_health_information_log"] | log
    }


def ata(number: int, **attribute: object) -> dict[str, Any]:
    table = [
        one | (attribute if one["id"] == number else {})
        for one in ATA["ata_smart_attributes"]["table"]
    ]
    return ATA | {"ata_smart_attributes": {"table": table}}


def test_healthy_disks_state_temperature_and_wear_and_no_problem() -> None:
    assert health_of(NVME) == DiskHealth("Composed NVMe 2TB", "N0001", 41.0, 3.0)
    assert health_of(ATA) == DiskHealth("Composed SATA 4TB", "S0001", 35.0, None)
    assert health_of(ATA | {"endurance_used": {"current_percent": 12}}).wear_percent == 12.0


@pytest.mark.parametrize(
    ("smart_data", "expected"),
    [
        (NVME | {"smart_status": {"passed": False}}, "states that it fails"),
        (nvme(critical_warning=4), "critical warning 0x04"),
        (nvme(available_spare=9), "9 % of its spare blocks"),
        (nvme(percentage_used=90), "90 % of its endurance"),
        (nvme(media_errors=2), "2 times"),
        (NVME | {"temperature": {"current": 71}}, "71 degC"),
        (ata(197, raw={"value": 8}), "8 of its sectors cannot be read"),
        (ata(5, when_failed="now"), "spare sectors are used up"),
        ({"device": {}}, "states nothing of its health"),
        ({"error": "smartctl printed no JSON"}, "no JSON"),
    ],
)
def test_what_a_bad_disk_states_is_a_sentence(smart_data: dict[str, Any], expected: str) -> None:
    (problem,) = health_of(smart_data).problems
    assert expected in problem


def test_the_limits_themselves_are_healthy() -> None:
    assert not health_of(nvme(available_spare=10, percentage_used=89)).problems
    assert not health_of(NVME | {"temperature": {"current": 70}}).problems
    assert not health_of(ata(5, raw={"value": 3})).problems, "reallocated sectors are in use"


@pytest.mark.parametrize(
    "smart_data",
    [
        {}, {"smart_status": None}, {"temperature": 5, "smart_status": {"passed": "yes"}},
        {"nvme_smart_health_information_log": {"critical_warning": "x", "percentage_used": None}},
        {"ata_smart_attributes": {"table": [None, 5, {"id": 197, "raw": {"value": "many"}}]}},
    ],
)  # fmt: skip
def test_malformed_output_never_raises_and_yields_no_values(smart_data: dict[str, Any]) -> None:
    found = health_of(smart_data)
    assert found.temperature_c is None and found.wear_percent is None


def drives(**outputs: str) -> Any:
    def run(arguments: Sequence[str]) -> str:
        if "--scan" in arguments:
            return json.dumps({"devices": [{"name": f"/dev/{name}"} for name in outputs]})
        return outputs[Path(arguments[-1]).name]

    return run


def report_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, **outputs: str) -> Path:
    monkeypatch.setattr(health, "physical_disks", lambda _root: ["nvme0n1"])
    path = tmp_path / "disks.json"
    health.write_report(path, collect(drives(**outputs)))
    return path


def test_the_disk_under_a_folder_is_found_by_its_controller_and_no_other_speaks_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bad = json.dumps(ATA | {"smart_status": {"passed": False}})
    path = report_of(tmp_path, monkeypatch, nvme0=json.dumps(NVME), sda=bad, nvme01=bad)
    found = health.read_health(tmp_path, path)
    assert found is not None and found.serial == "N0001" and not found.problems


def test_a_disk_that_printed_nonsense_is_named_and_the_others_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = report_of(tmp_path, monkeypatch, nvme0="Segmentation fault", sda=json.dumps(ATA))
    found = health.read_health(tmp_path, path)
    assert found is not None and "no JSON" in found.problems[0]
    assert "sda" in json.loads(path.read_text())["disks"]


def test_an_old_report_a_damaged_one_and_one_of_a_failure_are_problems(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = report_of(tmp_path, monkeypatch, nvme0=json.dumps(NVME))
    content = json.loads(path.read_text())
    now_s = time.monotonic()
    for written_s, is_old in ((now_s - 590, False), (now_s - 610, True), (now_s + 60, True)):
        path.write_text(json.dumps(content | {"monotonic_s": written_s}))
        found = health.read_health(tmp_path, path)
        assert found is not None and bool(found.problems) == is_old
    path.write_text("{")
    found = health.read_health(tmp_path, path)
    assert found is not None and "cannot be read" in found.problems[0]
    health.write_report(path, health.failed_report(HealthError("smartctl is missing")))
    found = health.read_health(tmp_path, path)
    assert found is not None and "smartctl is missing" in found.problems[0]
    assert health.read_health(tmp_path, tmp_path / "none.json") is None


def test_a_missing_tool_is_one_sentence_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(HealthError, match="apt-get install smartmontools"):
        collect()


@pytest.mark.parametrize("printed", ["", "[]", '{"devices": 3}'])
def test_a_scan_that_lists_nothing_is_refused(printed: str) -> None:
    with pytest.raises(HealthError):
        collect(lambda _arguments: printed)


def test_partitions_and_volumes_lead_to_the_disks_below_them(tmp_path: Path) -> None:
    device = tmp_path.stat().st_dev
    blocks = tmp_path / "devices"
    for name in ("nvme0n1/nvme0n1p2", "sda", "dm-0/slaves"):
        (blocks / name).mkdir(parents=True)
    (blocks / "nvme0n1/nvme0n1p2/partition").write_text("2")
    (blocks / "dm-0/slaves/nvme0n1p2").symlink_to(blocks / "nvme0n1/nvme0n1p2")
    (blocks / "dm-0/slaves/sda").symlink_to(blocks / "sda")
    numbers = tmp_path / "numbers"
    numbers.mkdir()
    (numbers / f"{os.major(device)}:{os.minor(device)}").symlink_to(blocks / "dm-0")
    assert physical_disks(tmp_path / "not" / "there", numbers) == ["nvme0n1", "sda"]
    assert physical_disks(tmp_path, tmp_path / "nothing") == []
