"""Files in blocks to Azure: which ones are sent, and how requests are signed.

Azurite proves the requests themselves, in `test_azure_store`.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from datetime import UTC, datetime

import pytest

from daemon.mission.transfer import azure_parts, part_sender
from daemon.mission.transfer.azure_parts import AzureFolder, AzurePartUploads, block_name
from daemon.mission.transfer.part_sender import InterruptedUploadError
from daemon.mission.transfer.store_requests import StoreAnswer, StoreRefusedError

pytestmark = pytest.mark.trust

PART = 10
CONTENT = b"0123456789abcdefghijABCDE"


class Container(AzureFolder):
    """Blocks of one name and the object that was made of them, in memory."""

    def __init__(self, blocks: dict[str, bytes]) -> None:
        super().__init__("https://c", "", "a", b"k")
        self.__dict__ |= {"blocks": dict(blocks), "object": None, "put": [], "gone": not blocks}

    def request(
        self, method: str, name: str, query: Mapping[str, str], body: bytes = b""
    ) -> StoreAnswer:
        content = b""
        if method == "GET":
            if self.gone:
                raise StoreRefusedError(404, "BlobNotFound")
            listed = "".join(
                f"<Block><Name>{block}</Name><Size>{len(data)}</Size></Block>"
                for block, data in self.blocks.items()
            )
            content = b"\xef\xbb\xbf<BlockList><UncommittedBlocks>" + listed.encode()
            content += b"</UncommittedBlocks></BlockList>"
        elif query["comp"] == "block":
            self.put.append(query["blockid"])
            self.blocks[query["blockid"]] = body
        else:
            names = body.decode().split("<Latest>")[1:]
            joined = b"".join(self.blocks[one.partition("<")[0]] for one in names)
            self.__dict__["object"] = joined
        return StoreAnswer(content, datetime.now(UTC))


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(part_sender, "PART_BYTES", PART)


def parts() -> list[bytes]:
    return [CONTENT[start : start + PART] for start in range(0, len(CONTENT), PART)]


def sent_to(container: Container) -> AzurePartUploads:
    uploads, steps = AzurePartUploads(container), list[int]()
    uploads.send("x", lambda at, count: CONTENT[at : at + count], len(CONTENT), steps.append)
    assert container.object == CONTENT and sorted(steps) == [5, 10, 10]
    return uploads


def test_blocks_that_the_store_has_are_not_sent_again() -> None:
    first, _, last = parts()
    container = Container({block_name(1, first): first, block_name(3, last): last})
    ended = sent_to(container).end()
    assert container.put == [block_name(2, parts()[1])]
    assert ended.continued == ("x",) and ended.reused_nbytes == 15


@pytest.mark.parametrize(
    "blocks",
    [
        {},
        {block_name(2, CONTENT[:PART]): CONTENT[:PART]},  # of another place
        {block_name(1, b"9876543210"): b"9876543210"},  # of another file
        {block_name(1, CONTENT[:PART]): CONTENT[:4]},  # short
        {base64.b64encode(b"7" * 32).decode(): CONTENT[:PART]},  # of another program
    ],
    ids=("none", "moved", "stale", "short", "foreign"),
)
def test_blocks_that_differ_from_the_file_are_sent_again(blocks: dict[str, bytes]) -> None:
    container = Container(blocks)
    ended = sent_to(container).end()
    assert len(container.put) == 3 and ended.reused_nbytes == 0 and ended.continued == ()


def test_a_stopped_upload_makes_no_object() -> None:
    container = Container({})
    uploads = AzurePartUploads(container)
    uploads.stop()
    with pytest.raises(InterruptedUploadError):
        uploads.send("x", lambda at, count: CONTENT[at : at + count], len(CONTENT), print)
    assert container.object is None and container.put == []


def test_a_refused_list_of_blocks_ends_the_upload() -> None:
    class Refusing(Container):
        def request(self, *_arguments: object, **_options: object) -> StoreAnswer:
            raise StoreRefusedError(403, "AuthorizationFailure")

    with pytest.raises(StoreRefusedError, match="403 AuthorizationFailure"):
        AzurePartUploads(Refusing({})).send("x", lambda _at, _count: b"", 1, print)


def test_names_of_blocks_have_one_length_and_that_of_obstore() -> None:
    names = {block_name(number, bytes([number % 7])) for number in (1, 9, 50_000)}
    assert len(names) == 3 and {len(base64.b64decode(one)) for one in names} == {32}


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({}, None),
        ({"AZURE_STORAGE_ACCOUNT_KEY": "a2V5"}, None),
        ({"AZURE_STORAGE_ACCOUNT_NAME": "me", "AZURE_STORAGE_ACCOUNT_KEY": "no base64"}, None),
        (
            {"AZURE_STORAGE_ACCOUNT_NAME": "me", "AZURE_STORAGE_ACCESS_KEY": "a2V5"},
            "https://me.blob.core.windows.net/survey",
        ),
    ],
    ids=("none", "no-name", "no-key", "key"),
)
def test_the_key_and_the_address_are_those_of_the_environment(
    monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], expected: str | None
) -> None:
    for name in (*azure_parts._ACCOUNT, *azure_parts._KEY, *azure_parts._ENDPOINT):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    folder = AzureFolder.of("az://survey/missions/m")
    assert (folder and (folder.container, folder.prefix, folder.key)) == (
        expected and (expected, "missions/m/", b"key")
    )


def test_a_request_without_tls_is_refused_unless_it_is_permitted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("AZURE_ALLOW_HTTP", raising=False)
    folder = AzureFolder("http://127.0.0.1:9/me/survey", "", "me", b"key")
    with pytest.raises(OSError, match="has no TLS"):
        folder.request("GET", "x", {})
