"""kill -9 at random system calls of the commands that change a mission."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from tempfile import mkdtemp

import pytest

from daemon.mission.store import durable
from tests.robustness.crash.kill_commands import COMMANDS
from tests.robustness.crash.prefixes import ROOT
from tests.robustness.crash.test_prefixes import MEMORY
from tests.robustness.crash.write_log import needs_strace

pytestmark = [pytest.mark.trust, needs_strace]

KILLS = int(os.environ.get("SYNTOPIC_COMMAND_KILLS", "1000"))
"""In the long run."""


def killed(kills: int, seed: int, *, parent: Path | None) -> dict[str, object]:
    folder = Path(mkdtemp(prefix="syntopic-", dir=parent))
    command = [
        sys.executable,
        "-m",
        "tests.robustness.crash.kill_commands",
        str(folder),
        str(kills),
        str(seed),
    ]
    done = subprocess.run(
        command,
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=7000,
        env={**os.environ, "NUMBA_NUM_THREADS": "1"},
    )
    durable.remove_tree(folder)
    assert done.returncode == 0, done.stderr[-3000:]
    figures: dict[str, object] = json.loads(done.stdout)
    print(json.dumps(figures))
    return figures


def test_a_few_kills_of_each_command_lose_nothing_and_the_next_run_finishes() -> None:
    figures = killed(8, 1, parent=MEMORY if MEMORY.is_dir() else None)
    assert figures["wrong"] == []
    assert isinstance(figures["kills"], dict) and set(figures["kills"]) == set(COMMANDS)
    assert all(figures["kills"].values())


@pytest.mark.soak
@pytest.mark.timeout(7200)
def test_many_kills_of_commands_lose_nothing() -> None:
    """On a real disk."""
    figures = killed(KILLS, 2, parent=None)
    assert figures["wrong"] == [] and isinstance(figures["all_kills"], int)
    assert figures["all_kills"] >= KILLS
