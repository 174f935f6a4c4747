"""A mission in Azure Blob Storage: Azurite, Microsoft's own emulator, as the server.

It runs where the program `azurite-blob` is on the path: npm install -g azurite@3.37.0.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import shutil
import socket
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from email.utils import formatdate
from pathlib import Path

import pytest

from daemon.mission.transfer.object_store import ObjectStore, ObjectStoreError
from tests.daemon.mission.stores.store_behaviour import (
    check_a_killed_transfer_continues_at_its_part,
    check_a_list_has_all_its_pages_and_a_removed_object_is_gone,
    check_a_mission_is_copied_verified_and_processed,
    check_of_many_writers_of_a_key_one_commits,
)

pytestmark = [pytest.mark.peer, pytest.mark.trust, pytest.mark.soak]
ACCOUNT = "devstoreaccount1"
# The well-known key of the emulator, from Microsoft's documentation; no secret.
ACCOUNT_KEY = (
    "Eby8vdM02xNOcqFlqUwJPLlmEtlCDXJ1OUzFT50uSRZ6IFsuFq2UVErCz4I6tq/K1SZFPTOtr/KBHBeksoGMGw=="
)
START_TIMEOUT_S = 60.0


@pytest.fixture
def container(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[str]:
    """Address of an empty container."""
    pytest.importorskip("obstore", reason="pip install 'syntopic[stores]'")
    program = shutil.which("azurite-blob")
    if program is None:
        pytest.skip("azurite-blob is not on the path: npm install -g azurite@3.37.0")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    options = ["--inMemoryPersistence", "--silent", "--disableTelemetry", "--skipApiVersionCheck"]
    with (tmp_path / "azurite.txt").open("wb") as log:
        server = subprocess.Popen(
            [program, "--blobHost", "127.0.0.1", "--blobPort", str(port), *options],
            stdout=log, stderr=log, cwd=tmp_path,
        )  # fmt: skip
    try:
        endpoint = f"http://127.0.0.1:{port}/{ACCOUNT}"
        create_container(endpoint, "survey")
        for name, value in {
            "AZURE_STORAGE_ACCOUNT_NAME": ACCOUNT,
            "AZURE_STORAGE_ACCOUNT_KEY": ACCOUNT_KEY,
            "AZURE_STORAGE_ENDPOINT": endpoint,
            "AZURE_ALLOW_HTTP": "true",
        }.items():
            monkeypatch.setenv(name, value)
        yield "az://survey/missions"
    finally:
        server.kill()
        server.wait()


def create_container(endpoint: str, name: str) -> None:
    """Create a container once the server answers.

    Source: Microsoft, Authorize with Shared Key, and Create Container.
    """
    limit_s = time.monotonic() + START_TIMEOUT_S
    while True:
        date, version = formatdate(usegmt=True), "2021-08-06"
        headers = f"x-ms-date:{date}\nx-ms-version:{version}\n"
        resource = f"/{ACCOUNT}/{ACCOUNT}/{name}\nrestype:container"
        text = "PUT" + "\n" * 12 + headers + resource
        digest = hmac.new(base64.b64decode(ACCOUNT_KEY), text.encode(), hashlib.sha256).digest()
        request = urllib.request.Request(
            f"{endpoint}/{name}?restype=container",
            method="PUT",
            headers={
                "x-ms-date": date,
                "x-ms-version": version,
                "Authorization": f"SharedKey {ACCOUNT}:{base64.b64encode(digest).decode()}",
            },
        )
        try:
            urllib.request.urlopen(request, timeout=5).close()
            return
        except (urllib.error.URLError, ConnectionError, TimeoutError) as error:
            if isinstance(error, urllib.error.HTTPError) or time.monotonic() > limit_s:
                raise
            time.sleep(0.2)


def test_a_mission_is_copied_verified_and_processed_in_a_container(
    container: str, tmp_path: Path
) -> None:
    check_a_mission_is_copied_verified_and_processed(container, tmp_path)


def test_a_killed_transfer_continues_at_its_block(container: str, tmp_path: Path) -> None:
    check_a_killed_transfer_continues_at_its_part(container, tmp_path)


def test_of_many_writers_of_a_key_one_commits_in_a_container(container: str) -> None:
    check_of_many_writers_of_a_key_one_commits(container)


def test_a_list_of_a_container_has_all_objects(container: str) -> None:
    check_a_list_has_all_its_pages_and_a_removed_object_is_gone(container)


def test_a_store_without_tls_is_refused_unless_it_is_permitted(
    container: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("AZURE_ALLOW_HTTP")
    monkeypatch.setattr("daemon.mission.transfer.object_store.READ_ATTEMPTS", 1)
    monkeypatch.setattr("daemon.mission.transfer.object_store.RETRIES", 0)
    with pytest.raises(ObjectStoreError):
        ObjectStore(container).list_objects()
