"""A mission in Google Cloud Storage, over the XML API, with requests that fail."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.mission.transfer.object_store import ObjectStore, ObjectStoreError
from daemon.mission.transfer.s3_uploads import abort_unfinished
from daemon.mission.transfer.store_transfer import transfer_to_store
from tests.daemon.mission.stores.faulty_s3 import Faults
from tests.daemon.mission.stores.gcs_server import GcsBucket, serving_gcs
from tests.daemon.mission.stores.store_behaviour import (
    check_a_killed_transfer_continues_at_its_part,
    check_a_list_has_all_its_pages_and_a_removed_object_is_gone,
    check_a_mission_is_copied_verified_and_processed,
    check_of_many_writers_of_a_key_one_commits,
)
from tests.daemon.small_camera import fly, new_mission

pytestmark = pytest.mark.trust

PLACE = "gs://survey/missions"


@pytest.fixture
def bucket() -> GcsBucket:
    return GcsBucket("survey")


@pytest.fixture
def faults() -> Faults:
    return Faults()


@pytest.fixture
def place(bucket: GcsBucket, faults: Faults, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Address of a folder in the bucket."""
    pytest.importorskip("obstore", reason="pip install 'syntopic[stores]'")
    pytest.importorskip("moto.server")
    with serving_gcs(bucket, faults) as endpoint:
        account = {
            "gcs_base_url": endpoint, "disable_oauth": True, "client_email": "",
            "private_key": "", "private_key_id": "",
        }  # fmt: skip
        monkeypatch.setenv("GOOGLE_SERVICE_ACCOUNT_KEY", json.dumps(account))
        monkeypatch.setenv("GOOGLE_ALLOW_HTTP", "true")
        monkeypatch.setenv("GOOGLE_BASE_URL", endpoint)
        yield PLACE


@pytest.fixture
def hmac_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GS_ACCESS_KEY_ID", "GOOG1E")
    monkeypatch.setenv("GS_SECRET_ACCESS_KEY", "secret")


def test_a_mission_is_copied_verified_and_processed_in_a_bucket(
    place: str, bucket: GcsBucket, faults: Faults, tmp_path: Path
) -> None:
    faults.kinds, faults.every = ("500", "503", "lost answer", "truncated"), 15
    check_a_mission_is_copied_verified_and_processed(place, tmp_path)
    assert not bucket.uploads and faults.largest <= 16_000_000
    assert {"500", "503", "lost answer"} <= faults.counts.keys()


@pytest.mark.usefixtures("hmac_key")
def test_a_killed_transfer_continues_at_its_part(
    place: str, bucket: GcsBucket, faults: Faults, tmp_path: Path
) -> None:
    faults.kinds, faults.every = ("503", "lost answer"), 9
    check_a_killed_transfer_continues_at_its_part(place, tmp_path)
    assert not bucket.uploads and faults.counts["503"]


def test_without_an_hmac_key_the_file_is_sent_again_and_a_sentence_states_it(
    place: str, bucket: GcsBucket, faults: Faults, tmp_path: Path
) -> None:
    mission = new_mission(tmp_path / "flown")
    fly(mission, range(1, 2))
    report = transfer_to_store(mission, ObjectStore(place))
    assert "because GS_ACCESS_KEY_ID is not set" in report.uploads.sentence
    assert "is sent again from its start" in report.uploads.sentence


@pytest.mark.usefixtures("hmac_key")
def test_an_upload_of_another_run_is_aborted_by_its_age(
    place: str, bucket: GcsBucket, tmp_path: Path
) -> None:
    mission = new_mission(tmp_path / "flown")
    fly(mission, range(1, 2))
    own, foreign = f"missions/{mission.id}/L0/000001/SU00.tif", f"missions/{mission.id}/notes"
    bucket.upload_names |= {"7": own, "8": foreign}
    bucket.uploads |= {"7": {}, "8": {1: b"x"}}
    report = transfer_to_store(mission, ObjectStore(place))
    assert report.uploads.aborted == ("L0/000001/SU00.tif",) and list(bucket.uploads) == ["8"]


@pytest.mark.usefixtures("hmac_key")
def test_a_key_is_never_sent_without_tls_unless_permitted(
    place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("GOOGLE_ALLOW_HTTP")
    assert "has no TLS" in abort_unfinished(place, lambda _name: True).problem


def test_of_many_writers_of_a_key_one_commits_in_a_bucket(place: str, faults: Faults) -> None:
    faults.kinds, faults.every = ("500",), 7
    check_of_many_writers_of_a_key_one_commits(place)


def test_a_list_has_all_its_pages_and_a_removed_object_is_gone(
    place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daemon.mission.transfer.object_store.READ_ATTEMPTS", 1)
    check_a_list_has_all_its_pages_and_a_removed_object_is_gone(place)
    with pytest.raises(ObjectStoreError):
        ObjectStore("gs://another/missions").list_objects()
