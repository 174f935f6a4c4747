"""A large file whose transfer was killed is continued at the part where it ended."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest

from daemon.mission.layout import Mission
from daemon.mission.transfer import object_store, part_sender, s3_uploads, store_transfer
from daemon.mission.transfer.object_store import ObjectStore
from daemon.mission.transfer.part_sender import PARTS_IN_WORK
from daemon.mission.transfer.s3_requests import S3Folder
from daemon.mission.transfer.store_requests import StoreAnswer, StoreRefusedError
from daemon.mission.transfer.store_transfer import StoreTransferReport, transfer_to_store
from daemon.mission.transfer.transfer_manifest import TransferError
from tests.daemon.diverging_camera import ROOT
from tests.daemon.mission.stores.faulty_s3 import BUCKET, Faults
from tests.daemon.mission.stores.test_store_transfer import client
from tests.daemon.mission.stores.test_unfinished_uploads import unfinished
from tests.daemon.small_camera import fly, new_mission

pytestmark = [pytest.mark.peer, pytest.mark.trust]

Start = Callable[..., str]
NAME = "export/large.bin"
PARTS = 4
PART_BYTES = 5_300_000
"""A little more than what S3 permits at least."""
LAST_BYTES = 1_000_000


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (object_store, part_sender, store_transfer):
        monkeypatch.setattr(module, "PART_BYTES", PART_BYTES)


@pytest.fixture
def large(tmp_path: Path) -> Mission:
    """A mission with a file of four parts that differ."""
    mission = new_mission(tmp_path / "flown")
    fly(mission, range(1, 2))
    content = b"".join(bytes([number]) * PART_BYTES for number in range(1, PARTS))
    (mission.export_dir / "large.bin").write_bytes(content + b"\x09" * LAST_BYTES)
    return mission


def content_of(mission: Mission) -> bytes:
    return (mission.export_dir / "large.bin").read_bytes()


def key_of(mission: Mission) -> str:
    return f"missions/{mission.id}/{NAME}"


def stored(mission: Mission) -> bytes:
    return bytes(client().get_object(Bucket=BUCKET, Key=key_of(mission))["Body"].read())


def begun(mission: Mission, parts: dict[int, bytes]) -> str:
    """An upload with these parts."""
    place = {"Bucket": BUCKET, "Key": key_of(mission)}
    upload = str(client().create_multipart_upload(**place)["UploadId"])
    for number, body in parts.items():
        client().upload_part(**place, UploadId=upload, PartNumber=number, Body=body)
    return upload


def transferred(mission: Mission, url: str) -> StoreTransferReport:
    steps: list[tuple[int, int]] = []
    report = transfer_to_store(mission, ObjectStore(url), progress=lambda *at: steps.append(at))
    if not report.already_present:
        assert steps[-1] == (3 * report.nbytes, 3 * report.nbytes)
    return report


TRANSFER = f"""
from daemon.mission.transfer import object_store, part_sender, store_transfer
for module in (object_store, part_sender, store_transfer):
    module.PART_BYTES = {PART_BYTES}
