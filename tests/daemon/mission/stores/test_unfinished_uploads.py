"""Uploads that a killed command left in a bucket are found and aborted, and no others."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

import obstore
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.layout import Mission
from daemon.mission.transfer import s3_requests, s3_uploads, store_requests
from daemon.mission.transfer.object_store import ObjectStore
from daemon.mission.transfer.s3_requests import Credentials, S3Folder, signed_headers
from daemon.mission.transfer.s3_uploads import abort_unfinished
from daemon.mission.transfer.store_requests import StoreAnswer
from daemon.mission.transfer.store_transfer import transfer_to_store
from tests.daemon.mission.stores.faulty_s3 import BUCKET, Faults
from tests.daemon.mission.stores.test_store_transfer import client

pytestmark = [pytest.mark.peer, pytest.mark.trust]

Start = Callable[..., str]


def begun(name: str) -> str:
    """An upload with one part, as a process leaves it that is killed."""
    key = f"missions/{name}"
    upload = client().create_multipart_upload(Bucket=BUCKET, Key=key)["UploadId"]
    client().upload_part(Bucket=BUCKET, Key=key, UploadId=upload, PartNumber=1, Body=b"x" * 1000)
    return str(upload)


def unfinished() -> list[str]:
    """What the vendor's client lists."""
    found = client().list_multipart_uploads(Bucket=BUCKET).get("Uploads", ())
    return sorted(str(one["Key"]).removeprefix("missions/") for one in found)


