"""Uploads in parts that a killed command left in an S3 store: listed and aborted.

Their parts are stored and paid for, and no listing of objects shows them. obstore has no request
for them; the two requests are signed here, with the credentials of the environment. Google and
Azure are not asked: a rule of the bucket ends such uploads there, Azure discards them after a week.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from http.client import HTTPException
from typing import Final
from urllib.parse import quote, urlsplit
from xml.etree import ElementTree

from daemon.mission.foreign_xml import parse_xml

AGE_MIN_S: Final = 3600.0
"""Uploads that began later may be of a command that runs now, and are left."""
TIMEOUT_S: Final = 30.0
ATTEMPTS: Final = 4
_FIRST_PAUSE_S: Final = 0.1
_ANSWER_MAX_BYTES: Final = 5_000_000
_ELEMENTS_MAX: Final = 50_000
_RULE: Final = "give the bucket a rule AbortIncompleteMultipartUpload"
_NO_BODY: Final = hashlib.sha256(b"").hexdigest()


@dataclass(frozen=True)
class UnfinishedUploads:
    """What was found below a folder: names of aborted and of recent uploads, and what failed."""

    aborted: tuple[str, ...] = ()
    recent: tuple[str, ...] = ()
    problem: str = ""

    @property
    def sentence(self) -> str:
        """For a person; empty where there is nothing to state."""
        parts = []
        if self.aborted:
            parts.append(f"{len(self.aborted)} unfinished uploads of an earlier run were aborted.")
        if self.recent:
            parts.append(
                f"{len(self.recent)} unfinished uploads are younger than {AGE_MIN_S / 3600:.0f} h "
                f"and are left, such as {self.recent[0]}; run the same command again later."
            )
        return " ".join([*parts, *([self.problem] if self.problem else [])])


@dataclass(frozen=True)
class Credentials:
    """An access key of S3; `token` is empty for one without end."""

    key: str
    secret: str
    token: str = ""


def abort_unfinished(url: str, is_own: Callable[[str], bool]) -> UnfinishedUploads:
    """Abort uploads that began more than `AGE_MIN_S` ago, by the clock of the store.

    A failure never ends the command: its sentence is in the result.

    Args:
        url: of a folder, such as "s3://bucket/missions/one".
        is_own: whether an object of this name below the folder is written by these commands.
    """
    parts = urlsplit(url)
    credentials = _credentials(os.environ)
    if parts.scheme != "s3":
        return UnfinishedUploads()
    if credentials is None:
        return UnfinishedUploads(
            problem="Unfinished uploads were not looked for, because AWS_ACCESS_KEY_ID is not set: "
            f"{_RULE}."
        )
    prefix = parts.path.strip("/")
    bucket = _bucket_url(parts.netloc, os.environ)
    aborted: list[str] = []
    recent: list[str] = []
    try:
        uploads, now = _listed(bucket, f"{prefix}/" if prefix else "", credentials)
        for key, upload, begun in uploads:
            name = key[len(prefix) + 1 :] if prefix else key
            if not is_own(name):
                continue
            if (now - begun).total_seconds() < AGE_MIN_S:
                recent.append(name)
                continue
            try:
                _request("DELETE", bucket, key, {"uploadId": upload}, credentials)
            except urllib.error.HTTPError as error:
                if error.code != 404:  # it ended meanwhile
                    raise
            aborted.append(name)
    except (OSError, HTTPException, ValueError) as error:
        return UnfinishedUploads(
            tuple(aborted),
            tuple(recent),
            f"Unfinished uploads below {url} could not be listed or aborted ({error}). Permit "
            f"s3:ListBucketMultipartUploads and s3:AbortMultipartUpload, or {_RULE}.",
        )
    return UnfinishedUploads(tuple(aborted), tuple(recent))


def signed_headers(
    method: str,
    url: str,
    query: Mapping[str, str],
    credentials: Credentials,
    *,
    region: str,
    now: datetime,
) -> dict[str, str]:
    """Headers of a request without body.

    Args:
        method: such as GET.
        url: without a query; its path is quoted.
        query: parameters, not quoted.
        credentials: of the user.
        region: of the bucket.
        now: instant of the request, UTC.

    Source: Amazon S3 API Reference, Signature Version 4, "Authenticating Requests: Using the
    Authorization Header".
    """
    parts = urlsplit(url)
    headers = {
        "host": parts.netloc,
        "x-amz-content-sha256": _NO_BODY,
        "x-amz-date": f"{now:%Y%m%dT%H%M%SZ}",
        **({"x-amz-security-token": credentials.token} if credentials.token else {}),
    }
    names = ";".join(headers)
    lines = [method, parts.path or "/", query_text(query)]
    lines += [f"{name}:{value}" for name, value in headers.items()]
    canonical = "\n".join([*lines, "", names, _NO_BODY])
    scope = f"{now:%Y%m%d}/{region}/s3/aws4_request"
    hashed = hashlib.sha256(canonical.encode()).hexdigest()
    text = f"AWS4-HMAC-SHA256\n{headers['x-amz-date']}\n{scope}\n{hashed}"
    key = f"AWS4{credentials.secret}".encode()
    for part in scope.split("/"):
        key = hmac.digest(key, part.encode(), "sha256")
    signature = hmac.digest(key, text.encode(), "sha256").hex()
    headers["authorization"] = (
        f"AWS4-HMAC-SHA256 Credential={credentials.key}/{scope},SignedHeaders={names},"
        f"Signature={signature}"
    )
    return headers


def query_text(query: Mapping[str, str]) -> str:
    """Parameters as they are signed and sent: quoted, sorted by name."""
    return "&".join(f"{quote(n, safe='')}={quote(v, safe='')}" for n, v in sorted(query.items()))


def _credentials(environment: Mapping[str, str]) -> Credentials | None:
    key, secret = (environment.get(f"AWS_{n}", "") for n in ("ACCESS_KEY_ID", "SECRET_ACCESS_KEY"))
    token = environment.get("AWS_SESSION_TOKEN") or environment.get("AWS_TOKEN") or ""
    return Credentials(key, secret, token) if key and secret else None


def _region(environment: Mapping[str, str]) -> str:
    return environment.get("AWS_REGION") or environment.get("AWS_DEFAULT_REGION") or "us-east-1"


def _bucket_url(bucket: str, environment: Mapping[str, str]) -> str:
    """The address of a bucket, as obstore has it."""
    own = environment.get("AWS_ENDPOINT_URL") or environment.get("AWS_ENDPOINT")
    is_virtual = environment.get("AWS_VIRTUAL_HOSTED_STYLE_REQUEST", "").lower() in ("1", "true")
    if own:
        return own.rstrip("/") if is_virtual else f"{own.rstrip('/')}/{bucket}"
    host = f"s3.{_region(environment)}.amazonaws.com"
    return f"https://{bucket}.{host}" if is_virtual else f"https://{host}/{bucket}"


def _listed(
    bucket: str, prefix: str, credentials: Credentials
) -> tuple[list[tuple[str, str, datetime]], datetime]:
    """Key, id and begin of every unfinished upload, and the time of the store."""
    found: list[tuple[str, str, datetime]] = []
    query = {"uploads": "", "prefix": prefix}
    while True:
        content, now = _request("GET", bucket, "", query, credentials)
        root = parse_xml(content, elements_max=_ELEMENTS_MAX)
        for one in root.iterfind("{*}Upload"):
            begun = datetime.fromisoformat(_text(one, "Initiated")).astimezone(UTC)
            key = _text(one, "Key")
            if key.startswith(prefix):
                found.append((key, _text(one, "UploadId"), begun))
        marker = root.findtext("{*}NextKeyMarker") or ""
        last = root.findtext("{*}NextUploadIdMarker") or ""
        is_cut = root.findtext("{*}IsTruncated") == "true"
        if not is_cut or (marker, last) == (query.get("key-marker"), query.get("upload-id-marker")):
            return found, now
        query |= {"key-marker": marker, "upload-id-marker": last}


def _text(element: ElementTree.Element, name: str) -> str:
    text = element.findtext(f"{{*}}{name}")
    if not text:
        raise ValueError(f"the answer has an upload without {name}")
    return text


def _request(
    method: str, bucket: str, key: str, query: Mapping[str, str], credentials: Credentials
) -> tuple[bytes, datetime]:
    """The answer to a request, and the time of the store; what passes is tried again.

    Raises:
        OSError, HTTPException: the store refused, or did not answer in every attempt.
    """
    url = f"{bucket}/{quote(key)}" if key else bucket
    is_plain = os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true")
    if urlsplit(url).scheme != "https" and not is_plain:
        raise OSError("the endpoint has no TLS")
    for attempt in range(1, ATTEMPTS + 1):
        headers = signed_headers(
            method, url, query, credentials, region=_region(os.environ), now=datetime.now(UTC)
        )
        asked = urllib.request.Request(f"{url}?{query_text(query)}", method=method, headers=headers)
        try:
            with urllib.request.urlopen(asked, timeout=TIMEOUT_S) as answer:
                date = answer.headers["Date"]
                now = parsedate_to_datetime(date) if date else datetime.now(UTC)
                return answer.read(_ANSWER_MAX_BYTES), now.astimezone(UTC)
        except (OSError, HTTPException) as error:
            is_final = isinstance(error, urllib.error.HTTPError) and error.code < 500
            if is_final or attempt == ATTEMPTS:
                raise
        time.sleep(_FIRST_PAUSE_S * 2**attempt)
    raise AssertionError  # the last attempt returns or raises
