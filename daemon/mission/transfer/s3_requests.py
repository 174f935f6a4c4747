"""Signed requests to S3 and to Google Cloud Storage, whose XML interface accepts the same ones.

Credentials, region and endpoint are those of the environment, as obstore reads them; the key for
Google, an HMAC key, has the names that GDAL gives it.

Source: Google Cloud Storage, Simple migration from Amazon S3.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final
from urllib.parse import quote, urlsplit

from daemon.mission.transfer.store_requests import ATTEMPTS, TIMEOUT_S, StoreAnswer, answer_to

KEY_NAMES: Final = {
    "s3": ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"),
    "gs": ("GS_ACCESS_KEY_ID", "GS_SECRET_ACCESS_KEY"),
}
"""Variables with the access key, by scheme of the address."""
_GOOGLE: Final = "https://storage.googleapis.com"


@dataclass(frozen=True)
class Credentials:
    """An access key of S3; `token` is empty for one without end."""

    key: str
    secret: str
    token: str = ""


@dataclass(frozen=True)
class S3Folder:
    """A folder of a bucket: the bucket's address, and the prefix of its keys, ending in '/'."""

    bucket: str
    prefix: str
    credentials: Credentials
    region: str
    scheme: str = "s3"

    @classmethod
    def of(cls, url: str) -> S3Folder | None:
        """The folder of an address; None without an access key in the environment.

        Args:
            url: such as "s3://bucket/missions/one" or "gs://bucket/missions/one".
        """
        parts = urlsplit(url)
        scheme = parts.scheme
        credentials = _credentials(scheme, os.environ)
        if credentials is None:
            return None
        prefix = parts.path.strip("/")
        prefix = f"{prefix}/" if prefix else ""
        if scheme == "gs":
            base = os.environ.get("GOOGLE_BASE_URL", "").rstrip("/") or _GOOGLE
            return cls(f"{base}/{parts.netloc}", prefix, credentials, "auto", scheme)
        bucket = _bucket_url(parts.netloc, os.environ)
        return cls(bucket, prefix, credentials, _region(os.environ))

    def request(
        self,
        method: str,
        name: str | None,
        query: Mapping[str, str],
        body: bytes = b"",
        *,
        attempts: int = ATTEMPTS,
        timeout_s: float = TIMEOUT_S,
    ) -> StoreAnswer:
        """The answer to a request; what passes is tried again.

        Args:
            method: such as GET.
            name: of an object below the folder; None for the bucket.
            query: parameters, not quoted.
            body: of the request.
            attempts: how often it is sent.
            timeout_s: of each attempt.

        Raises:
            StoreRefusedError: the store refused.
            OSError, HTTPException: it did not answer in every attempt.
        """
        url = self.bucket if name is None else f"{self.bucket}/{quote(self.prefix + name)}"
        body_sha256 = hashlib.sha256(body).hexdigest()

        def signed() -> urllib.request.Request:
            headers = signed_headers(
                method, url, query, self.credentials,
                region=self.region, now=datetime.now(UTC), body_sha256=body_sha256,
            )  # fmt: skip
            if body:
                headers["content-type"] = "application/octet-stream"
            return urllib.request.Request(
                f"{url}?{query_text(query)}", data=body or None, method=method, headers=headers
            )

        return answer_to(signed, self.scheme, attempts=attempts, timeout_s=timeout_s)


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


def _credentials(scheme: str, environment: Mapping[str, str]) -> Credentials | None:
    key, secret = (environment.get(name, "") for name in KEY_NAMES[scheme])
    token = environment.get("AWS_SESSION_TOKEN") or environment.get("AWS_TOKEN") or ""
    return Credentials(key, secret, token if scheme == "s3" else "") if key and secret else None


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
