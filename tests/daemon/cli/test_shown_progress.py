"""What a person sees of a run on an executor while it lasts."""

from __future__ import annotations

import io

import pytest

from daemon.cli import batch_options
from daemon.cli.batch_options import shown_progress
from daemon.postflight.batch.batch_run import BatchCounts
from daemon.terminal.console import Console

SECONDS_EACH = 2.0


def test_progress_has_count_rate_remaining_time_and_what_failed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    screen, now_s = io.StringIO(), [0.0]
    console = Console(file=screen, force_terminal=True, width=160, get_time=lambda: now_s[0])
    monkeypatch.setattr(batch_options, "Console", lambda **_options: console)
    with shown_progress("processing", 40, 5) as show:
        for done in range(1, 11):
            now_s[0] += SECONDS_EACH
            show(BatchCounts(done=done, failed=1, lost_processes=2, memory_retries=3))
    shown = screen.getvalue()
    assert "processing" in shown and "16/40" in shown  # 5 before, 10 done, 1 failed
    assert "0.50/s" in shown and "0:00:48" in shown  # 24 exposures of 2 s
    assert "1 failed, 2 processes lost, 3 memory retries" in shown and "store retries" not in shown
