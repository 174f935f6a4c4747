"""A new mission is flown by the same command, with its configuration read again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import typer

from daemon.cli.run import run


class FakeService:
    """Runs at once; each next one as listed: exit status, and whether a mission follows."""

    endings: list[tuple[int, bool]]
    flown: list[Any]

    def __init__(self, configuration: Any, _rig: Any, _path: Path, _show: Callable[..., None]):
        self.flown.append(configuration)
        self.continues = False

    async def run(self) -> int:
        status, self.continues = self.endings.pop(0)
        return status


@pytest.mark.parametrize(
    ("endings", "flown", "status"),
    [
        ([(0, False)], 1, 0),
        ([(0, True), (0, True), (0, False)], 3, 0),
        # After a fault the service manager starts it again, into the same mission.
        ([(1, True)], 1, 1),
    ],
)
def test_missions_follow_each_other_until_one_lands_or_fails(
    monkeypatch: pytest.MonkeyPatch,
    endings: list[tuple[int, bool]],
    flown: int,
    status: int,
) -> None:
    read = iter(range(10))
    monkeypatch.setattr(
        "daemon.onboard.preflight.service_file.load", lambda _path: (next(read), None)
    )
    monkeypatch.setattr("daemon.onboard.service.service.Service", FakeService)
    FakeService.endings, FakeService.flown = list(endings), []
    with pytest.raises(typer.Exit) as ended:
        run(Path("service.toml"), json_lines=False)
    assert ended.value.exit_code == status
    assert FakeService.flown == list(range(flown))
