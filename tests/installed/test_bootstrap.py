"""`bootstrap.sh` prints one line a step; of a step that fails, the end of its output and a
remedy."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DPKG_QUERY = "#!/bin/sh\necho ii\n"
PYTHON = """#!/bin/sh
case "$*" in
*version_info*) exit 0 ;;
"-m venv .venv") mkdir -p .venv/bin && cp "$0" .venv/bin/python ;;
*--require-hashes*)
    for i in $(seq 400); do echo "Collecting package$i"; done
    echo "WARNING: Location '/somewhere' is ignored"
    [ ! -e refuse ] || { echo "ERROR: hashes do not match" >&2; exit 3; } ;;
*"-e ."*) printf '#!/bin/sh\necho "$*" >>commands\n' >.venv/bin/syntopic
    chmod +x .venv/bin/syntopic ;;
esac
"""


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A folder with the script, and programs that take the place of dpkg, Python and pip."""
    for name in ("bootstrap.sh", "requirements.lock", "pyproject.toml", "Makefile"):
        shutil.copyfile(ROOT / name, tmp_path / name)
    kernels = tmp_path / "processing/pipelines"
    kernels.mkdir(parents=True)
    (kernels / "kernel_variants.toml").touch()
    (kernels / "kernels.py").touch()
    programs = tmp_path / "programs"
    programs.mkdir()
    for name, text in (("dpkg-query", DPKG_QUERY), ("python3", PYTHON)):
        (programs / name).write_text(text, "utf-8")
        (programs / name).chmod(0o755)
    return tmp_path


def bootstrap(clone: Path) -> subprocess.CompletedProcess[str]:
    return run(clone, "sh", "bootstrap.sh")


def run(clone: Path, *command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command,
        cwd=clone,
        env={"PATH": f"{clone / 'programs'}:{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def test_each_step_is_a_line_and_the_output_of_pip_is_in_the_log(clone: Path) -> None:
    done = bootstrap(clone)
    assert (done.returncode, done.stderr) == (0, "")
    assert {line[:5] for line in done.stdout.splitlines()} == {f"[{n}/5]" for n in (1, 2, 3, 4)}
    assert len(done.stdout.splitlines()) <= 8
    assert "WARNING" in (clone / "build/setup.log").read_text("utf-8")
    assert "[2/5] Virtual environment: present" in bootstrap(clone).stdout


def test_a_step_that_fails_prints_the_end_of_its_output_and_a_remedy(clone: Path) -> None:
    (clone / "refuse").touch()
    done = bootstrap(clone)
    assert done.returncode == 1
    lines = done.stderr.splitlines()
    assert lines[0] == "[3/5] Python packages failed with status 3. The end of build/setup.log:"
    assert lines[-2].strip() == "ERROR: hashes do not match"
    assert lines[-1].startswith("Check the network, the package index and the free disk space.")
    assert len(lines) <= 17


def test_the_second_set_up_does_nothing(clone: Path) -> None:
    first = run(clone, "make", "setup")
    assert first.returncode == 0, first.stderr
    assert [f"[{n}/5]" in first.stdout for n in range(1, 6)] == [True] * 5
    log = (clone / "build/setup.log").stat().st_mtime_ns
    second = run(clone, "make", "setup")
    assert (second.returncode, second.stderr) == (0, "")
    assert second.stdout == "make: Nothing to be done for 'setup'.\n"
    assert (clone / "build/setup.log").stat().st_mtime_ns == log
    assert (clone / "commands").read_text("utf-8") == "kernels\n"


def test_after_a_change_of_a_kernel_only_kernels_are_compiled(clone: Path) -> None:
    run(clone, "make", "setup")
    stamp = (clone / ".venv/kernels").stat().st_mtime_ns + 1_000_000_000
    os.utime(clone / "processing/pipelines/kernels.py", ns=(stamp, stamp))
    again = run(clone, "make", "setup")
    assert again.stdout == "[5/5] Compiled kernels ...\n"
    assert (clone / "commands").read_text("utf-8") == "kernels\n" * 2
