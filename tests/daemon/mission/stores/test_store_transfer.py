"""A mission arrives whole in an S3 bucket, whatever its requests meet, or the source stays."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import boto3
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.layout import Mission
from daemon.mission.transfer import object_store, transfer_removal
from daemon.mission.transfer.object_store import ObjectStore, ObjectStoreError
from daemon.mission.transfer.store_transfer import finish_store_transfer, transfer_to_store
from daemon.mission.transfer.store_verification import (
    check_store_copy,
    read_store_manifest,
    verify_in_store,
)
from daemon.mission.transfer.transfer_manifest import EXCLUDED_FILES, TransferError
from daemon.mission.transfer.transfer_removal import removing_path
from tests.daemon.mission.stores.faulty_s3 import BUCKET, REGION, Faults
from tests.daemon.small_camera import fly, new_mission

pytestmark = [pytest.mark.peer, pytest.mark.trust]


def client():
    """The vendor's own client, with the endpoint of the environment."""
    return boto3.client("s3", region_name=REGION)


def objects(mission_id: str) -> dict[str, bytes]:
    """What the bucket holds, read by the vendor's client."""
    found, prefix = {}, f"missions/{mission_id}/"
    for page in client().get_paginator("list_objects_v2").paginate(Bucket=BUCKET, Prefix=prefix):
        for one in page.get("Contents", ()):
            body = client().get_object(Bucket=BUCKET, Key=one["Key"])["Body"].read()
            found[one["Key"].removeprefix(prefix)] = body
    return found


def files_of(mission: Mission) -> dict[str, bytes]:
    return {
        path.relative_to(mission.path).as_posix(): path.read_bytes()
        for path in sorted(mission.path.rglob("*"))
        if path.is_file() and path.name not in EXCLUDED_FILES
    }


def without_manifest(found: dict[str, bytes]) -> dict[str, bytes]:
    return {name: data for name, data in found.items() if name != "transfer.json"}


def test_every_byte_arrives_and_the_copy_verifies(mission: Mission, store) -> None:
    url, steps = store(), []
    report = transfer_to_store(mission, ObjectStore(url), progress=lambda *at: steps.append(at))
    files = files_of(mission)
    assert without_manifest(objects(mission.id)) == files
    assert report.copied == len(files) and report.already_present == 0
    assert steps[-1] == (3 * report.nbytes, 3 * report.nbytes)
    verified = verify_in_store(ObjectStore(f"{url}/{mission.id}"))
    assert verified.problems == () and (verified.exposures, verified.frames) == (8, 24)
    again = transfer_to_store(mission, ObjectStore(url))
    assert again.copied == 0 and again.already_present == len(files)
    assert mission.path.exists()


