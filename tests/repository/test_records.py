"""Documents show measurements from their records, and quote no dated figure of their own."""

from __future__ import annotations

import json
import re
from collections import Counter
from pathlib import Path

import pytest

from benchmarks.records import (
    END,
    FOLDER,
    NOT_RECORDED,
    ROOT,
    Record,
    RecordError,
    all_records,
    documents,
    read_record,
    rendered,
    updated,
    used_records,
    without_records,
)
from benchmarks.records.__main__ import main

# Not within an identifier such as lab-2026-11-22, nor the beginning of a time stamp.
DATE = re.compile(r"(?<![-\w])20\d\d-\d\d-\d\d(?![-T\d])")
# Old records whose source does not state it. A new record states both.
WITHOUT_COMMAND = {
    "aravis-unpacking",
    "bench-cpu-time",
    "bench-same-bits",
    "bench-shared-cells",
    "bench-tie-points",
    "bench-two-stages",
    "bundle-figures",
    "calibration-figures",
    "crash-states",
    "hostile-parsers",
    "ultracam-l",
    "v4l2-unpacking",
}
WITHOUT_MACHINE = {
    "crash-states",
    "dc-simulated",
    "failing-disk-in-flight",
    "rededge-registration",
    "silent-error-limits",
    "thermal-calibration",
}
VALID = {
    "date": ["2026-11-22"],
    "command": "python -m benchmarks.flags",
    "machine": "Intel Xeon, 2 cores",
    "figures": [{"table": {"columns": ["a", "b"], "rows": [["1", ""]]}}, {"text": "One is 1."}],
}


def test_every_record_is_valid_and_used_once() -> None:
    used = Counter(
        name for document in documents() for name in used_records(document.read_text("utf-8"))
    )
    assert set(used) == set(all_records())
    assert not [name for name, times in used.items() if times > 1]


def test_a_new_record_states_its_command_and_its_machine() -> None:
    records = all_records()
    assert {n for n, r in records.items() if r.command == NOT_RECORDED} == WITHOUT_COMMAND
    assert {n for n, r in records.items() if r.machine == NOT_RECORDED} == WITHOUT_MACHINE


def test_what_is_not_recorded_is_stated() -> None:
    old = Record.model_validate(VALID | {"command": NOT_RECORDED, "machine": NOT_RECORDED})
    text = rendered("old", old, ROOT / "README.md")
    assert "command not recorded; machine not recorded; 2026-11-22." in text


def test_documents_are_up_to_date(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--check"]) == 0, f"run python -m benchmarks.records: {capsys.readouterr().out}"


@pytest.mark.parametrize(
    "document",
    # A decision has its date.
    [document for document in documents() if "decisions" not in document.parts],
    ids=lambda d: d.relative_to(ROOT).as_posix(),
)
def test_a_document_has_no_dated_figure_of_its_own(document: Path) -> None:
    own = without_records(document.read_text("utf-8"))
    dated = [line for line in own.splitlines() if DATE.search(line)]
    assert not dated, "put the figures into benchmarks/records/*.json"


def test_a_record_becomes_tables_and_sentences_with_their_source() -> None:
    text = rendered("flags", Record.model_validate(VALID), ROOT / "docs" / "a" / "b.md")
    assert text == (
        "| a | b |\n| --- | --- |\n| 1 | |\n\nOne is 1.\n\n"
        "Record [flags](../../benchmarks/records/flags.json): `python -m benchmarks.flags`; Intel "
        "Xeon, 2\ncores; 2026-11-22.\n"
    )


def test_an_edited_figure_is_written_over_from_its_record() -> None:
    record, document = Record.model_validate(VALID), ROOT / "README.md"
    block = f"<!-- record: x -->\n\n{rendered('x', record, document)}\n{END}"
    edited = f"Before.\n\n{block}\n\nAfter.\n".replace("| 1 |", "| 2 |")
    assert updated(edited, document, {"x": record}) == f"Before.\n\n{block}\n\nAfter.\n"
    assert without_records(edited) == "Before.\n\n\n\nAfter.\n"


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (f"<!-- record: unknown -->\n{END}\n", "no record unknown"),
        ("<!-- record: x -->\nfigures\n", "has no line"),
        (f"figures\n{END}\n", "has no line"),
    ],
)
def test_a_document_with_a_broken_record_is_refused(text: str, error: str) -> None:
    with pytest.raises(RecordError, match=error):
        updated(text, ROOT / "README.md", {"x": Record.model_validate(VALID)})


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"date": []}, "date"),
        ({"date": ["22.11.2026"]}, "date"),
        ({"machine": ""}, "machine"),
        ({"machine": None}, "machine"),
        ({"command": None}, "command"),
        ({"load": "busy"}, "load"),
        ({"figures": []}, "figures"),
        ({"figures": [{"text": "a", "item": "b"}]}, "one of text, item and table"),
        ({"figures": [{}]}, "one of text, item and table"),
        ({"figures": [{"text": "two\nlines"}]}, "text"),
        (
            {"figures": [{"table": {"columns": ["a"], "rows": [["1", "2"]]}}]},
            "row 0 has 2 cells; there are 1 columns",
        ),
    ],
)
def test_a_record_that_is_not_valid_is_refused_by_name(
    tmp_path: Path, change: dict[str, object], error: str
) -> None:
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(VALID | change))
    with pytest.raises(RecordError, match=rf"bad\.json(.|\n)*{re.escape(error)}"):
        read_record(path)
    path.write_text("{")
    with pytest.raises(RecordError, match=r"bad\.json"):
        read_record(path)


def test_the_folder_holds_records_and_the_code_that_reads_them_only() -> None:
    names = {path.name for path in FOLDER.iterdir() if path.suffix != ".json"}
    assert names <= {"__init__.py", "__main__.py", "__pycache__"}
