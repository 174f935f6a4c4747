"""What the emulator writes is complete where it has its name."""

from __future__ import annotations

from pathlib import Path

import pytest

from sim_hw.world.atomic_file import atomic_file
from tests.robustness.crash.kill_at_call import run_to_call

pytestmark = pytest.mark.trust


def write(path: Path) -> None:
    with atomic_file(path) as part, part.open("wb") as file:
        file.write(b"new" * 1000)


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_failure_leaves_the_earlier_file_and_nothing_else(
    tmp_path: Path, error: type[BaseException]
) -> None:
    path = tmp_path / "series.json"
    path.write_bytes(b"old")
    with pytest.raises(error), atomic_file(path) as part:
        part.write_bytes(b"ne")
        raise error
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_kill_at_any_call_leaves_the_old_or_the_new_file(tmp_path: Path) -> None:
    path = tmp_path / "series.json"
    seen = set()
    for last in range(1, len(run_to_call(lambda: write(path), None)) + 1):
        path.write_bytes(b"old")
        run_to_call(lambda: write(path), last)
        seen.add(path.read_bytes())
    assert seen == {b"old", b"new" * 1000}
