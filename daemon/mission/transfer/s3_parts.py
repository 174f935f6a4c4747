"""Files sent to S3 or Google in parts, continued where an earlier command was killed.

The store lists the parts it has, with size and MD5. A part that equals the file is not sent again;
the object is read back and compared by SHA-256 as every other one. obstore begins each upload
again, so the requests are made here; they need the access key of the environment.
"""

from __future__ import annotations

import hashlib
from collections.abc import Container
from dataclasses import replace
from typing import Final
from xml.sax.saxutils import escape

from daemon.mission.foreign_xml import parse_xml
from daemon.mission.transfer import object_store
from daemon.mission.transfer.object_store import RETRIES, ByteProgress
from daemon.mission.transfer.part_sender import PartSender, ReadPart
from daemon.mission.transfer.s3_requests import S3Folder
from daemon.mission.transfer.s3_uploads import (
    ELEMENTS_MAX,
    UnfinishedUploads,
    Upload,
    UploadListing,
    abort_old,
    text_of,
)
from daemon.mission.transfer.store_requests import StoreRefusedError

_COMPLETED: Final = "CompleteMultipartUploadResult"


class S3PartUploads:
    """Uploads in parts below a folder of a bucket.

    Args:
        folder: of the store.
        listing: of the uploads there.
        continued: names that may be continued; of several uploads of a name the last one is.
    """

    def __init__(self, folder: S3Folder, listing: UploadListing, continued: Container[str]) -> None:
        self._folder, self._listing = folder, listing
        self._begun: dict[str, Upload] = {}
        for one in sorted(listing.uploads, key=lambda one: -one.age_s):
            if one.name in continued:
                self._begun[one.name] = one
        others = [one for one in listing.uploads if self._begun.get(one.name) != one]
        self._ended = abort_old(listing, others)
        self._uploads = {name: one.upload_id for name, one in self._begun.items()}
        self._completed: set[str] = set()
        self._sender = PartSender()

    def send(self, name: str, read: ReadPart, nbytes: int, sent: ByteProgress) -> None:
        """Send the parts that the store does not have, and complete the object.

        After a refusal the next call begins an upload of its own.
        """
        begun = self._uploads.get(name)
        try:
            present = self._present(name, begun) if begun else {}
            upload = begun or self._created(name)
            self._uploads[name] = upload

            def there(number: int, data: bytes) -> str:
                e_tag = hashlib.md5(data, usedforsecurity=False).hexdigest()
                return e_tag if present.get(number) == (len(data), e_tag) else ""

            def put(number: int, data: bytes) -> str:
                query = {"partNumber": str(number), "uploadId": upload}
                return self._request("PUT", name, query, data)[1]

            e_tags = self._sender.send(read, nbytes, sent, present=there, put=put)
            self._complete(name, upload, e_tags)
        except (StoreRefusedError, ValueError) as error:
            if not isinstance(error, StoreRefusedError) or error.status < 500:
                self._uploads.pop(name, None)
            raise
        self._completed.add(upload)
        self._uploads.pop(name, None)

    def stop(self) -> None:
        self._sender.stop()

    def end(self) -> UnfinishedUploads:
        """Abort old uploads that were not continued after all; what happened to all of them."""
        begun, completed = self._begun.values(), self._completed
        continued = sorted(one.name for one in begun if one.upload_id in completed)
        found = abort_old(self._listing, [one for one in begun if one.upload_id not in completed])
        return replace(
            found,
            aborted=(*self._ended.aborted, *found.aborted),
            recent=(*self._ended.recent, *found.recent),
            problem=found.problem or self._ended.problem,
            continued=tuple(continued),
            reused_nbytes=self._sender.reused_nbytes,
        )

    def _present(self, name: str, upload: str) -> dict[int, tuple[int, str]]:
        """Size and MD5 of the parts that the store has, by number."""
        found: dict[int, tuple[int, str]] = {}
        query = {"uploadId": upload}
        while True:
            root = parse_xml(self._request("GET", name, query)[0], elements_max=ELEMENTS_MAX)
            for one in root.iterfind("{*}Part"):
                number, nbytes = (int(text_of(one, key)) for key in ("PartNumber", "Size"))
                found[number] = nbytes, text_of(one, "ETag").strip('"')
            marker = root.findtext("{*}NextPartNumberMarker") or ""
            is_cut = root.findtext("{*}IsTruncated") == "true"
            if not is_cut or marker == query.get("part-number-marker"):
                return found
            query["part-number-marker"] = marker

    def _created(self, name: str) -> str:
        answer, _ = self._request("POST", name, {"uploads": ""})
        return text_of(parse_xml(answer, elements_max=ELEMENTS_MAX), "UploadId")

    def _complete(self, name: str, upload: str, e_tags: list[str]) -> None:
        """Make the parts an object.

        Raises:
            ValueError: the store answers that it is complete, with an error in the body.
        """
        parts = "".join(
            f"<Part><PartNumber>{number}</PartNumber><ETag>&quot;{escape(e_tag)}&quot;</ETag></Part>"
            for number, e_tag in enumerate(e_tags, 1)
        )
        text = f"<CompleteMultipartUpload>{parts}</CompleteMultipartUpload>"
        answer, _ = self._request("POST", name, {"uploadId": upload}, text.encode())
        root = parse_xml(answer, elements_max=ELEMENTS_MAX)
        if root.tag.rpartition("}")[2] != _COMPLETED:
            code = root.findtext("{*}Code") or root.findtext("Code") or root.tag
            raise ValueError(f"the upload was not completed: {code}")

    def _request(
        self, method: str, name: str, query: dict[str, str], body: bytes = b""
    ) -> tuple[bytes, str]:
        answer = self._folder.request(
            method, name, query, body,
            attempts=RETRIES, timeout_s=object_store.REQUEST_TIMEOUT_S,
        )  # fmt: skip
        return answer.content, answer.e_tag
