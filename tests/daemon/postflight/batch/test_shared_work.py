"""The work of `syntopic process` shares calibration maps where several processes compute."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.cli.batch_options import ExecutorOptions, Placement
from daemon.postflight.batch import level2_work
from tests.daemon.diverging_camera import HEADS, flown_mission


@pytest.mark.parametrize("is_in_process", [True, False])
def test_maps_are_shared_where_processes_compute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_in_process: bool
) -> None:
    mission = flown_mission(tmp_path, (1,))
    shared: list[list[str]] = []
    place = ExecutorOptions.place

    def placed(self: ExecutorOptions, *arguments: Any, **options: Any) -> Placement:
        found = place(self, *arguments, **options)
        return found if is_in_process else Placement(Elsewhere(found.executor), found.allocation)

    class Elsewhere:
        """An executor that is not of this process, by its type."""

        def __init__(self, executor: Any) -> None:
            self._executor = executor

        def __getattr__(self, name: str) -> Any:
            return getattr(self._executor, name)

    monkeypatch.setattr(ExecutorOptions, "place", placed)
    monkeypatch.setattr(level2_work, "share_maps", lambda maps: shared.append(sorted(maps)))
    done = CliRunner().invoke(app, ["process", str(mission.path), "--processes", "0"])
    assert done.exit_code == 0, (done.output, done.exception)
    assert shared == ([] if is_in_process else [sorted(HEADS)])
