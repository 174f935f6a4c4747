"""An object store as a place for a mission: s3://, gs:// and az://.

Requests are repeated after time-outs, throttling and errors of the server. What was read counts
only with the length that the store states. Credentials and the endpoint come from the environment
(`AWS_ACCESS_KEY_ID`, `AWS_ENDPOINT_URL`, `GOOGLE_APPLICATION_CREDENTIALS`,
`AZURE_STORAGE_ACCOUNT_KEY` and others of the vendors), and so does the permission to do without TLS
(`AWS_ALLOW_HTTP`, `GOOGLE_ALLOW_HTTP`, `AZURE_ALLOW_HTTP`).
"""

from __future__ import annotations

import hashlib
import re
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, Final, TypeVar

from daemon import DaemonError
from daemon.mission.transfer.store_requests import StoreRefusedError, is_http_permitted

SCHEMES: Final = ("s3", "gs", "az")
PART_BYTES: Final = 16_000_000
"""Largest body of a request; a larger object is sent in several parts."""
REQUESTS: Final = 16
"""Small objects asked for at a time."""
READ_ATTEMPTS: Final = 6
WRITE_ATTEMPTS: Final = 4
REQUEST_TIMEOUT_S: Final = 60.0
CONNECT_TIMEOUT_S: Final = 10.0
RETRIES: Final = 8
RETRY_TIMEOUT_S: Final = 180.0
_FIRST_PAUSE_S: Final = 0.1
_ACCESS_CURES: Final = {
    "ExpiredToken": "The credentials have expired. Set new ones",
    "TokenRefreshRequired": "The credentials have expired. Set new ones",
    "RequestTimeTooSkewed": "The clock of this machine is wrong by more than the store permits. "
    "Set it",
}
"""Errors of S3 by their code, of which the first comes with status 400.

Source: Amazon S3 API Reference, Error responses.
"""
_DENIED = re.compile(r"status code: (40[13]\b|400 Bad Request:?$)")
"""Answers that name no code, as those to HEAD; obstore reports some of them as general errors."""
_NO_UPLOAD: Final = "NoSuchUpload"
_URL = re.compile(r"([a-z0-9]+)://([^/?#@]+)(/[^?#]*)?")

T = TypeVar("T")
ByteProgress = Callable[[int], None]


class ObjectStoreError(DaemonError):
    """A store refused or cannot be reached; the message has the cause and what to do."""


class ObjectStoreAccessError(ObjectStoreError):
    """A store that refuses these credentials: other objects would be refused as well."""


class ObjectStoreUnavailableError(ObjectStoreError, ConnectionError):
    """A store that failed in every attempt; the same call may succeed later."""


@dataclass(frozen=True)
class StoredObject:
    """An object: its name below the folder, its size, and its entity tag where there is one."""

    name: str
    nbytes: int
    e_tag: str | None


def is_store_url(text: str) -> bool:
    """Whether a place is in an object store."""
    return text.partition("://")[0] in SCHEMES and "://" in text


