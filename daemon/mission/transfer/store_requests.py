"""Requests to an object store for what obstore has no function: uploads in parts."""

from __future__ import annotations

import os
import re
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from http.client import HTTPException
from typing import Final
from urllib.parse import urlsplit

from daemon import DaemonError

TIMEOUT_S: Final = 30.0
"""Without an answer, or a byte of one."""
ATTEMPTS: Final = 4
ALLOW_HTTP: Final = {
    "s3": "AWS_ALLOW_HTTP",
    "gs": "GOOGLE_ALLOW_HTTP",
    "az": "AZURE_ALLOW_HTTP",
}
"""Variables that permit requests without TLS."""
_PASSING: Final = frozenset({408, 429})
"""Statuses below 500 after which the same request may succeed: time-out and throttling."""
_FIRST_PAUSE_S: Final = 0.1
_PAUSE_MAX_S: Final = 5.0
_ANSWER_MAX_BYTES: Final = 5_000_000
_CODE = re.compile(rb"<Code>(\w+)</Code>")


class StoreRefusedError(DaemonError, OSError):
    """A request that the store refused; `code` is that of the store, such as NoSuchUpload."""

    def __init__(self, status: int, code: str) -> None:
        super().__init__(f"status code: {status} {code}")
        self.status, self.code = status, code


@dataclass(frozen=True)
class StoreAnswer:
    """Body and entity tag of an answer, and the time of the store."""

    content: bytes
    now: datetime
    e_tag: str = ""


def is_http_permitted(scheme: str) -> bool:
    """Whether the environment permits requests to a kind of store without TLS.

    Args:
        scheme: s3, gs or az.
    """
    return os.environ.get(ALLOW_HTTP[scheme], "").lower() in ("1", "true")


def answer_to(
    signed: Callable[[], urllib.request.Request],
    scheme: str,
    *,
    attempts: int = ATTEMPTS,
    timeout_s: float = TIMEOUT_S,
) -> StoreAnswer:
    """The answer to a request; what passes is tried again.

    Args:
        signed: the request, with a signature of now.
        scheme: s3, gs or az.
        attempts: how often it is sent.
        timeout_s: of each attempt.

    Raises:
        StoreRefusedError: the store refused.
        OSError, HTTPException: it did not answer in every attempt.
    """
    for attempt in range(1, attempts + 1):
        asked = signed()
        if urlsplit(asked.full_url).scheme != "https" and not is_http_permitted(scheme):
            raise OSError("the endpoint has no TLS")
        try:
            with urllib.request.urlopen(asked, timeout=timeout_s) as answer:
                date = answer.headers["Date"]
                now = parsedate_to_datetime(date) if date else datetime.now(UTC)
                content = answer.read(_ANSWER_MAX_BYTES)
                e_tag = (answer.headers["ETag"] or "").strip('"')
                return StoreAnswer(content, now.astimezone(UTC), e_tag)
        except urllib.error.HTTPError as error:
            refused = _refusal(error)
            is_passing = error.code >= 500 or error.code in _PASSING
            if not is_passing or attempt == attempts:
                raise refused from error
        except (OSError, HTTPException):
            if attempt == attempts:
                raise
        time.sleep(min(_PAUSE_MAX_S, _FIRST_PAUSE_S * 2**attempt))
    raise AssertionError  # the last attempt returns or raises


def _refusal(error: urllib.error.HTTPError) -> StoreRefusedError:
    try:
        found = _CODE.search(error.read(_ANSWER_MAX_BYTES))
    except (OSError, HTTPException):
        found = None
    return StoreRefusedError(error.code, found[1].decode() if found else str(error.reason))
