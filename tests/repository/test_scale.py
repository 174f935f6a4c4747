"""The figures of docs/explanation/processing/scale.md follow from the records they name."""

from __future__ import annotations

import re

import pytest

from benchmarks.records import FOLDER, ROOT

PAGE = (ROOT / "docs/explanation/processing/scale.md").read_text(encoding="utf-8")
UNIT_S = {"s": 1.0, "minutes": 60.0, "hours": 3600.0, "days": 86400.0}
RAW_MB, LEVEL2_MB, LOAD_PER_S = 432.0, 393.0, 250.0


def cpu_s() -> float:
    """CPU seconds an exposure, two in work, of the record."""
    text = (FOLDER / "bench-ultracam-x.json").read_text(encoding="utf-8")
    found = re.search(r"an exposure, (\d\.\d\d) CPU s", text)
    assert found is not None
    return float(found[1])


def number(text: str) -> float:
    return float(text.replace(",", ""))


def seconds(text: str) -> float:
    value, unit = text.split()
    return float(value) * UNIT_S[unit]


def cells(start: str) -> list[str]:
    (line,) = [line for line in PAGE.splitlines() if line.startswith(start)]
    return [cell.strip() for cell in line.strip("|").split("|")]


@pytest.mark.parametrize("count", ["10,000", "1,000,000", "100,000,000"])
def test_core_hours_and_times_are_those_of_the_measured_cpu_time(count: str) -> None:
    row = next(
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in PAGE.splitlines()
        if line.startswith(f"| {count} |") and "B |" in line
    )
    total_s = number(count) * cpu_s()
    assert number(row[3]) == pytest.approx(total_s / 3600.0, rel=0.02)
    assert seconds(row[4]) == pytest.approx(total_s / 100.0, rel=0.03)
    assert seconds(row[5]) == pytest.approx(total_s / 1000.0, rel=0.03)


def test_rates_of_a_core_and_cores_of_a_scheduler_are_those_of_the_measured_cpu_time() -> None:
    assert f"from {cpu_s():.2f} CPU seconds" in PAGE
    assert f"exposures of {cpu_s():.2f} s" in PAGE
    rates = re.search(r"Each core reads (\d+) MB/s and writes (\d+) MB/s", PAGE)
    assert rates is not None
    expected = [round(RAW_MB / cpu_s()), round(LEVEL2_MB / cpu_s())]
    assert [int(rate) for rate in rates.groups()] == expected
    cores = round(LOAD_PER_S * cpu_s())
    assert int(cells("| cores at 250 tasks a second")[1]) == cores
    assert f"Beyond {cores} cores" in PAGE
