"""The paths of docs/reference/contributing/finding-things.md."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Final

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs/reference/contributing/finding-things.md"

ANSWERS: Final[Mapping[str, str]] = {
    "decoder.py": r"falling",
    "flight.py": r"Cause\.LATE",
    "transitions.py": r"class .*State|TRANSITIONS",
    "mark_matching.py": r"class MarkMatcher",
    "trigger_policies.py": r"class .*(Interval|Distance)",
    "roles.py": r"COMMAND_ROLES",
    "prerequisites.py": r"CHECKS: Final",
    "writer.py": r"def _store\(",
    "mirrored.py": r"def .*drop",
    "inventory.py": r"why such a file has no hash",
    "transfer_removal.py": r"def .*remov",
    "model.py": r"class Configuration\b",
    "reflight_planning.py": r"def reflights",
    "navigation.py": r"interpolated_quaternion",
    "packet_filter.py": r"def .*filter|class .*Filter",
    "lens.py": r"K1|k1",
    "datum.py": r"constraint",
    "validity.py": r"displaced",
    "evaluation.py": r"Verdict\.REFLY|REFLY",
    "nmea_sentences.py": r"GGA",
}
"""What the module of each answer contains, by its name: the code that decides, not a mention."""


def test_every_path_leads_to_a_module() -> None:
    paths = [
        Path(*re.findall(r"`([^`]+)`", line.split("|")[2]))
        for line in PAGE.read_text("utf-8").splitlines()
        if " > " in line
    ]
    assert len(paths) == 20
    assert [str(path) for path in paths if not (ROOT / path).is_file()] == []
    assert {path.name for path in paths} == ANSWERS.keys()
    without = [
        str(path)
        for path in paths
        if not re.search(ANSWERS[path.name], (ROOT / path).read_text("utf-8"))
    ]
    assert without == [], "the answer has moved"


def test_the_first_level_of_each_package_has_ten_entries_at_most() -> None:
    for package in ("daemon", "drivers", "processing", "sim_hw", "tests"):
        entries = {
            path.name
            for path in (ROOT / package).iterdir()
            if (path.is_dir() and any(path.rglob("*.py"))) or path.suffix == ".py"
        } - {"__init__.py", "__main__.py"}  # in every package, for the same purpose
        assert len(entries) <= 10, (package, sorted(entries))
