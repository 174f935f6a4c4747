"""Every pinned package has hashes, and the installation insists on them."""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LOCK = ROOT / "requirements.lock"
FUZZ = ROOT / "requirements-fuzz.lock"
"""What `make fuzz` needs in addition."""
DOCS = ROOT / "requirements-docs.lock"
"""What `make docs` needs in addition."""

pytestmark = pytest.mark.trust


def requirements(lock: Path) -> list[str]:
    """Each requirement with its continuation lines."""
    text = re.sub(r" *#.*", "", lock.read_text("utf-8"))
    return [line for line in text.replace("\\\n", " ").splitlines() if line.strip()]


@pytest.mark.parametrize(
    ("lock", "least"), [(LOCK, 60), (FUZZ, 1), (DOCS, 20)], ids=lambda one: str(one)
)
def test_every_package_has_a_version_and_hashes(lock: Path, least: int) -> None:
    assert len(requirements(lock)) >= least
    for line in requirements(lock):
        assert re.match(r"[A-Za-z0-9._-]+==\S+", line), line
        assert re.search(r"--hash=sha256:[0-9a-f]{64}", line), line


@pytest.mark.parametrize(
    ("where", "lock"),
    [
        *(("bootstrap.sh", LOCK), ("docs/how-to/flight/installation.md", LOCK)),
        *(("Makefile", FUZZ), ("Makefile", DOCS)),
    ],
)
def test_installing_insists_on_hashes(where: str, lock: Path) -> None:
    lines = [one for one in (ROOT / where).read_text("utf-8").splitlines() if lock.name in one]
    installing = [one for one in lines if "pip install" in one]
    assert installing
    assert all("--require-hashes" in one for one in installing)


def test_a_file_that_was_exchanged_is_refused(tmp_path: Path) -> None:
    wheel = tmp_path / "planted-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("planted.py", "")
        archive.writestr("planted-1.0.dist-info/METADATA", "Name: planted\nVersion: 1.0\n")
        archive.writestr("planted-1.0.dist-info/WHEEL", "Wheel-Version: 1.0\n")
        archive.writestr("planted-1.0.dist-info/RECORD", "")
    lock = tmp_path / "requirements.lock"
    for content, is_accepted in ((wheel.read_bytes(), True), (b"another file", False)):
        lock.write_text(f"planted==1.0 --hash=sha256:{hashlib.sha256(content).hexdigest()}\n")
        tried = subprocess.run(
            [
                *(sys.executable, "-m", "pip", "download", "-q", "--no-index", "--no-deps"),
                *("--require-hashes", "--find-links", str(tmp_path), "-d", str(tmp_path / "out")),
                *("-r", str(lock)),
            ],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert (tried.returncode == 0) == is_accepted, tried.stderr
    assert "DO NOT MATCH THE HASHES" in tried.stderr


def test_what_two_locks_pin_has_one_version() -> None:
    pinned = [
        dict(re.findall(r"^([\w.-]+)==(\S+)", "\n".join(requirements(lock)), re.MULTILINE))
        for lock in (LOCK, DOCS)
    ]
    both = pinned[0].keys() & pinned[1].keys()
    assert len(both) > 5
    assert {name for name in both if pinned[0][name] != pinned[1][name]} == set()
