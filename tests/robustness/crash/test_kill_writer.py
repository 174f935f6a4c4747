"""kill -9 at random instants of the writer, over and over in the same missions."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from tempfile import mkdtemp

import pytest

from daemon.mission.store import durable
from tests.robustness.crash.prefixes import ROOT
from tests.robustness.crash.test_prefixes import MEMORY


def killed(folder: Path, kills: int, seed: int) -> dict[str, object]:
    command = [
        sys.executable,
        "-m",
        "tests.robustness.crash.kill_writer",
        str(folder),
        str(kills),
        str(seed),
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=3000)
    assert done.returncode == 0, done.stderr[-3000:]
    figures: dict[str, object] = json.loads(done.stdout)
    print(json.dumps(figures))
    return figures


def test_sixty_kills_take_nothing_that_was_acknowledged() -> None:
    folder = Path(mkdtemp(prefix="syntopic-", dir=MEMORY if MEMORY.is_dir() else None))
    figures = killed(folder, 60, 1)
    durable.remove_tree(folder)
    assert figures["wrong"] == []
    assert figures["kills"] == 60 and figures["stored"] > 30
    assert figures["killed_in_recovery"] > 0


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_two_thousand_kills_take_nothing_that_was_acknowledged() -> None:
    """On a real disk."""
    folder = Path(mkdtemp(prefix="syntopic-kills-"))
    figures = killed(folder, 2000, 2)
    durable.remove_tree(folder)
    assert figures["wrong"] == [] and figures["kills"] == 2000
