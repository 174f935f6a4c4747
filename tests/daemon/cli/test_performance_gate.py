"""The gate of `make bench`: slower than the record by more than a tenth fails."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import gate
from benchmarks.records import read_record

PROCESSOR = "Some Processor"


@pytest.fixture
def record(tmp_path: Path) -> Path:
    path = tmp_path / "performance-gate.json"
    gate.accept({"copy": 10.0, "remap": 2.0}, PROCESSOR, 2, path)
    return path


def test_a_tenth_more_passes_and_more_than_that_fails_with_its_cure(record: Path) -> None:
    passed = gate.compared({"copy": 10.9, "remap": 2.19}, PROCESSOR, record)
    assert passed["slower"] == []
    failed = gate.compared({"copy": 10.9, "remap": 2.21}, PROCESSOR, record)
    assert failed["slower"] == ["remap"]
    assert "record 2.00 (+10%)" in failed["sentences"][1]
    assert "--accept" in failed["sentences"][1] and "--accept" not in failed["sentences"][0]


def test_a_faster_pipeline_passes(record: Path) -> None:
    assert gate.compared({"copy": 5.0, "remap": 1.0}, PROCESSOR, record)["slower"] == []


def test_a_processor_without_a_record_is_reported_as_not_compared(record: Path) -> None:
    found = gate.compared({"copy": 99.0}, "Another Processor", record)
    assert found["slower"] == []
    assert "nothing was compared" in found["sentences"][0]


def test_accepted_ratios_replace_those_of_their_own_processor_only(record: Path) -> None:
    gate.accept({"copy": 7.0}, "Another Processor", 4, record)
    gate.accept({"copy": 8.0, "remap": 1.5}, PROCESSOR, 2, record)
    table = read_record(record).figures[0].table
    assert table is not None
    assert table.rows == (
        ("Another Processor", "copy", "7.00"),
        (PROCESSOR, "copy", "8.00"),
        (PROCESSOR, "remap", "1.50"),
    )