class ObjectStore:
    """A folder of an object store. `url` serves messages and ends without '/'.

    Args:
        url: such as "s3://bucket/missions".

    Raises:
        ObjectStoreError: not a URL of a known scheme, or the configuration is refused.
    """

    def __init__(self, url: str) -> None:
        import obstore.store

        match = _URL.fullmatch(url)
        if match is None or match[1] not in SCHEMES:
            raise ObjectStoreError(
                f"{url}: no folder of an object store; write it as s3://bucket/folder, "
                "gs://bucket/folder or az://container/folder"
            )
        self.url = url.rstrip("/")
        options: dict[str, Any] = {
            "client_options": {
                "timeout": timedelta(seconds=REQUEST_TIMEOUT_S),
                "connect_timeout": timedelta(seconds=CONNECT_TIMEOUT_S),
                # Options given here take the place of those in the environment.
                "allow_http": is_http_permitted(match[1]),
            },
            "retry_config": {
                "max_retries": RETRIES,
                "retry_timeout": timedelta(seconds=RETRY_TIMEOUT_S),
                "backoff": {
                    "init_backoff": timedelta(seconds=_FIRST_PAUSE_S),
                    "max_backoff": timedelta(seconds=5),
                    "base": 2,
                },
            },
        }
        bucket, prefix = match[2], (match[3] or "").strip("/")
        kinds = {
            "s3": obstore.store.S3Store,
            "gs": obstore.store.GCSStore,
            "az": obstore.store.AzureStore,
        }
        try:
            self._store = kinds[match[1]](bucket, prefix=prefix or None, **options)
        except (obstore.exceptions.BaseError, ValueError) as error:
            raise ObjectStoreError(f"{self.url}: {_first_line(error)}") from error

    def below(self, name: str) -> ObjectStore:
        """A folder in this one."""
        return ObjectStore(f"{self.url}/{name}")

    def list_objects(self, folder: str = "") -> list[StoredObject]:
        """Every object, sorted by name.

        Args:
            folder: only those below it; names are those below this store's folder all the same.

        Raises:
            ObjectStoreError: the store refused.
        """
        import obstore

        def listed() -> list[StoredObject]:
            return [
                StoredObject(str(one["path"]), int(one["size"]), one.get("e_tag"))
                for chunk in obstore.list(self._store, prefix=folder or None)
                for one in chunk
            ]

        return sorted(self._repeated(listed, "list"), key=lambda one: one.name)

    def list_with(self, names: Iterable[str], folder: str = "") -> list[StoredObject]:
        """Every object, sorted by name; objects that the list misses are asked for by their name.

        A list may be late; an object that was written is found by its name.

        Args:
            names: of objects that may be there.
            folder: only those below it.

        Raises:
            ObjectStoreError: the store refused.
        """
        found = {one.name: one for one in self.list_objects(folder)}
        with ThreadPoolExecutor(REQUESTS) as pool:
            late = pool.map(self.find, [name for name in names if name not in found])
            found |= {one.name: one for one in late if one is not None}
        return sorted(found.values(), key=lambda one: one.name)

    def find(self, name: str) -> StoredObject | None:
        """An object; None where there is none.

        Raises:
            ObjectStoreError: the store refused.
        """
        import obstore

        def head() -> StoredObject | None:
            try:
                found = obstore.head(self._store, name)
            except (FileNotFoundError, obstore.exceptions.NotFoundError):
                return None
            return StoredObject(name, int(found["size"]), found.get("e_tag"))

        return self._repeated(head, name)

    def read_small(self, name: str) -> bytes | None:
        """The content of an object that fits into memory; None where there is none."""
        found = self.find(name)
        return None if found is None else b"".join(self.blocks(found))

    def read(self, name: str, nbytes: int) -> bytes:
        """The content of an object whose size is known.

        Args:
            name: of the object.
            nbytes: its size.

        Raises:
            ObjectStoreError: the object is gone, has another size, or the store refused.
        """
        entry = self.find(name)
        if entry is None or entry.nbytes != nbytes:
            found = "is missing" if entry is None else f"has {entry.nbytes} bytes"
            raise ObjectStoreError(f"{self.url}/{name} {found}; {nbytes} bytes were transferred")
        blocks = list(self.blocks(entry))
        return blocks[0] if len(blocks) == 1 else b"".join(blocks)

    def blocks(self, entry: StoredObject) -> Iterator[bytes]:
        """The content of an object, in parts of at most `PART_BYTES`.

        Raises:
            ObjectStoreError: the object is gone, changed its size, or the store refused.
        """
        import obstore

        for start in range(0, entry.nbytes, PART_BYTES):
            end = min(start + PART_BYTES, entry.nbytes)

            def part(start: int = start, end: int = end) -> bytes:
                data = bytes(obstore.get_range(self._store, entry.name, start=start, end=end))
                if len(data) != end - start:
                    raise OSError(f"{len(data)} bytes of {end - start}")
                return data

            yield self._repeated(part, entry.name)

    def sha256(self, entry: StoredObject, step: ByteProgress) -> str:
        """Read an object back from the store and hash it."""
        digest = hashlib.sha256()
        for block in self.blocks(entry):
            digest.update(block)
            step(len(block))
        return digest.hexdigest()

    def put(
        self, name: str, blocks: Callable[[], Iterator[bytes]], nbytes: int, sha256: str
    ) -> None:
        """Write an object whose hash is known; it is complete or absent.

        An error after which the object is there with this hash is no error: the answer was lost,
        not the request.

        Args:
            name: of the object.
            blocks: opens the content again at each call.
            nbytes: size of the content.
            sha256: of the content.

        Raises:
            ObjectStoreError: the store refused in every attempt.
        """
        import obstore

        def send() -> None:
            if nbytes <= PART_BYTES:
                obstore.put(self._store, name, b"".join(blocks()), use_multipart=False)
            else:
                obstore.put(
                    self._store, name, blocks(), use_multipart=True, chunk_size=PART_BYTES,
                    max_concurrency=2,
                )  # fmt: skip

        self.put_by(send, name, nbytes, sha256, errors=(obstore.exceptions.BaseError,))

    def put_by(
        self,
        send: Callable[[], None],
        name: str,
        nbytes: int,
        sha256: str,
        *,
        errors: tuple[type[Exception], ...],
    ) -> None:
        """Write an object as `put` does, by a function that sends it.

        Args:
            send: sends the whole object.
            name: of the object.
            nbytes: size of the content.
            sha256: of the content.
            errors: that `send` raises where the store fails.

        Raises:
            ObjectStoreError: the store refused in every attempt.
        """
        for attempt in range(1, WRITE_ATTEMPTS + 1):
            try:
                send()
                return
            except errors as error:
                # An upload that was aborted elsewhere is begun again.
                if _is_final(error) and _NO_UPLOAD not in str(error):
                    raise self._refused(name, error) from error
                there = self.find(name)
                if there is not None and there.nbytes == nbytes:
                    with suppress(ObjectStoreError):
                        if self.sha256(there, lambda _count: None) == sha256:
                            return
                if attempt == WRITE_ATTEMPTS:
                    raise self._refused(name, error) from error
                time.sleep(_FIRST_PAUSE_S * 2**attempt)

    def create_small(self, name: str, data: bytes) -> bool:
        """Write a small object unless it is there: of several writers one succeeds.

        An object with the same content after a lost answer may be of this call or of another one.

        Args:
            name: of the object.
            data: its content.

        Returns:
            Whether this call wrote it, by the answer of the store; False where it was there.

        Raises:
            ObjectStoreError: the store refused, or the object is there with another content.
        """
        import obstore

        def create() -> bool:
            try:
                obstore.put(self._store, name, data, mode="create", use_multipart=False)
            except (FileExistsError, obstore.exceptions.AlreadyExistsError):
                return False
            return True

        is_created = self._repeated(create, name)
        if not is_created and self.read_small(name) != data:
            raise ObjectStoreError(
                f"{self.url}/{name} is there with another content; it is left as it is. Remove it "
                "with a program of the store and run the same command again"
            )
        return is_created

    def replace_small(self, name: str, data: bytes) -> None:
        """Write a small object and read it back."""
        self.put(name, lambda: iter([data]), len(data), hashlib.sha256(data).hexdigest())
        if self.read_small(name) != data:
            raise ObjectStoreError(
                f"{self.url}/{name}: read back differently from what was written; another "
                "transfer may write there. Wait for its end and run the transfer again"
            )

    def delete(self, name: str) -> None:
        """Remove an object; nothing happens where there is none."""
        import obstore

        def remove() -> None:
            with suppress(FileNotFoundError, obstore.exceptions.NotFoundError):
                obstore.delete(self._store, name)

        self._repeated(remove, name)

    def _repeated(self, call: Callable[[], T], name: str) -> T:
        import obstore

        for attempt in range(1, READ_ATTEMPTS + 1):
            try:
                return call()
            except (obstore.exceptions.BaseError, OSError) as error:
                if _is_final(error) or attempt == READ_ATTEMPTS:
                    raise self._refused(name, error) from error
                time.sleep(_FIRST_PAUSE_S * 2**attempt)
        raise AssertionError  # the last attempt returns or raises

    def _refused(self, name: str, error: Exception) -> ObjectStoreError:
        if cure := _access_cure(error):
            return ObjectStoreAccessError(
                f"{self.url}/{name}: {_first_line(error)}. {cure}, and run the command again: it "
                "continues"
            )
        kind = ObjectStoreError if _is_final(error) else ObjectStoreUnavailableError
        return kind(
            f"{self.url}/{name}: {_first_line(error)}. Check the network, the credentials and the "
            "bucket, and run the command again: it continues"
        )


def _is_final(error: Exception) -> bool:
    """Errors that no repetition cures: no such object or bucket, no right, no credentials."""
    import obstore

    absent = FileNotFoundError | obstore.exceptions.NotFoundError
    is_absent = isinstance(error, StoreRefusedError) and error.status == 404
    return is_absent or isinstance(error, absent) or bool(_access_cure(error))


def _access_cure(error: Exception) -> str:
    """What to do where a store refuses the credentials; empty for all other errors."""
    import obstore

    for code, cure in _ACCESS_CURES.items():
        if code in str(error):
            return cure
    denied = (
        PermissionError
        | obstore.exceptions.PermissionDeniedError
        | obstore.exceptions.UnauthenticatedError
    )
    if isinstance(error, denied) or _DENIED.search(_first_line(error)):
        return (
            "Check that the credentials have not expired, their rights to the bucket, and the "
            "clock of this machine"
        )
    return ""


def _first_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return (lines[0] if lines else type(error).__name__)[:300]
