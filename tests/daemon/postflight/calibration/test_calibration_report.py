"""The folder every calibration leaves: complete or not there, compared, never overwritten."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from daemon.postflight.calibration.calibration_report import (
    CalibrationFolderError,
    CalibrationReport,
    Plot,
    Quantity,
    ReportTable,
    calibration_folder,
    changes_between,
    read_previous,
    serial_warnings,
    with_content_id,
    write_calibration,
)
from daemon.postflight.plots import (
    Curve,
    chart_svg,
)

REPORT = CalibrationReport(
    kind="head",
    title="Head <1>",
    calibration_id="head-1",
    date="2026-11-21",
    facts=[("targets", "97")],
    serials={"head": "H-1"},
    quantities=[Quantity("head", "dx0", "um", 3.0, 0.4), Quantity("head", "f", "mm", 120.0, None)],
    tables=[ReportTable("Parameters", ("", "value"), [("dx0", 3.0), ("k1", None)])],
    plots=[Plot("P", chart_svg("t", ("x", "y"), [Curve("a&b", [1.0, 2.0], [3.0, 4.0])]))],
)


def test_a_calibration_is_read_back_as_the_previous_one_and_never_overwritten(
    tmp_path: Path,
) -> None:
    folder = write_calibration(tmp_path / "a", REPORT, {"maps/x.npz": b"1"})
    assert (folder / "maps" / "x.npz").read_bytes() == b"1"
    previous = read_previous(folder, kind="head")
    assert previous.quantities == tuple(REPORT.quantities)
    assert previous.serials == {"head": "H-1"}
    with pytest.raises(CalibrationFolderError, match="never overwritten"):
        write_calibration(folder, REPORT)
    page = (folder / "report.html").read_text()
    assert "Head &lt;1&gt;" in page
    assert "a&amp;b" in page
    assert "http-equiv" not in page
    assert json.loads((folder / "calibration.json").read_text())["changes"] == []


def test_a_new_calibration_is_written_next_to_its_source_or_to_the_given_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    series = tmp_path / "field" / "series"
    series.mkdir(parents=True)
    monkeypatch.chdir(series)
    place = calibration_folder(None, "x-lab", "2026-11-22", next_to=Path())
    assert (place.name, place.of("an id")) == ("x-lab-2026-11-22", tmp_path / "field" / "an id")
    folder = calibration_folder(tmp_path / "mine", "x-lab", "2026-11-22", next_to=series)
    assert (folder.name, folder.of("an id")) == ("mine", tmp_path / "mine")
    with pytest.raises(CalibrationFolderError, match="never overwritten"):
        calibration_folder(series, "x-lab", "2026-11-22", next_to=series)
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(CalibrationFolderError, match="cannot be written to; say with --out"):
        calibration_folder(None, "x-lab", "2026-11-22", next_to=series)


def test_an_id_distinguishes_content() -> None:
    def rig_file(identified_report: str) -> bytes:
        return f"id = {identified_report}".encode()

    identified_report, files = with_content_id(REPORT, {"maps.npz": b"1"}, rig_file)
    assert re.fullmatch(r"head-1-[0-9a-f]{8}", identified_report.calibration_id)
    assert files == {"maps.npz": b"1", "rig.toml": rig_file(identified_report.calibration_id)}
    assert with_content_id(REPORT, {"maps.npz": b"1"}, rig_file)[0] == identified_report
    moved = replace(REPORT.quantities[0], value=REPORT.quantities[0].value + 1e-9)
    others = (
        with_content_id(REPORT, {"maps.npz": b"2"}, rig_file),
        with_content_id(REPORT, {"maps.npz": b"1"}, lambda name: rig_file(name) + b" "),
        with_content_id(replace(REPORT, quantities=[moved]), {"maps.npz": b"1"}, rig_file),
        with_content_id(REPORT, {}),
    )
    assert (
        len({identified_report.calibration_id, *(other.calibration_id for other, _ in others)}) == 5
    )


def test_a_change_is_significant_only_beyond_the_limit_of_all_that_are_compared() -> None:
    old = [Quantity("s", f"p{k}", "um", 0.0, 0.3) for k in range(100)]
    new = [replace(q, value=1.7 if q.what == "p7" else 2.1 * (q.what == "p8")) for q in old]
    changes = changes_between(old, new)
    # Of 100 changes at 1 % together the limit is 3.89; 1.7 / 0.424 is 4.0.
    assert changes[0].limit == pytest.approx(3.89, abs=0.01)
    assert [c.what for c in changes if c.significant] == ["p7", "p8"]
    unknown = changes_between(
        [Quantity("s", "f", "mm", 1.0, None)], [Quantity("s", "f", "mm", 2, None)]
    )
    assert unknown[0].significant is None


def test_another_serial_number_is_reported(tmp_path: Path) -> None:
    previous = read_previous(write_calibration(tmp_path / "a", REPORT), kind="head")
    assert "'H-2'" in serial_warnings(previous, {"head": "H-2"})[0]
    assert serial_warnings(previous, {"head": "H-1"}) == []
    with pytest.raises(CalibrationFolderError, match="syntopic calibrate lab"):
        read_previous(tmp_path / "a", kind="lab")
