"""The gate of `make bench`: slower than the record by more than a tenth fails."""

from __future__ import annotations

import json
import re
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from benchmarks import gate, mini
from benchmarks.records import read_record
from daemon.cli.benchmark.measurement import interleaved

PROCESSOR = "Some Processor"


@pytest.fixture
def record(tmp_path: Path) -> Path:
    path = tmp_path / "performance-gate.json"
    gate.accept({"copy": 10.0, "remap": 2.0}, PROCESSOR, "landscape", 2, path)
    return path


def test_a_tenth_more_passes_and_more_than_that_fails_with_its_cure(record: Path) -> None:
    passed = gate.compared({"copy": 10.9, "remap": 2.19}, PROCESSOR, "landscape", record)
    assert passed["slower"] == []
    failed = gate.compared({"copy": 10.9, "remap": 2.21}, PROCESSOR, "landscape", record)
    assert failed["slower"] == ["remap"]
    assert "record 2.00 (+10%)" in failed["sentences"][1]
    assert "--accept" in failed["sentences"][1] and "--accept" not in failed["sentences"][0]


def test_a_faster_pipeline_passes_and_is_asked_to_be_recorded(record: Path) -> None:
    found = gate.compared({"copy": 9.1, "remap": 1.79}, PROCESSOR, "landscape", record)
    assert (found["slower"], found["faster"], found["status"]) == ([], ["remap"], 0)
    assert "faster by more than 10%" in found["sentences"][1]
    assert "--accept" in found["sentences"][1] and "--accept" not in found["sentences"][0]


@pytest.mark.parametrize(
    ("processor", "ground"), [("Another Processor", "landscape"), (PROCESSOR, "land")]
)
def test_a_processor_or_ground_without_a_record_does_not_pass(
    record: Path, processor: str, ground: str
) -> None:
    found = gate.compared({"copy": 99.0}, processor, ground, record)
    assert (found["slower"], found["unknown"], found["status"]) == ([], ["copy"], 3)
    assert "nothing was compared" in found["sentences"][0]


def test_the_exit_status_is_that_of_the_worst_ratio(record: Path) -> None:
    def status(**ratios: float) -> int:
        return int(gate.compared(ratios, PROCESSOR, "landscape", record)["status"])

    assert (status(copy=10.0), status(copy=20.0), status(other=1.0)) == (0, 1, 3)
    assert status(copy=20.0, other=1.0) == 1


def test_accepted_ratios_replace_those_of_their_own_processor_and_ground_only(
    record: Path,
) -> None:
    text = record.read_text(encoding="utf-8")
    record.write_text(re.sub(r"20\d\d-\d\d-\d\d", "2026-01-02", text), encoding="utf-8")
    gate.accept({"copy": 7.0}, "Another Processor", "landscape", 4, record)
    gate.accept({"copy": 6.0}, PROCESSOR, "land", 2, record)
    content = read_record(record)
    assert content.figures[0].table is not None
    rows = content.figures[0].table.rows
    assert [row[:5] for row in rows] == [
        ("Another Processor", "landscape", "copy", "7.00", "4"),
        (PROCESSOR, "land", "copy", "6.00", "2"),
        (PROCESSOR, "landscape", "copy", "10.00", "2"),
        (PROCESSOR, "landscape", "remap", "2.00", "2"),
    ]
    # Rows that stay keep the day they were measured on.
    assert [row[5] for row in rows[2:]] == ["2026-01-02"] * 2
    assert content.date[0] == "2026-01-02" < content.date[1]
    gate.accept({"copy": 8.0}, PROCESSOR, "landscape", 2, record)
    table = read_record(record).figures[0].table
    assert table is not None and len(table.rows) == 3


def test_generations_of_one_name_are_different_processors(tmp_path: Path) -> None:
    info = tmp_path / "cpuinfo"
    info.write_text("processor\t: 0\ncpu family\t: 26\nmodel\t\t: 2\nmodel name\t: AMD EPYC\n")
    assert gate.processor_name(info) == "AMD EPYC, family 26, model 2"
    info.write_text("processor\t: 0\nCPU part\t: 0xd0c\n\nprocessor\t: 1\nCPU part\t: 0xd0d\n")
    assert gate.processor_name(info) == "0xd0c"
    assert gate.processor_name()


