"""The paths of docs/reference/contributing/finding-things.md."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs/reference/contributing/finding-things.md"


def test_every_path_leads_to_a_module() -> None:
    paths = [
        Path(*re.findall(r"`([^`]+)`", line.split("|")[2]))
        for line in PAGE.read_text("utf-8").splitlines()
        if " > " in line
    ]
    assert len(paths) == 20
    assert [str(path) for path in paths if not (ROOT / path).is_file()] == []


def test_the_first_level_of_each_package_has_ten_entries_at_most() -> None:
    for package in ("daemon", "drivers", "processing", "sim_hw", "tests"):
        entries = {
            path.name
            for path in (ROOT / package).iterdir()
            if (path.is_dir() and any(path.rglob("*.py"))) or path.suffix == ".py"
        } - {"__init__.py", "__main__.py"}  # in every package, for the same purpose
        assert len(entries) <= 10, (package, sorted(entries))
