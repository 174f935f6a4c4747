"""What every kind of store has to do; the tests of each kind call it with an address."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.transfer import object_store, part_sender, store_transfer
from daemon.mission.transfer.object_store import ObjectStore, ObjectStoreError
from daemon.mission.transfer.store_products import commit_stored, is_stored, publish_stored
from daemon.mission.transfer.store_transfer import StoreTransferReport, transfer_to_store
from daemon.mission.transfer.store_verification import verify_in_store
from tests.daemon.diverging_camera import ROOT, flown_mission
from tests.daemon.small_camera import fly, new_mission

LARGE_NBYTES = 16_640_000
"""Of a file that is sent in two parts."""
SMALL_PART_NBYTES = 600_000
KILLED_TRANSFER = f"""
import os, signal, urllib.request
from daemon.mission.transfer import object_store, part_sender, store_transfer
for module in (object_store, part_sender, store_transfer):
    module.PART_BYTES = {SMALL_PART_NBYTES}
real, parts = urllib.request.urlopen, []
def until_the_third_part(asked, **options):
    if len(asked.data or b"") == {SMALL_PART_NBYTES}:
        parts.append(asked)
        if len(parts) == 3:
            os.kill(os.getpid(), signal.SIGKILL)
    return real(asked, **options)
urllib.request.urlopen = until_the_third_part
from daemon.cli import app
app()
"""


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


def check_a_killed_transfer_continues_at_its_part(
    address: str, folder: Path
) -> StoreTransferReport:
    """Kill a transfer at the third part of a file, and run it again.

    Args:
        address: of an empty folder in the store.
        folder: for the mission.
    """
    mission, name = new_mission(folder / "flown"), "export/a & b.bin"
    fly(mission, range(1, 2))
    content = b"".join(bytes([number]) * SMALL_PART_NBYTES for number in range(1, 6))[:-1000]
    (mission.path / name).write_bytes(content)
    command = [sys.executable, "-c", KILLED_TRANSFER, "transfer", str(mission.path), address]
    killed = subprocess.run(command, cwd=ROOT, capture_output=True, timeout=100)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    stored = ObjectStore(f"{address}/{mission.id}")
    assert stored.find(name) is None
    with pytest.MonkeyPatch.context() as patched:
        for module in (object_store, part_sender, store_transfer):
            patched.setattr(module, "PART_BYTES", SMALL_PART_NBYTES)
        report = transfer_to_store(mission, ObjectStore(address))
    assert report.uploads.continued == (name,) and report.uploads.problem == ""
    assert SMALL_PART_NBYTES <= report.uploads.reused_nbytes <= 2 * SMALL_PART_NBYTES
    assert stored.read(name, len(content)) == content
    assert verify_in_store(stored).problems == ()
    return report
