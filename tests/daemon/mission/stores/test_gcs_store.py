"""A mission in Google Cloud Storage, over the XML API, with requests that fail."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.mission.transfer.object_store import ObjectStore, ObjectStoreError
from tests.daemon.mission.stores.faulty_s3 import Faults
from tests.daemon.mission.stores.gcs_server import GcsBucket, serving_gcs
from tests.daemon.mission.stores.store_behaviour import (
    check_a_list_has_all_its_pages_and_a_removed_object_is_gone,
    check_a_mission_is_copied_verified_and_processed,
    check_of_many_writers_of_a_key_one_commits,
)

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
        yield PLACE


def test_a_mission_is_copied_verified_and_processed_in_a_bucket(
    place: str, bucket: GcsBucket, faults: Faults, tmp_path: Path
) -> None:
    faults.kinds, faults.every = ("500", "503", "lost answer", "truncated"), 15
    check_a_mission_is_copied_verified_and_processed(place, tmp_path)
    assert not bucket.uploads and faults.largest <= 16_000_000
    assert {"500", "503", "lost answer"} <= faults.counts.keys()


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