def test_one_request_of_twenty_fails_and_each_byte_is_sent_at_most_1_1_times(
    mission: Mission, store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(object_store, "REQUEST_TIMEOUT_S", 1.0)
    for number in range(80):
        (mission.export_dir / f"{number}.bin").write_bytes(bytes([number]) * 100_000)
    kinds = ("500", "503", "lost answer", "truncated", "hang")
    faults = Faults(every=20, kinds=kinds, hang_s=1.5)
    url = store(faults)
    report = transfer_to_store(mission, ObjectStore(url))
    assert set(faults.counts) == set(kinds) and sum(faults.counts.values()) > 15
    faults.every = 0
    assert without_manifest(objects(mission.id)) == files_of(mission)
    sent = sum(n for path, n in faults.sent.items() if not path.endswith("transfer.json"))
    assert 1.02 * report.nbytes < sent <= 1.1 * report.nbytes, sent / report.nbytes
    assert verify_in_store(ObjectStore(f"{url}/{mission.id}")).problems == ()


@pytest.mark.parametrize("seed", [1, 2])
def test_one_request_of_four_fails_and_the_copy_is_right(
    mission: Mission, store, seed: int
) -> None:
    faults = Faults({"500": 0.1, "503": 0.1, "lost answer": 0.1, "truncated": 0.2}, seed=seed)
    url = store(faults)
    transfer_to_store(mission, ObjectStore(url))
    assert sum(faults.counts.values()) > 20
    faults.shares = {}
    assert without_manifest(objects(mission.id)) == files_of(mission)


def test_a_large_file_goes_in_parts_of_at_most_16_mb(mission: Mission, store) -> None:
    data = bytes(range(256)) * (40_000_000 // 256)
    (mission.export_dir / "large.bin").write_bytes(data)
    faults = Faults()
    url = store(faults)
    faults.is_for = lambda method, path: method == "PUT" and path.endswith("large.bin")
    transfer_to_store(mission, ObjectStore(url))
    assert objects(mission.id)["export/large.bin"] == data
    assert 5_000_000 < faults.largest <= 16_000_000
    sent = faults.sent[f"/{BUCKET}/missions/{mission.id}/export/large.bin"]
    assert sent == len(data)


def test_an_answer_lost_after_each_completed_upload_is_no_error(mission: Mission, store) -> None:
    (mission.export_dir / "large.bin").write_bytes(b"\x07" * 20_000_000)
    completed: set[str] = set()

    def is_first_completion(method: str, path: str) -> bool:
        # POST begins and completes an upload in parts: both answers are lost once.
        is_first = method == "POST" and path not in completed
        completed.add(path) if is_first else None
        return is_first

    faults = Faults({"lost answer": 1.0})
    url = store(faults)
    faults.is_for = is_first_completion
    transfer_to_store(mission, ObjectStore(url))
    assert faults.counts["lost answer"] == 1
    assert objects(mission.id)["export/large.bin"] == b"\x07" * 20_000_000


def test_interrupted_at_any_file_it_continues_where_it_stopped(
    mission: Mission, store, monkeypatch: pytest.MonkeyPatch
) -> None:
    faults = Faults()
    url, real, count = store(faults), ObjectStore.put, 0

    def put_some_and_fail(self, name, *arguments):
        nonlocal count
        count += 1
        if count % 9 == 0:
            raise ObjectStoreError(f"{name}: connection refused")
        real(self, name, *arguments)

    monkeypatch.setattr(ObjectStore, "put", put_some_and_fail)
    attempts = 0
    while attempts < 30:
        attempts += 1
        try:
            transfer_to_store(mission, ObjectStore(url))
            break
        except ObjectStoreError:
            assert mission.path.exists()
            note = read_store_manifest(ObjectStore(f"{url}/{mission.id}"))
            assert note is None or note.state == "copying"
    assert 3 < attempts < 30
    assert without_manifest(objects(mission.id)) == files_of(mission)
    nbytes = sum(map(len, files_of(mission).values()))
    sent = sum(n for path, n in faults.sent.items() if not path.endswith("transfer.json"))
    assert sent == nbytes, "nothing that had arrived was sent again"


def plant(mission: Mission, name: str, data: bytes | None) -> None:
    key = f"missions/{mission.id}/{name}"
    if data is None:
        client().delete_object(Bucket=BUCKET, Key=key)
    else:
        client().put_object(Bucket=BUCKET, Key=key, Body=data)


@pytest.mark.parametrize(
    ("name", "change", "sentence"),
    [
        ("L0/000002/SU00.tif", lambda d: d[:-2] + b"\x00\x01", "was changed"),
        ("L0/000002/SU00.tif", lambda d: d[:-2], "bytes"),
        ("L0/000002/SU00.tif", lambda _d: None, "is missing"),
        ("L0/000003/exposure.json", lambda d: d.replace(b"4000", b"4001"), "was changed"),
        ("mission.json", lambda d: d + b" ", "bytes"),
        ("notes.txt", lambda _d: b"x", "was not written by a transfer"),
    ],
)
def test_verify_names_each_object_that_is_not_what_was_stored(
    mission: Mission, store, name: str, change, sentence: str
) -> None:
    url = store()
    transfer_to_store(mission, ObjectStore(url))
    plant(mission, name, change(files_of(mission).get(name, b"")))
    done = CliRunner().invoke(app, ["verify", f"{url}/{mission.id}", "--json"])
    assert done.exit_code == 1
    problems = json.loads(done.stdout)["problems"]
    assert len(problems) == 1 and name in problems[0] and sentence in problems[0], problems


def test_a_forged_manifest_does_not_hide_an_exchanged_frame(mission: Mission, store) -> None:
    url = store()
    transfer_to_store(mission, ObjectStore(url))
    there = objects(mission.id)
    manifest = json.loads(there["transfer.json"])
    files = manifest["files"]
    other = there["L0/000004/SU00.tif"]
    files["L0/000002/SU00.tif"] = files["L0/000004/SU00.tif"]
    plant(mission, "L0/000002/SU00.tif", other)
    plant(mission, "transfer.json", json.dumps(manifest).encode())
    found = verify_in_store(ObjectStore(f"{url}/{mission.id}")).problems
    assert len(found) == 1 and "differs from the hash in its record" in found[0]


def forged(mission: Mission, state: str, names: set[str] | None = None) -> None:
    """Write null in the place of hashes of the manifest in the store, with a state."""
    manifest = json.loads(objects(mission.id)["transfer.json"])
    manifest["state"] = state
    for name, file in manifest["files"].items():
        if names is None or name in names:
            file["sha256"] = None
    plant(mission, "transfer.json", json.dumps(manifest).encode())


@pytest.mark.parametrize("state", ["complete", "sealed"])
def test_a_verified_manifest_without_hashes_hides_no_exchanged_frame(
    mission: Mission, store, state: str
) -> None:
    url, name = store(), "L0/000002/SU00.tif"
    transfer_to_store(mission, ObjectStore(url))
    other = objects(mission.id)["L0/000004/SU00.tif"]
    plant(mission, name, other)
    forged(mission, state, {name})
    done = CliRunner().invoke(app, ["verify", f"{url}/{mission.id}"])
    assert done.exit_code != 0 and "is damaged" in str(done.exception)
    for options in ([], ["--remove-source"]):
        again = CliRunner().invoke(app, ["transfer", str(mission.path), url, *options])
        assert again.exit_code != 0 and mission.path.exists()


def test_a_sealed_manifest_without_any_hash_does_not_end_a_removal(
    mission: Mission, store, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = store()
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(transfer_removal, "finish_removal", _interrupted)
        transfer_to_store(mission, ObjectStore(url), remove_source=True)
    removing = removing_path(mission.path)
    forged(mission, "sealed")
    plant(mission, "L0/000002/SU00.tif", objects(mission.id)["L0/000004/SU00.tif"])
    with pytest.raises(TransferError, match="damaged"):
        finish_store_transfer(mission.path, ObjectStore(url))
    assert (removing / "L0/000002/SU00.tif").exists()


def _interrupted(*_arguments: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("is_sealed", [True, False])
def test_a_copy_whose_frames_are_not_those_of_their_records_is_refused(
    mission: Mission, store, is_sealed: bool
) -> None:
    url, name = store(), "L0/000002/SU00.tif"
    transfer_to_store(mission, ObjectStore(url))
    there = objects(mission.id)
    manifest = json.loads(there["transfer.json"])
    manifest["files"][name] = manifest["files"]["L0/000004/SU00.tif"]
    plant(mission, name, there["L0/000004/SU00.tif"])
    if not is_sealed:
        plant(mission, "L0/000002/exposure.json", None)
        del manifest["files"]["L0/000002/exposure.json"]
    plant(mission, "transfer.json", json.dumps(manifest).encode())
    target = ObjectStore(f"{url}/{mission.id}")
    note = read_store_manifest(target)
    assert note is not None
    with pytest.raises(TransferError, match=f"{name}: differs from the hash in its record"):
        check_store_copy(target, note, lambda _count: None)


def test_an_unverified_frame_of_a_copy_in_progress_is_compared_with_its_record(
    mission: Mission, store
) -> None:
    url, name = store(), "L0/000002/SU00.tif"
    transfer_to_store(mission, ObjectStore(url))
    plant(mission, name, objects(mission.id)["L0/000004/SU00.tif"])
    forged(mission, "copying", {name})
    problems = verify_in_store(ObjectStore(f"{url}/{mission.id}")).problems
    assert len(problems) == 2 and "not complete" in problems[0]
    assert problems[1] == f"{name}: differs from the hash in its record"


def test_the_source_goes_only_after_a_sealed_copy_that_was_read_back(
    mission: Mission, store
) -> None:
    url, files = store(), files_of(mission)
    done = CliRunner().invoke(
        app, ["transfer", str(mission.path), url, "--remove-source", "--json"]
    )
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["source_removed"] and not mission.path.exists()
    assert without_manifest(objects(mission.id)) == files
    note = read_store_manifest(ObjectStore(f"{url}/{mission.id}"))
    assert note is not None and note.state == "sealed"
    # The same command again confirms, and finds what was lost since.
    again = CliRunner().invoke(app, ["transfer", str(mission.path), url, "--json"])
    assert again.exit_code == 0, again.output
    plant(mission, "L0/000001/SU00.tif", None)
    lost = CliRunner().invoke(app, ["transfer", str(mission.path), url, "--json"])
    assert lost.exit_code == 1


def test_a_store_that_changes_what_it_was_sent_keeps_the_source(
    mission: Mission, store, monkeypatch: pytest.MonkeyPatch
) -> None:
    url, real = store(), ObjectStore.put

    def put_other(self, name, blocks, nbytes, sha256):
        if name.endswith("SU10.tif"):
            data = b"".join(blocks())
            return real(self, name, lambda: iter([data[:-1] + b"!"]), nbytes, sha256)
        return real(self, name, blocks, nbytes, sha256)

    monkeypatch.setattr(ObjectStore, "put", put_other)
    with pytest.raises(TransferError, match="read back differently"):
        transfer_to_store(mission, ObjectStore(url), remove_source=True)
    assert mission.path.exists() and len(files_of(mission)) > 24
    note = read_store_manifest(ObjectStore(f"{url}/{mission.id}"))
    assert note is not None and note.state == "copying"


def test_a_removal_killed_half_way_ends_only_with_an_intact_copy(
    mission: Mission, store, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = store()

    def killed(*_arguments: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(transfer_removal, "finish_removal", killed)
        transfer_to_store(mission, ObjectStore(url), remove_source=True)
    removing = removing_path(mission.path)
    assert removing.is_dir() and not mission.path.exists()
    frame = objects(mission.id)["L0/000001/SU00.tif"]
    plant(mission, "L0/000001/SU00.tif", frame[:-1])
    with pytest.raises(TransferError, match="kept"):
        finish_store_transfer(mission.path, ObjectStore(url))
    with pytest.raises(TransferError, match="not the sealed copy"):
        finish_store_transfer(mission.path, ObjectStore(f"s3://{BUCKET}/elsewhere"))
    assert (removing / "L0/000001/SU00.tif").read_bytes() == frame
    plant(mission, "L0/000001/SU00.tif", frame)
    done = finish_store_transfer(mission.path, ObjectStore(url))
    assert done is not None and done.source_removed and not removing.exists()


def test_a_damaged_source_is_not_copied_over_a_good_copy(mission: Mission, store) -> None:
    url = store()
    transfer_to_store(mission, ObjectStore(url))
    before = objects(mission.id)
    frame = mission.path / "L0/000001/SU00.tif"
    frame.chmod(0o644)
    data = frame.read_bytes()
    frame.write_bytes(data[:-2] + b"\x00\x00")
    with pytest.raises(TransferError, match="syntopic verify"):
        transfer_to_store(mission, ObjectStore(url))
    assert objects(mission.id) == before


def test_another_mission_of_the_same_name_and_foreign_objects_are_refused(
    mission: Mission, store, tmp_path: Path
) -> None:
    url = store()
    plant(mission, "holiday.jpg", b"x")
    with pytest.raises(TransferError, match="not written by a transfer"):
        transfer_to_store(mission, ObjectStore(url))
    plant(mission, "holiday.jpg", None)
    transfer_to_store(mission, ObjectStore(url))
    before = objects(mission.id)
    other = new_mission(tmp_path / "other", datetime(2026, 11, 21, 10, 16, tzinfo=UTC))
    fly(other, [1])
    renamed = other.path.with_name(mission.id)
    other.path.rename(renamed)
    with pytest.raises(TransferError):
        transfer_to_store(Mission.open(renamed), ObjectStore(url))
    assert objects(mission.id) == before


@pytest.mark.parametrize(
    ("url", "sentence"),
    [
        ("s3://", "write it as"),
        ("ftp://host/x", "s3://"),
        ("s3://bucket?x=1", "write it as"),
        ("s3://no-such-bucket/x", "Check the network"),
    ],
)
def test_an_address_that_cannot_serve_is_refused_in_a_sentence(
    mission: Mission, store, url: str, sentence: str
) -> None:
    store()
    done = CliRunner().invoke(app, ["transfer", str(mission.path), url])
    assert done.exit_code != 0 and sentence in str(done.exception), done.exception
    assert mission.path.exists()


def test_a_server_that_does_not_answer_ends_in_a_sentence(
    mission: Mission, store, monkeypatch: pytest.MonkeyPatch
) -> None:
    store()
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setattr(object_store, "RETRIES", 1)
    monkeypatch.setattr(object_store, "READ_ATTEMPTS", 2)
    with pytest.raises(ObjectStoreError, match="Check the network"):
        transfer_to_store(mission, ObjectStore(f"s3://{BUCKET}/missions"))


def test_a_file_address_is_the_folder(mission: Mission, tmp_path: Path) -> None:
    done = CliRunner().invoke(
        app, ["transfer", str(mission.path), f"file://{tmp_path}/a%20disk", "--json"]
    )
    assert done.exit_code == 0, done.output
    assert (tmp_path / "a disk" / mission.id / "transfer.json").exists()
