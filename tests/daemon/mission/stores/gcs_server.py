"""A server of Google Cloud Storage's XML API, as far as a client of an object store asks for it.

Objects of one bucket in memory: put, get with a range, head, delete, list, uploads in several
parts with lists of uploads and of their parts, and the precondition that creates an object only
once. Emulators on PyPI serve the JSON API alone, which obstore does not use. Lists of uploads need
the signature of an HMAC key, as a bucket that is not public does; its value is not compared.

Source: Google Cloud Storage, XML API reference: Object, Multipart uploads, List parts, List
multipart uploads, List objects (GET Bucket, `list-type=2`), and header
`x-goog-if-generation-match`.
"""

from __future__ import annotations

import hashlib
import re
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from email.utils import formatdate
from typing import Any
from urllib.parse import parse_qs
from xml.sax.saxutils import escape

from tests.daemon.mission.stores.faulty_s3 import Faults, FaultyApplication

PAGE_OBJECTS = 5
"""Objects of one answer to a list, so that a client has to ask for the next ones."""

Answer = tuple[str, dict[str, str], bytes]


@dataclass
class GcsBucket:
    """WSGI application: the objects of one bucket, and uploads that are not complete."""

    name: str
    objects: dict[str, tuple[int, bytes]] = field(default_factory=dict)
    uploads: dict[str, dict[int, bytes]] = field(default_factory=dict)
    upload_names: dict[str, str] = field(default_factory=dict)
    generation: int = 0

    def __post_init__(self) -> None:
        self._lock = threading.Lock()

    def __call__(self, environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        method, path = environ["REQUEST_METHOD"], environ["PATH_INFO"]
        query = parse_qs(environ.get("QUERY_STRING", ""), keep_blank_values=True)
        body = environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
        bucket, _, name = path.lstrip("/").partition("/")
        with self._lock:
            if bucket != self.name:
                answer = _error("404 Not Found", "NoSuchBucket")
            else:
                answer = self._answer(method, name, query, body, environ)
        status, headers, content = answer
        length = {"Content-Length": str(len(content))}
        start_response(status, list((length | headers).items()))
        return [b"" if method == "HEAD" else content]

    def _answer(
        self,
        method: str,
        name: str,
        query: dict[str, list[str]],
        body: bytes,
        environ: dict[str, Any],
    ) -> Answer:
        if method == "GET" and "uploads" in query:
            signature = environ.get("HTTP_AUTHORIZATION", "")
            if not re.match(r"AWS4-HMAC-SHA256 Credential=GOOG1E/\d{8}/auto/s3/aws4_r", signature):
                return _error("403 Forbidden", "AccessDenied")
            return self._listed_uploads(query["prefix"][0])
        if method == "GET" and not name:
            return self._listed(query)
        if method == "POST" and "uploads" in query:
            upload = str(len(self.upload_names) + 1)
            self.uploads[upload], self.upload_names[upload] = {}, name
            return _xml("InitiateMultipartUploadResult", f"<UploadId>{upload}</UploadId>")
        if "uploadId" in query:
            return self._part(method, name, query, body, environ)
        if method == "PUT":
            return self._put(name, body, environ)
        if name not in self.objects:
            return _error("404 Not Found", "NoSuchKey")
        if method == "DELETE":
            del self.objects[name]
            return "204 No Content", {}, b""
        return self._got(method, name, environ)

    def _listed(self, query: dict[str, list[str]]) -> Answer:
        prefix = query.get("prefix", [""])[0]
        after = query.get("continuation-token", [""])[0]
        names = sorted(n for n in self.objects if n.startswith(prefix) and n > after)
        page, is_cut = names[:PAGE_OBJECTS], len(names) > PAGE_OBJECTS
        content = "".join(
            f"<Contents><Key>{escape(n)}</Key><Generation>{self.objects[n][0]}</Generation>"
            f"<LastModified>2026-11-21T10:15:00.000Z</LastModified>"
            f"<ETag>{_tag(self.objects[n][1])}</ETag><Size>{len(self.objects[n][1])}</Size>"
            "</Contents>"
            for n in page
        )
        token = (
            f"<NextContinuationToken>{escape(page[-1])}</NextContinuationToken>" if is_cut else ""
        )
        flag = f"<IsTruncated>{str(is_cut).lower()}</IsTruncated>"
        return _xml("ListBucketResult", f"<Prefix>{escape(prefix)}</Prefix>{flag}{token}{content}")

    def _listed_uploads(self, prefix: str) -> Answer:
        content = "".join(
            f"<Upload><Key>{escape(self.upload_names[one])}</Key><UploadId>{one}</UploadId>"
            "<Initiated>2026-11-21T10:15:00.000Z</Initiated></Upload>"
            for one in self.uploads
            if self.upload_names[one].startswith(prefix)
        )
        return _xml("ListMultipartUploadsResult", f"<IsTruncated>false</IsTruncated>{content}")

    def _put(self, name: str, body: bytes, environ: dict[str, Any]) -> Answer:
        expected = environ.get("HTTP_X_GOOG_IF_GENERATION_MATCH")
        there = self.objects.get(name, (0, b""))[0]
        if expected is not None and int(expected) != there:
            return _error("412 Precondition Failed", "PreconditionFailed")
        return self._stored(name, body)

    def _stored(self, name: str, body: bytes) -> Answer:
        self.generation += 1
        self.objects[name] = self.generation, body
        return "200 OK", {"ETag": _tag(body), "x-goog-generation": str(self.generation)}, b""

    def _part(
        self,
        method: str,
        name: str,
        query: dict[str, list[str]],
        body: bytes,
        environ: dict[str, Any],
    ) -> Answer:
        upload = query["uploadId"][0]
        if upload not in self.uploads:
            return _error("404 Not Found", "NoSuchUpload")
        parts = self.uploads[upload]
        if method == "PUT":
            parts[int(query["partNumber"][0])] = body
            return "200 OK", {"ETag": _tag(body)}, b""
        if method == "DELETE":
            del self.uploads[upload]
            return "204 No Content", {}, b""
        if method == "GET":
            content = "".join(
                f"<Part><PartNumber>{number}</PartNumber><ETag>{escape(_tag(part))}</ETag>"
                f"<Size>{len(part)}</Size></Part>"
                for number, part in sorted(parts.items())
            )
            return _xml("ListPartsResult", f"<IsTruncated>false</IsTruncated>{content}")
        numbers = [int(n) for n in re.findall(rb"<PartNumber>(\d+)</PartNumber>", body)]
        if not numbers or set(numbers) - parts.keys():
            return _error("400 Bad Request", "InvalidPart")
        if environ.get("HTTP_X_GOOG_IF_GENERATION_MATCH") == "0" and name in self.objects:
            return _error("412 Precondition Failed", "PreconditionFailed")
        joined = b"".join(parts[number] for number in numbers)
        del self.uploads[upload]
        self._stored(name, joined)
        return _xml("CompleteMultipartUploadResult", f"<ETag>{_tag(joined)}</ETag>")

    def _got(self, method: str, name: str, environ: dict[str, Any]) -> Answer:
        generation, content = self.objects[name]
        headers = {
            "ETag": _tag(content),
            "Last-Modified": formatdate(1_795_256_100, usegmt=True),
            "x-goog-generation": str(generation),
        }
        asked = re.fullmatch(r"bytes=(\d+)-(\d*)", environ.get("HTTP_RANGE", ""))
        if method == "HEAD" or asked is None:
            return "200 OK", headers, content
        start, end = int(asked[1]), min(int(asked[2] or len(content)) + 1, len(content))
        if start >= len(content):
            return _error("416 Requested Range Not Satisfiable", "InvalidRange")
        headers["Content-Range"] = f"bytes {start}-{end - 1}/{len(content)}"
        return "206 Partial Content", headers, content[start:end]


def _tag(content: bytes) -> str:
    return f'"{hashlib.md5(content, usedforsecurity=False).hexdigest()}"'


def _xml(name: str, content: str) -> Answer:
    text = f"<?xml version='1.0' encoding='UTF-8'?><{name}>{content}</{name}>"
    return "200 OK", {"Content-Type": "application/xml"}, text.encode()


def _error(status: str, code: str) -> Answer:
    return status, {"Content-Type": "application/xml"}, _xml("Error", f"<Code>{code}</Code>")[2]


@contextmanager
def serving_gcs(bucket: GcsBucket, faults: Faults) -> Iterator[str]:
    """The endpoint of a running server."""
    from werkzeug.serving import make_server

    server = make_server("127.0.0.1", 0, FaultyApplication(bucket, faults), threaded=True)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        thread.join(10)
