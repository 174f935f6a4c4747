"""Signed requests to an S3 store, for what obstore has no function: uploads in parts.

Credentials, region and endpoint are those of the environment, as obstore reads them.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import re
import time
import urllib.error
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from http.client import HTTPException
from typing import Final
from urllib.parse import quote, urlsplit

from daemon import DaemonError

TIMEOUT_S: Final = 30.0
"""Without an answer, or a byte of one."""
ATTEMPTS: Final = 4
_FIRST_PAUSE_S: Final = 0.1
_PAUSE_MAX_S: Final = 5.0
_ANSWER_MAX_BYTES: Final = 5_000_000
_CODE = re.compile(rb"<Code>(\w+)</Code>")


class S3RefusedError(DaemonError, OSError):
    """A request that the store refused; `code` is that of S3, such as NoSuchUpload."""

    def __init__(self, status: int, code: str) -> None:
        super().__init__(f"status code: {status} {code}")
        self.status, self.code = status, code


@dataclass(frozen=True)
class Credentials:
    """An access key of S3; `token` is empty for one without end."""

    key: str
    secret: str
    token: str = ""


@dataclass(frozen=True)
class S3Answer:
    """Body and entity tag of an answer, and the time of the store."""

    content: bytes
    now: datetime
    e_tag: str = ""


@dataclass(frozen=True)
class S3Folder:
    """A folder of a bucket: the bucket's address, and the prefix of its keys, ending in '/'."""

    bucket: str
    prefix: str
    credentials: Credentials

    @classmethod
    def of(cls, url: str) -> S3Folder | None:
        """The folder of an address; None without an access key in the environment.

        Args:
            url: such as "s3://bucket/missions/one".
        """
        parts, credentials = urlsplit(url), _credentials(os.environ)
        if credentials is None:
            return None
        prefix = parts.path.strip("/")
        bucket = _bucket_url(parts.netloc, os.environ)
        return cls(bucket, f"{prefix}/" if prefix else "", credentials)

    def request(
        self,
        method: str,
        name: str | None,
        query: Mapping[str, str],
        body: bytes = b"",
        *,
        attempts: int = ATTEMPTS,
        timeout_s: float = TIMEOUT_S,
    ) -> S3Answer:
        """The answer to a request; what passes is tried again.

        Args:
            method: such as GET.
            name: of an object below the folder; None for the bucket.
            query: parameters, not quoted.
            body: of the request.
            attempts: how often it is sent.
            timeout_s: of each attempt.

        Raises:
            S3RefusedError: the store refused.
            OSError, HTTPException: it did not answer in every attempt.
        """
        url = self.bucket if name is None else f"{self.bucket}/{quote(self.prefix + name)}"
        is_plain = os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true")
        if urlsplit(url).scheme != "https" and not is_plain:
            raise OSError("the endpoint has no TLS")
        body_sha256 = hashlib.sha256(body).hexdigest()
        for attempt in range(1, attempts + 1):
            headers = signed_headers(
                method, url, query, self.credentials,
                region=_region(os.environ), now=datetime.now(UTC), body_sha256=body_sha256,
            )  # fmt: skip
            if body:
                headers["content-type"] = "application/octet-stream"
            asked = urllib.request.Request(
                f"{url}?{query_text(query)}", data=body or None, method=method, headers=headers
            )
            try:
                with urllib.request.urlopen(asked, timeout=timeout_s) as answer:
                    date = answer.headers["Date"]
                    now = parsedate_to_datetime(date) if date else datetime.now(UTC)
                    content = answer.read(_ANSWER_MAX_BYTES)
                    e_tag = (answer.headers["ETag"] or "").strip('"')
                    return S3Answer(content, now.astimezone(UTC), e_tag)
            except urllib.error.HTTPError as error:
                refused = _refusal(error)
                if error.code < 500 or attempt == attempts:
                    raise refused from error
            except (OSError, HTTPException):
                if attempt == attempts:
                    raise
            time.sleep(min(_PAUSE_MAX_S, _FIRST_PAUSE_S * 2**attempt))
        raise AssertionError  # the last attempt returns or raises


def signed_headers(
    method: str,
    url: str,
    query: Mapping[str, str],
    credentials: Credentials,
    *,
    region: str,
    now: datetime,
    body_sha256: str = hashlib.sha256(b"").hexdigest(),
) -> dict[str, str]:
    """Headers of a request.

    Args:
        method: such as GET.
        url: without a query; its path is quoted.
        query: parameters, not quoted.
        credentials: of the user.
        region: of the bucket.
        now: instant of the request, UTC.
        body_sha256: of its body; the store compares it.

    Source: Amazon S3 API Reference, Signature Version 4, "Authenticating Requests: Using the
    Authorization Header".
    """
    parts = urlsplit(url)
    headers = {
        "host": parts.netloc,
        "x-amz-content-sha256": body_sha256,
        "x-amz-date": f"{now:%Y%m%dT%H%M%SZ}",
        **({"x-amz-security-token": credentials.token} if credentials.token else {}),
    }
    names = ";".join(headers)
    lines = [method, parts.path or "/", query_text(query)]
    lines += [f"{name}:{value}" for name, value in headers.items()]
    canonical = "\n".join([*lines, "", names, body_sha256])
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


def _refusal(error: urllib.error.HTTPError) -> S3RefusedError:
    try:
        found = _CODE.search(error.read(_ANSWER_MAX_BYTES))
    except (OSError, HTTPException):
        found = None
    return S3RefusedError(error.code, found[1].decode() if found else str(error.reason))


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