def test_pipeline_copy_and_remap_run_in_turn_five_times() -> None:
    order: list[str] = []
    timed = interleaved(
        gate.RUNS,
        process=lambda: order.append("process"),
        copy=lambda: order.append("copy"),
        remap=lambda: order.append("remap"),
    )
    assert order == ["process", "copy", "remap"] * 5
    assert set(timed) == {"process", "copy", "remap"}


def test_ratios_are_of_medians(monkeypatch: pytest.MonkeyPatch) -> None:
    """One run that was disturbed changes nothing. Waiting counts in elapsed time alone."""
    spent = {"process": [9.0, 9.0, 900.0, 9.5, 8.0], "copy": [0.1, 0.1, 0.1, 5.0, 0.1]}
    spent |= {"remap": [2.0, 3.0, 3.0, 3.0, 50.0], "products": [12.0, 12.0, 12.0, 1.0, 99.0]}
    waited = {"process": 6.0, "copy": 0.0, "remap": 2.0, "products": 100.0}
    clock = {"cpu": 0.0, "wall": 0.0}

    def task(name: str) -> Any:
        left = iter(spent[name])

        def run() -> None:
            used = next(left)
            clock["cpu"] += used
            clock["wall"] += used + waited[name]

        return run

    monkeypatch.setattr(time, "process_time", lambda: clock["cpu"])
    monkeypatch.setattr(time, "perf_counter", lambda: clock["wall"])
    timed = interleaved(gate.RUNS, **{name: task(name) for name in spent})
    assert gate.ratios_of(timed) == pytest.approx(
        {"copy": 90.0, "remap": 3.0, "remap, with files": 4.0, "remap, elapsed": 3.0}
    )


def test_accepting_compares_with_the_record_before(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], record: Path
) -> None:
    monkeypatch.setattr(gate.compared, "__defaults__", (record,))
    monkeypatch.setattr(gate.accept, "__defaults__", (record,))
    monkeypatch.setattr(gate, "processor_name", lambda: PROCESSOR)
    monkeypatch.setattr(mini, "GROUND", "landscape")
    monkeypatch.setattr(mini, "_fly", lambda _folder: (None, None))
    monkeypatch.setattr(mini, "_in_own_process", lambda *_: {"ratios": {"remap": 3.0}})
    monkeypatch.setattr(mini, "_time_writer", lambda *_: {})
    monkeypatch.setattr(sys, "argv", ["mini", "--json", "--accept"])
    assert mini.main() == 0
    found = json.loads(capsys.readouterr().out)["gate"]
    assert found["slower"] == ["remap"] and "record 2.00 (+50%)" in found["sentences"][0]
    table = read_record(record).figures[0].table
    assert table is not None and [row[2:4] for row in table.rows] == [("remap", "3.00")]


@pytest.mark.parametrize(
    ("factor", "known", "status", "sentence"),
    [
        (1.0, True, 0, "record 10.00 (+0%)"),
        (1.09, True, 0, "record 10.00 (+9%)"),
        (1.11, True, 1, "That is slower by more than 10%"),
        (1.0, False, 3, "the record has no figure for"),
    ],
)
def test_make_bench_exits_by_what_it_found(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    factor: float,
    known: bool,
    status: int,
    sentence: str,
) -> None:
    ratios = {"copy": 10.0 * factor, "remap": 2.0}
    rows = [(PROCESSOR, mini.GROUND, name, v) for name, v in (("copy", "10.0"), ("remap", "2.0"))]
    monkeypatch.setattr(gate, "_rows", lambda _record: rows if known else [])
    monkeypatch.setattr(gate, "processor_name", lambda: PROCESSOR)
    monkeypatch.setattr(mini, "_fly", lambda _folder: (None, None))
    monkeypatch.setattr(mini, "_in_own_process", lambda *_: {"ratios": ratios})
    monkeypatch.setattr(mini, "_time_writer", lambda *_: {})
    monkeypatch.setattr(sys, "argv", ["mini", "--json"])
    assert mini.main() == status
    assert sentence in " ".join(json.loads(capsys.readouterr().out)["gate"]["sentences"])


def test_fewer_runs_than_five_are_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["mini", "--runs", "4"])
    with pytest.raises(SystemExit) as stopped:
        mini.main()
    assert stopped.value.code == 2
    assert "--runs is 4; the gate compares medians of 5 or more" in capsys.readouterr().err
