"""Shells complete commands, commands of a group and options of `syntopic`."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

SYNTOPIC = Path(sys.executable).with_name("syntopic")
ENVIRONMENT = {"PATH": f"{SYNTOPIC.parent}:{os.environ['PATH']}", "HOME": "/nonexistent"}
TIMEOUT_S = 60.0


def completed(shell: str, line: str) -> str:
    """What the command answers to the completion of a line by a shell."""
    words = line.split(" ")
    added = {
        "_SYNTOPIC_COMPLETE": f"complete_{shell}",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(words) - 1),
        "_TYPER_COMPLETE_ARGS": line,
        "_TYPER_COMPLETE_FISH_ACTION": "get-args",
    }
    return subprocess.run(
        [str(SYNTOPIC)],
        env=ENVIRONMENT | added,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    ).stdout


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_each_shell_is_given_a_command_and_no_other(shell: str) -> None:
    answer = completed(shell, "syntopic tri")
    assert "triangulate" in answer
    assert "pansharpen" not in answer
    if shell != "bash":
        assert "Run the aerial triangulation of a mission." in answer


def test_the_script_completes_in_a_real_bash() -> None:
    script = (
        "source <(_SYNTOPIC_COMPLETE=source_bash syntopic); complete -p syntopic; "
        'for line in "$@"; do COMP_WORDS=($line); COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); '
        'COMPREPLY=(); _syntopic_completion syntopic; echo "$line: ${COMPREPLY[*]}"; done'
    )
    lines = ["syntopic pans", "syntopic calibrate la", "syntopic demo --expo"]
    done = subprocess.run(
        ["bash", "-c", script, "bash", *lines],
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=2 * TIMEOUT_S,
        check=False,
    )
    assert done.stdout.splitlines()[1:] == [
        "syntopic pans: pansharpen",
        "syntopic calibrate la: lab",
        "syntopic demo --expo: --exposures",
    ], done.stdout + done.stderr
    assert "_syntopic_completion" in done.stdout.splitlines()[0]


def test_completion_imports_no_command_and_no_heavy_library() -> None:
    """A person waits for it at every press of the key."""
    code = (
        "import atexit, sys\n"
        "heavy = {'numpy', 'scipy', 'numba', 'cv2', 'daemon.cli.triangulate', 'processing'}\n"
        "atexit.register(lambda: print('HEAVY', sorted(heavy & set(sys.modules))))\n"
        "from daemon.cli import main\n"
        "sys.argv = ['syntopic']\n"
        "main()\n"
    )
    added = {"_SYNTOPIC_COMPLETE": "complete_bash", "COMP_WORDS": "syntopic tri", "COMP_CWORD": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=ENVIRONMENT | added,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.stdout.split() == ["triangulate", "HEAVY", "[]"], done.stderr