def test_a_later_run_aborts_the_uploads_of_its_mission_and_leaves_all_others(
    mission: Mission, store: Start
) -> None:
    url = store()
    foreign = [f"{mission.id}/notes.bin", f"{mission.id}2/L0/000001/SU00.tif", "other/x"]
    own = [f"{mission.id}/L0/000001/SU00.tif", f"{mission.id}/processed/L2/000001/a/pan.tif"]
    for name in (*foreign, *own, own[0]):
        begun(name)
    done = CliRunner().invoke(app, ["transfer", str(mission.path), url, "--json"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)["unfinished_uploads"]
    names = sorted(name.removeprefix(f"{mission.id}/") for name in (*own, own[0]))
    assert sorted(found["aborted"]) == names and found["recent"] == [] and not found["problem"]
    assert "3 unfinished uploads of an earlier run were aborted." in done.stderr
    assert unfinished() == sorted(foreign)


def test_an_upload_younger_than_an_hour_is_named_and_left(
    mission: Mission, store: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    url, name = store(), "L0/000001/SU00.tif"
    begun(f"{mission.id}/{name}")
    # The server states 2010 for every upload.
    years_s = (datetime.now(UTC) - datetime(2010, 11, 10, tzinfo=UTC)).total_seconds()
    monkeypatch.setattr(s3_uploads, "AGE_MIN_S", years_s + 3600)
    report = transfer_to_store(mission, ObjectStore(url))
    assert report.uploads.recent == (name,) and report.uploads.aborted == ()
    assert "are left" in report.uploads.sentence
    assert unfinished() == [f"{mission.id}/{name}"]
    monkeypatch.setattr(s3_uploads, "AGE_MIN_S", years_s - 2 * 86400)
    assert transfer_to_store(mission, ObjectStore(url)).uploads.aborted == (name,)
    assert unfinished() == []


def test_the_age_is_by_the_clock_of_the_store(
    mission: Mission, store: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clock here that is years ahead aborts no upload that began a minute ago."""
    url = store()
    begun(f"{mission.id}/x")

    class Ahead(datetime):
        @classmethod
        def now(cls, tz: object = None) -> Ahead:
            return cls(2099, 1, 1, tzinfo=UTC)

    years_s = (datetime.now(UTC) - datetime(2010, 11, 10, tzinfo=UTC)).total_seconds()
    monkeypatch.setattr(s3_uploads, "AGE_MIN_S", years_s + 3600)
    monkeypatch.setattr(store_requests, "datetime", Ahead)
    monkeypatch.setattr(s3_requests, "datetime", Ahead)
    assert abort_unfinished(f"{url}/{mission.id}", lambda _name: True).recent == ("x",)


def test_more_uploads_than_one_answer_holds_are_all_aborted(
    store: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = store()
    names = [f"many/{number}" for number in range(5)]
    for name in names:
        begun(name)
    asked: list[dict[str, str]] = []
    real = S3Folder.request

    def two_at_a_time(self: S3Folder, method: str, name: str | None, query):
        answer = real(self, method, name, query)
        if method != "GET":
            return answer
        asked.append(dict(query))
        after = int(query.get("upload-id-marker", "0"))
        uploads = [f"<Upload>{one}" for one in answer.content.decode().split("<Upload>")[1:]]
        uploads = [one.partition("</Upload>")[0] + "</Upload>" for one in uploads]
        is_cut = after + 2 < len(uploads)
        marks = (
            f"<NextKeyMarker>k</NextKeyMarker><NextUploadIdMarker>{after + 2}</NextUploadIdMarker>"
        )
        text = "".join(uploads[after : after + 2]) + (marks if is_cut else "")
        content = f"<R><IsTruncated>{str(is_cut).lower()}</IsTruncated>{text}</R>".encode()
        return StoreAnswer(content, answer.now)

    monkeypatch.setattr(S3Folder, "request", two_at_a_time)
    assert len(abort_unfinished(url, lambda _name: True).aborted) == 5
    assert len(asked) == 3 and unfinished() == []


def test_a_server_that_lists_all_uploads_of_the_bucket_aborts_those_of_the_folder(
    store: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    url, real = store(), S3Folder.request
    for name in ("one/x", "one2/x", "two/x"):
        begun(name)

    def unfiltered(self: S3Folder, method: str, name: str | None, query):
        return real(self, method, name, {**query, "prefix": ""} if name is None else query)

    monkeypatch.setattr(S3Folder, "request", unfiltered)
    assert abort_unfinished(f"{url}/one", lambda _name: True).aborted == ("x",)
    assert unfinished() == ["one2/x", "two/x"]


@pytest.mark.parametrize("code", ["AccessDenied", "RequestTimeTooSkewed"])
def test_a_user_without_the_right_copies_all_the_same_and_reads_the_cure(
    mission: Mission, store: Start, code: str
) -> None:
    faults = Faults()
    url = store(faults)
    faults.is_for = lambda method, path: method == "GET" and path == f"/{BUCKET}"
    begun(f"{mission.id}/L0/000001/SU00.tif")
    transfer_to_store(mission, ObjectStore(url))
    begun(f"{mission.id}/L0/000001/SU00.tif")
    real = S3Folder.request

    def refused(*arguments):
        faults.kinds, faults.every = (code,), 1
        try:
            return real(*arguments)
        finally:
            faults.every = 0

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(S3Folder, "request", refused)
        report = transfer_to_store(mission, ObjectStore(url))
    assert report.already_present > 10 and report.uploads.aborted == ()
    assert "s3:ListBucketMultipartUploads" in report.uploads.problem
    assert faults.counts[code] == 1  # a refusal is not asked again
    assert unfinished() == [f"{mission.id}/L0/000001/SU00.tif"]


def test_a_server_that_fails_at_first_is_asked_again(store: Start) -> None:
    faults = Faults()
    url = store(faults)
    begun("a/b")
    failed: list[str] = []

    def first_two(method: str, path: str) -> bool:
        failed.append(path)
        return len(failed) <= 2

    faults.is_for, faults.kinds, faults.every = first_two, ("503",), 1
    assert abort_unfinished(f"{url}/a", lambda _name: True).aborted == ("b",)
    assert faults.counts["503"] == 2


@pytest.mark.parametrize("answer", [b"", b"<x", b"<R><Upload><Key>missions/a</Key></Upload></R>"])
def test_an_answer_that_is_no_list_of_uploads_aborts_nothing(
    store: Start, monkeypatch: pytest.MonkeyPatch, answer: bytes
) -> None:
    url = store()
    begun("a")
    content = StoreAnswer(answer, datetime.now(UTC))
    monkeypatch.setattr(S3Folder, "request", lambda *_: content)
    found = abort_unfinished(url, lambda _name: True)
    assert found.aborted == () and "could not be listed" in found.problem
    assert unfinished() == ["a"]


def test_an_upload_aborted_by_another_run_is_begun_again(
    store: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error is that of S3; the emulated store answers 500 instead."""
    place, put, calls = ObjectStore(store()), obstore.put, list[str]()

    def aborted_first(target: Any, name: str, *args: Any, **options: Any) -> Any:
        calls.append(name)
        if len(calls) == 1:
            raise obstore.exceptions.NotFoundError("404 Not Found: <Code>NoSuchUpload</Code>")
        return put(target, name, *args, **options)

    monkeypatch.setattr(obstore, "put", aborted_first)
    parts = [b"\x01" * 16_000_000, b"\x02" * 1_000_000]
    place.put("large.bin", lambda: iter(parts), 17_000_000, "not compared")
    assert len(calls) == 2 and place.read("large.bin", 17_000_000) == b"".join(parts)
    assert unfinished() == []


def test_a_process_in_the_store_aborts_what_a_killed_one_left_of_its_products(
    mission: Mission, store: Start
) -> None:
    url = store()
    transfer_to_store(mission, ObjectStore(url))
    begun(f"{mission.id}/processed/L2/000001/{'a' * 64}/pan.tif")
    begun(f"{mission.id}/L0/000001/SU00.tif")  # of a transfer that may run now
    done = CliRunner().invoke(
        app, ["process", f"{url}/{mission.id}", "--only", "1", "--processes", "0", "--json"]
    )
    assert "1 unfinished uploads of an earlier run were aborted." in done.stderr, done.output
    assert unfinished() == [f"{mission.id}/L0/000001/SU00.tif"]


def test_without_an_access_key_a_sentence_states_that_none_were_looked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("AWS_ACCESS_KEY_ID", raising=False)
    assert "were not looked for" in abort_unfinished("s3://b/m", lambda _name: True).problem
    assert abort_unfinished("az://b/m", lambda _name: True).sentence == ""


def test_a_key_is_never_sent_without_tls_unless_permitted(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {
        "AWS_ACCESS_KEY_ID": "k",
        "AWS_SECRET_ACCESS_KEY": "s",
        "AWS_ENDPOINT_URL": "http://127.0.0.1:9",
    }.items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("AWS_ALLOW_HTTP", raising=False)
    assert "has no TLS" in abort_unfinished("s3://b/m", lambda _name: True).problem


@pytest.mark.parametrize("token", ["", "session/+="])
@pytest.mark.parametrize(
    ("method", "path", "query"),
    [
        ("GET", "", {"uploads": "", "prefix": "a b/ü&x=1"}),
        ("DELETE", "/missions/m%20x/L0/SU00.tif", {"uploadId": "a/b+c=="}),
    ],
)
def test_the_signature_is_that_of_the_vendor(
    method: str, path: str, query: dict[str, str], token: str
) -> None:
    from botocore.auth import S3SigV4Auth
    from botocore.awsrequest import AWSRequest
    from botocore.credentials import Credentials as Peer

    url, now = f"https://s3.eu-central-1.amazonaws.com/survey{path}", datetime.now(UTC)
    own = signed_headers(
        method, url, query, Credentials("AK", "se/cret", token), region="eu-central-1", now=now
    )
    peer = AWSRequest(method=method, url=f"{url}?{s3_requests.query_text(query)}")
    peer.headers["X-Amz-Content-SHA256"] = own["x-amz-content-sha256"]
    peer.context["timestamp"] = own["x-amz-date"]
    signer = S3SigV4Auth(Peer("AK", "se/cret", token or None), "s3", "eu-central-1")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("botocore.auth.get_current_datetime", lambda *_a, **_k: now)
        signer.add_auth(peer)
    assert (
        peer.headers["Authorization"].rpartition("Signature=")[2]
        == (own["authorization"].rpartition("Signature=")[2])
    )
