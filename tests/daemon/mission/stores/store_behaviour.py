"""What every kind of store has to do; the tests of each kind call it with an address."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.transfer.object_store import ObjectStore, ObjectStoreError
from daemon.mission.transfer.store_products import commit_stored, is_stored, publish_stored
from daemon.mission.transfer.store_transfer import transfer_to_store
from daemon.mission.transfer.store_verification import verify_in_store
from tests.daemon.diverging_camera import flown_mission

LARGE_NBYTES = 16_640_000
"""Of a file that is sent in two parts."""


def check_a_mission_is_copied_verified_and_processed(address: str, folder: Path) -> None:
    """Copy a mission with a large file, verify it, process it, and find all of it complete.

    Args:
        address: of an empty folder in the store.
        folder: for the mission.
    """
    mission = flown_mission(folder / "flown", (1, 2))
    (mission.export_dir / "large.bin").write_bytes(bytes(range(256)) * (LARGE_NBYTES // 256))
    report = transfer_to_store(mission, ObjectStore(address))
    stored = ObjectStore(report.target)
    assert verify_in_store(stored).problems == ()
    assert transfer_to_store(mission, ObjectStore(address)).copied == 0
    done = CliRunner().invoke(app, ["process", stored.url, "--processes", "0", "--json"])
    assert done.exit_code == 0, (done.output, done.exception)
    assert json.loads(done.stdout)["done"] == 2
    assert verify_in_store(stored).problems == ()
    again = CliRunner().invoke(app, ["process", stored.url, "--processes", "0", "--json"])
    assert json.loads(again.stdout)["complete_before"] == 2


def check_of_many_writers_of_a_key_one_commits(address: str) -> None:
    """Commit one key from eight threads, and write one small object twice.

    Args:
        address: of an empty folder in the store.
    """
    stored, key = ObjectStore(f"{address}/m"), "a" * 64
    manifest, _ = publish_stored(stored, 1, key, {"quality.json": [b"{}"]})
    with ThreadPoolExecutor(8) as pool:
        committed = list(
            pool.map(lambda n: commit_stored(stored, 1, manifest, {"host": str(n)}), range(8))
        )
    assert committed.count(True) == 1 and is_stored(stored, 1, key)
    assert stored.create_small("x", b"one") is True
    assert stored.create_small("x", b"one") is False
    with pytest.raises(ObjectStoreError, match="another content"):
        stored.create_small("x", b"two")


def check_a_list_has_all_its_pages_and_a_removed_object_is_gone(address: str) -> None:
    """List twelve objects with strange names, and remove one.

    Args:
        address: of an empty folder in the store.
    """
    stored = ObjectStore(address)
    names = [f"L0/{n:06d}/a & b.txt" for n in range(12)]
    for name in names:
        stored.replace_small(name, name.encode())
    assert [one.name for one in stored.list_objects("L0")] == names
    stored.delete(names[3])
    assert stored.find(names[3]) is None and len(stored.list_objects()) == 11
