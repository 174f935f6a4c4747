"""Files sent to Azure Blob Storage in blocks, continued where an earlier command was killed.

A block's name has its number and the first 108 bits of its SHA-256, so that the store's list of
blocks states which parts of the file it has. The object is read back and compared as every other
one. Requests are signed with the account key of the environment; blocks that no object was made
of are discarded by the store after a week.

Source: Microsoft, Put Block, Get Block List, Put Block List, Authorize with Shared Key.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import os
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import format_datetime
from typing import Final
from urllib.parse import quote, urlsplit

from daemon.mission.foreign_xml import parse_xml
from daemon.mission.transfer import object_store
from daemon.mission.transfer.object_store import RETRIES, ByteProgress
from daemon.mission.transfer.part_sender import PartSender, ReadPart
from daemon.mission.transfer.s3_requests import query_text
from daemon.mission.transfer.s3_uploads import ELEMENTS_MAX, UnfinishedUploads, text_of
from daemon.mission.transfer.store_requests import StoreAnswer, StoreRefusedError, answer_to

VERSION: Final = "2021-08-06"
_NAME_CHARACTERS: Final = 32
"""Of a block; the blocks of obstore have as many, and all of one object must."""
_ACCOUNT: Final = ("AZURE_STORAGE_ACCOUNT_NAME",)
_KEY: Final = (
    "AZURE_STORAGE_ACCOUNT_KEY",
    "AZURE_STORAGE_ACCESS_KEY",
    "AZURE_STORAGE_MASTER_KEY",
)
_ENDPOINT: Final = ("AZURE_STORAGE_ENDPOINT", "AZURE_ENDPOINT")


@dataclass(frozen=True)
class AzureFolder:
    """A folder of a container: the container's address, and the prefix of names, ending in '/'."""

    container: str
    prefix: str
    account: str
    key: bytes

    @classmethod
    def of(cls, url: str) -> AzureFolder | None:
        """The folder of an address; None without an account key in the environment.

        Args:
            url: such as "az://container/missions/one".
        """
        account, key, endpoint = _first(_ACCOUNT), _first(_KEY), _first(_ENDPOINT)
        try:
            decoded = base64.b64decode(key, validate=True)
        except binascii.Error:
            return None
        if not account or not decoded:
            return None
        parts = urlsplit(url)
        prefix = parts.path.strip("/")
        base = endpoint.rstrip("/") or f"https://{account}.blob.core.windows.net"
        return cls(f"{base}/{parts.netloc}", f"{prefix}/" if prefix else "", account, decoded)

    def request(
        self, method: str, name: str, query: Mapping[str, str], body: bytes = b""
    ) -> StoreAnswer:
        """The answer to a request; what passes is tried again.

        Args:
            method: such as GET.
            name: of an object below the folder.
            query: parameters, not quoted.
            body: of the request.

        Raises:
            StoreRefusedError: the store refused.
            OSError, HTTPException: it did not answer in every attempt.
        """
        url = f"{self.container}/{quote(self.prefix + name)}"

        def signed() -> urllib.request.Request:
            return urllib.request.Request(
                f"{url}?{query_text(query)}",
                data=body or None,
                method=method,
                headers=self._headers(method, url, query, len(body)),
            )

        return answer_to(signed, "az", attempts=RETRIES, timeout_s=object_store.REQUEST_TIMEOUT_S)

    def _headers(
        self, method: str, url: str, query: Mapping[str, str], nbytes: int
    ) -> dict[str, str]:
        date = format_datetime(datetime.now(UTC), usegmt=True)
        kind = "application/octet-stream" if nbytes else ""
        # Encoding, language, length, MD5 and type of the content; then a date and five conditions.
        lines = [method, "", "", str(nbytes or ""), "", kind, *[""] * 6]
        lines += [f"x-ms-date:{date}", f"x-ms-version:{VERSION}"]
        lines += [f"/{self.account}{urlsplit(url).path}"]
        lines += [f"{name}:{value}" for name, value in sorted(query.items())]
        digest = hmac.digest(self.key, "\n".join(lines).encode(), "sha256")
        return {
            "x-ms-date": date,
            "x-ms-version": VERSION,
            "authorization": f"SharedKey {self.account}:{base64.b64encode(digest).decode()}",
            **({"content-type": kind} if kind else {}),
        }


class AzurePartUploads:
    """Uploads in blocks below a folder of a container.

    Args:
        folder: of the store.
    """

    def __init__(self, folder: AzureFolder) -> None:
        self._folder = folder
        self._sender = PartSender()
        self._continued: set[str] = set()

    def send(self, name: str, read: ReadPart, nbytes: int, sent: ByteProgress) -> None:
        there, reused = self._blocks(name), list[str]()

        def present(number: int, data: bytes) -> str:
            block = block_name(number, data)
            if there.get(block) != len(data):
                return ""
            reused.append(block)
            return block

        def put(number: int, data: bytes) -> str:
            block = block_name(number, data)
            self._folder.request("PUT", name, {"comp": "block", "blockid": block}, data)
            return block

        blocks = self._sender.send(read, nbytes, sent, present=present, put=put)
        latest = "".join(f"<Latest>{block}</Latest>" for block in blocks)
        text = f'<?xml version="1.0" encoding="utf-8"?><BlockList>{latest}</BlockList>'
        self._folder.request("PUT", name, {"comp": "blocklist"}, text.encode())
        if reused:
            self._continued.add(name)

    def stop(self) -> None:
        self._sender.stop()

    def end(self) -> UnfinishedUploads:
        return UnfinishedUploads(
            continued=tuple(sorted(self._continued)), reused_nbytes=self._sender.reused_nbytes
        )

    def _blocks(self, name: str) -> dict[str, int]:
        """Sizes of the blocks that the store has and that are no part of an object, by name."""
        query = {"comp": "blocklist", "blocklisttype": "uncommitted"}
        try:
            answer = self._folder.request("GET", name, query)
        except StoreRefusedError as error:
            if error.status == 404:
                return {}
            raise
        root = parse_xml(answer.content.removeprefix(b"\xef\xbb\xbf"), elements_max=ELEMENTS_MAX)
        return {text_of(one, "Name"): int(text_of(one, "Size")) for one in root.iter("Block")}


def block_name(number: int, data: bytes) -> str:
    """The name of a part, in base64 as the store has it.

    Args:
        number: of the part, from 1.
        data: its content.
    """
    text = f"{number:05d}{hashlib.sha256(data).hexdigest()}"[:_NAME_CHARACTERS]
    return base64.b64encode(text.encode()).decode()


def _first(names: tuple[str, ...]) -> str:
    return next((value for name in names if (value := os.environ.get(name))), "")