from daemon.cli import app
app()
"""


@pytest.mark.timeout(120)
def test_after_a_kill_only_parts_that_were_in_work_are_sent_again(
    large: Mission, store: Start
) -> None:
    faults = Faults()
    url, killed = store(faults), list[str]()
    command = [sys.executable, "-c", TRANSFER, "transfer", str(large.path), url]
    child = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL)

    def kill_at_the_third_part(method: str, path: str) -> bool:
        if method == "PUT" and path.endswith(NAME):
            killed.append(path)
            if len(killed) == 3:
                os.kill(child.pid, signal.SIGKILL)
        return False

    faults.is_for = kill_at_the_third_part
    assert child.wait(60) == -signal.SIGKILL
    assert unfinished() == [f"{large.id}/{NAME}"]
    report = transferred(large, url)
    assert report.uploads.continued == (NAME,) and report.uploads.aborted == ()
    assert report.uploads.reused_nbytes >= PART_BYTES
    assert "1 unfinished uploads of an earlier run were continued; " in report.uploads.sentence
    assert stored(large) == content_of(large) and unfinished() == []
    sent, nbytes = faults.sent[f"/{BUCKET}/{key_of(large)}"], len(content_of(large))
    assert sent <= nbytes + PARTS_IN_WORK * PART_BYTES
    assert sent == nbytes or sent + report.uploads.reused_nbytes > nbytes


def test_parts_that_differ_from_the_file_are_sent_again(large: Mission, store: Start) -> None:
    faults = Faults()
    url, content = store(faults), content_of(large)
    begun(
        large,
        {
            1: b"\x02" * PART_BYTES,  # of another place
            2: content[PART_BYTES : 2 * PART_BYTES - 1],  # short
            4: content[-LAST_BYTES:],
        },
    )
    faults.sent.clear()
    report = transferred(large, url)
    assert stored(large) == content and unfinished() == []
    assert report.uploads.continued == (NAME,)
    assert report.uploads.reused_nbytes == LAST_BYTES
    assert faults.sent[f"/{BUCKET}/{key_of(large)}"] == len(content) - LAST_BYTES


def test_of_two_uploads_one_is_continued_and_the_other_aborted(
    large: Mission, store: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    url, content = store(), content_of(large)
    real, ages_s = s3_uploads._listed, iter((7200.0, 60.0))
    first = begun(large, {1: content[:PART_BYTES]})
    last = begun(large, {1: content[:PART_BYTES], 4: content[-LAST_BYTES:]})

    def aged(folder: S3Folder) -> list[s3_uploads.Upload]:
        order = sorted(real(folder), key=lambda one: [first, last].index(one.upload_id))
        return [s3_uploads.Upload(one.name, one.upload_id, next(ages_s)) for one in order]

    monkeypatch.setattr(s3_uploads, "_listed", aged)
    report = transferred(large, url)
    assert report.uploads.continued == report.uploads.aborted == (NAME,)
    assert report.uploads.reused_nbytes == PART_BYTES + LAST_BYTES
    assert stored(large) == content and unfinished() == []


def test_an_upload_of_a_file_that_arrived_meanwhile_is_aborted(
    large: Mission, store: Start
) -> None:
    url = store()
    transferred(large, url)
    begun(large, {1: content_of(large)[:PART_BYTES]})
    report = transferred(large, url)
    assert report.uploads.continued == () and report.uploads.aborted == (NAME,)
    assert unfinished() == [] and report.copied == 0


@pytest.mark.parametrize("answer", ["NoSuchUpload", "200 with an error", "no XML"])
def test_an_upload_that_cannot_be_completed_is_begun_again(
    large: Mission, store: Start, monkeypatch: pytest.MonkeyPatch, answer: str
) -> None:
    url, content, real, refused = store(), content_of(large), S3Folder.request, list[str]()
    upload = begun(large, {1: content[:PART_BYTES]})

    def once(self, method, name, query, body=b"", **options):
        if method == "POST" and query.get("uploadId") == upload:
            refused.append(upload)
            if answer == "NoSuchUpload":
                raise StoreRefusedError(404, answer)
            text = b"<Error><Code>InternalError</Code></Error>" if answer[0] == "2" else b"<x"
            return StoreAnswer(text, datetime.now(UTC))
        return real(self, method, name, query, body, **options)

    monkeypatch.setattr(S3Folder, "request", once)
    transfer_to_store(large, ObjectStore(url))
    assert refused == [upload] and stored(large) == content


def test_parts_are_listed_over_several_answers(large: Mission, store: Start) -> None:
    url, content, real = store(), content_of(large), S3Folder.request
    begun(large, {1: content[:PART_BYTES], 4: content[-LAST_BYTES:]})

    def one_at_a_time(self, method, name, query, body=b"", **options):
        is_list = method == "GET" and name is not None
        more = {"max-parts": "1"} if is_list else {}
        return real(self, method, name, {**query, **more}, body, **options)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(S3Folder, "request", one_at_a_time)
        report = transferred(large, url)
    assert report.uploads.reused_nbytes == PART_BYTES + LAST_BYTES and stored(large) == content


def test_without_the_right_to_list_uploads_the_file_is_sent_all_the_same(
    large: Mission, store: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_arguments: object, **_options: object) -> StoreAnswer:
        raise StoreRefusedError(403, "AccessDenied")

    monkeypatch.setattr(S3Folder, "request", refused)
    report = transferred(large, store())
    assert "s3:ListBucketMultipartUploads" in report.uploads.problem
    assert stored(large) == content_of(large)


def test_a_file_that_cannot_be_read_is_named_and_not_sent_again(
    large: Mission, store: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, real = list[int](), os.pread

    def broken(descriptor: int, nbytes: int, offset: int) -> bytes:
        if nbytes not in (PART_BYTES, LAST_BYTES):
            return real(descriptor, nbytes, offset)
        calls.append(offset)
        raise OSError(5, "Input/output error")

    monkeypatch.setattr("daemon.mission.transfer.store_transfer.os.pread", broken)
    with pytest.raises(TransferError, match=r"large.bin cannot be read: Input/output error"):
        transfer_to_store(large, ObjectStore(store()))
    assert len(calls) == len(set(calls))
