"""A distribution that installs into Syntopic's packages is named by `syntopic check`."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

import pytest

from daemon.onboard.preflight.import_names import foreign_files, import_names
from daemon.onboard.preflight.prerequisites import CHECKS_AT_START

pytestmark = pytest.mark.trust


def plant(folder: Path, name: str, file: str, content: str) -> list[metadata.Distribution]:
    info = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / file).write_text(content)
    return list(metadata.distributions(path=[str(folder)]))


@pytest.mark.parametrize(
    ("file", "content", "found"),
    [
        ("RECORD", "x/y.py,,\ndaemon/__init__.py,sha256=a,1\n", "daemon/__init__.py"),
        ("RECORD", "sim_hw/world/x.py,,\n", "sim_hw/world/x.py"),
        ("RECORD", "drivers.py,,\n", "drivers.py"),
        ("top_level.txt", "lockfile\nprocessing\n", "processing"),
    ],
)
def test_a_file_in_our_packages_is_named(
    tmp_path: Path, file: str, content: str, found: str
) -> None:
    planted = plant(tmp_path, "python-daemon", file, content)
    assert foreign_files(planted) == {"python-daemon": found}


@pytest.mark.parametrize("record", ["daemonize/__init__.py,,\n", "x/daemon/__init__.py,,\n"])
def test_similar_names_are_not_ours(tmp_path: Path, record: str) -> None:
    assert foreign_files(plant(tmp_path, "other", "RECORD", record)) == {}


def test_our_own_distribution_is_not_foreign(tmp_path: Path) -> None:
    assert foreign_files(plant(tmp_path, "syntopic", "RECORD", "daemon/cli/run.py,,\n")) == {}


def test_check_and_run_use_it() -> None:
    assert import_names in CHECKS_AT_START
    assert foreign_files() == {}
