"""Uploads in parts that a killed command left in S3 or at Google: listed, and aborted.

Their parts are stored and paid for, and no listing of objects shows them. Those that a transfer
continues are in `daemon.mission.transfer.s3_parts`. Azure is not asked: it discards them after a
week.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from http.client import HTTPException
from typing import Final
from xml.etree import ElementTree

from daemon.mission.foreign_xml import parse_xml
from daemon.mission.transfer.s3_requests import KEY_NAMES, S3Folder
from daemon.mission.transfer.store_requests import StoreRefusedError

AGE_MIN_S: Final = 3600.0
"""Uploads that began later may be of a command that runs now, and are left."""
ELEMENTS_MAX: Final = 50_000
_RULE: Final = "give the bucket a rule AbortIncompleteMultipartUpload"
_RIGHTS: Final = {
    "s3": "s3:ListBucketMultipartUploads and s3:AbortMultipartUpload",
    "gs": "storage.multipartUploads.list and storage.multipartUploads.abort",
}


@dataclass(frozen=True)
class UnfinishedUploads:
    """Names of continued, aborted and recent uploads below a folder, and what failed.

    `reused_nbytes` are those of the continued ones that an earlier run had sent.
    """

    aborted: tuple[str, ...] = ()
    recent: tuple[str, ...] = ()
    problem: str = ""
    continued: tuple[str, ...] = ()
    reused_nbytes: int = 0

    @property
    def sentence(self) -> str:
        """For a person; empty where there is nothing to state."""
        parts = []
        if self.continued:
            parts.append(
                f"{len(self.continued)} unfinished uploads of an earlier run were continued; "
                f"{self.reused_nbytes / 1e6:.0f} MB of them were in the store."
            )
        if self.aborted:
            parts.append(f"{len(self.aborted)} unfinished uploads of an earlier run were aborted.")
        if self.recent:
            parts.append(
                f"{len(self.recent)} unfinished uploads are younger than {AGE_MIN_S / 3600:.0f} h "
                f"and are left, such as {self.recent[0]}; run the same command again later."
            )
        return " ".join([*parts, *([self.problem] if self.problem else [])])


@dataclass(frozen=True)
class Upload:
    """One that is neither completed nor aborted; `age_s` by the clock of the store."""

    name: str
    upload_id: str
    age_s: float


@dataclass(frozen=True)
class UploadListing:
    """Uploads below a folder; `folder` is None where `problem` keeps them from being listed."""

    url: str
    folder: S3Folder | None = None
    uploads: tuple[Upload, ...] = ()
    problem: str = ""


def list_unfinished(url: str, is_own: Callable[[str], bool]) -> UploadListing:
    """Uploads of these commands; a failure never ends the command: its sentence is in the result.

    Args:
        url: of a folder, such as "s3://bucket/missions/one".
        is_own: whether an object of this name below the folder is written by these commands.
    """
    scheme = url.partition("://")[0]
    if scheme not in KEY_NAMES:
        return UploadListing(url)
    folder = S3Folder.of(url)
    if folder is None:
        return UploadListing(
            url,
            problem="Unfinished uploads were not looked for, because "
            f"{KEY_NAMES[scheme][0]} is not set. A file in work at a kill is sent "
            f"again from its start; {_RULE}.",
        )
    try:
        found = tuple(one for one in _listed(folder) if is_own(one.name))
    except (OSError, HTTPException, ValueError) as error:
        return UploadListing(url, problem=_problem(url, error))
    return UploadListing(url, folder, found)


def abort_old(listing: UploadListing, uploads: Iterable[Upload]) -> UnfinishedUploads:
    """Abort uploads that began more than `AGE_MIN_S` ago.

    Args:
        listing: that they are of.
        uploads: all of it, or some.
    """
    chosen = list(uploads)
    recent = tuple(one.name for one in chosen if one.age_s < AGE_MIN_S)
    result = UnfinishedUploads(recent=recent, problem=listing.problem)
    for one in chosen:
        if listing.folder is None or one.age_s < AGE_MIN_S:
            continue
        try:
            listing.folder.request("DELETE", one.name, {"uploadId": one.upload_id})
        except (OSError, HTTPException) as error:
            # 404: it ended meanwhile.
            if not isinstance(error, StoreRefusedError) or error.status != 404:
                return replace(result, problem=_problem(listing.url, error))
        result = replace(result, aborted=(*result.aborted, one.name))
    return result


def abort_unfinished(url: str, is_own: Callable[[str], bool]) -> UnfinishedUploads:
    """List uploads and abort old ones.

    Args:
        url: see `list_unfinished`.
        is_own: see `list_unfinished`.
    """
    listing = list_unfinished(url, is_own)
    return abort_old(listing, listing.uploads)


def _problem(url: str, error: Exception) -> str:
    return (
        f"Unfinished uploads below {url} could not be listed or aborted ({error}). Permit "
        f"{_RIGHTS[url.partition('://')[0]]}, or {_RULE}."
    )


def _listed(folder: S3Folder) -> list[Upload]:
    """Every unfinished upload.

    Raises:
        OSError, HTTPException: the store refused or did not answer.
        ValueError: not an answer of S3.
    """
    found: list[Upload] = []
    query = {"uploads": "", "prefix": folder.prefix}
    while True:
        answer = folder.request("GET", None, query)
        root = parse_xml(answer.content, elements_max=ELEMENTS_MAX)
        for one in root.iterfind("{*}Upload"):
            begun = datetime.fromisoformat(text_of(one, "Initiated")).astimezone(UTC)
            key, age_s = text_of(one, "Key"), (answer.now - begun).total_seconds()
            if key.startswith(folder.prefix):
                name = key.removeprefix(folder.prefix)
                found.append(Upload(name, text_of(one, "UploadId"), age_s))
        marker = root.findtext("{*}NextKeyMarker") or ""
        last = root.findtext("{*}NextUploadIdMarker") or ""
        is_cut = root.findtext("{*}IsTruncated") == "true"
        if not is_cut or (marker, last) == (query.get("key-marker"), query.get("upload-id-marker")):
            return found
        query |= {"key-marker": marker, "upload-id-marker": last}


def text_of(element: ElementTree.Element, name: str) -> str:
    """The text of a child.

    Raises:
        ValueError: there is none.
    """
    text = element.findtext(f"{{*}}{name}")
    if not text:
        raise ValueError(f"the answer has an element without {name}")
    return text
