"""moto's S3 server on a loopback port, behind a layer that injects faults into requests.

The server is a peer; the layer is WSGI and knows nothing of the client. A seeded generator draws
the faults: refused before the request (500, 503, or by a code of S3's such as ExpiredToken), an
answer lost after the request was done, no answer within the client's time, a late answer, and a
body that ends early.
"""

from __future__ import annotations

import io
import random
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

REFUSALS = {
    "500": ("500 Internal Server Error", "InternalError"),
    "503": ("503 Slow Down", "SlowDown"),
    "ExpiredToken": ("400 Bad Request", "ExpiredToken"),
    "RequestTimeTooSkewed": ("403 Forbidden", "RequestTimeTooSkewed"),
    "AccessDenied": ("403 Forbidden", "AccessDenied"),
}
"""Status and code of faults that refuse a request."""
REGION = "eu-central-1"
BUCKET = "survey"


@dataclass
class Faults:
    """Which requests fail, and what was counted.

    `shares` are drawn by chance. `every` fails each n-th request of a method, with the faults of
    `kinds` in turn: the count does not depend on the order of threads. `sent` is the number of body
    bytes of PUT requests by object, `largest` the largest body.
    """

    shares: dict[str, float] = field(default_factory=dict)
    seed: int = 1
    every: int = 0
    kinds: tuple[str, ...] = ()
    hang_s: float = 3.0
    counts: Counter[str] = field(default_factory=Counter)
    sent: Counter[str] = field(default_factory=Counter)
    largest: int = 0
    is_for: Callable[[str, str], bool] = lambda _method, _path: True

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)
        self._lock = threading.Lock()
        self._requests: Counter[str] = Counter()

    def draw(self, method: str, path: str) -> str:
        """The fault of a request; "" for none."""
        with self._lock:
            value = self._random.random()
            if not self.is_for(method, path):
                return ""
            if self.every:
                return self._in_turn(method)
            for fault, share in self.shares.items():
                if fault == "truncated" and method != "GET":
                    continue
                if value < share:
                    self.counts[fault] += 1
                    return fault
                value -= share
            return ""

    def _in_turn(self, method: str) -> str:
        self._requests[method] += 1
        number, rest = divmod(self._requests[method], self.every)
        kinds = [kind for kind in self.kinds if kind != "truncated" or method == "GET"]
        if rest:
            return ""
        fault = kinds[number % len(kinds)]
        self.counts[fault] += 1
        return fault


class FaultyApplication:
    """WSGI middleware."""

    def __init__(self, application: Any, faults: Faults) -> None:
        self._application, self._faults = application, faults

    def __call__(self, environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        method, path = environ["REQUEST_METHOD"], environ["PATH_INFO"]
        body = _body(environ)
        environ["wsgi.input"] = io.BytesIO(body)
        environ["CONTENT_LENGTH"] = str(len(body))
        if method == "PUT":
            self._faults.sent[path] += len(body)
            self._faults.largest = max(self._faults.largest, len(body))
        fault = self._faults.draw(method, path)
        if fault in REFUSALS:
            return _refuse(start_response, fault)
        if fault == "hang":
            time.sleep(self._faults.hang_s)
            return _refuse(start_response, "500")
        if fault == "slow":
            time.sleep(self._faults.hang_s)
        if fault == "lost answer":
            list(self._application(environ, lambda *_arguments: None))
            return _refuse(start_response, "500")
        answer: Iterable[bytes] = self._application(environ, start_response)
        if fault == "truncated":
            content = b"".join(answer)
            return [content[: len(content) // 2]]
        return answer


def _body(environ: dict[str, Any]) -> bytes:
    if environ.get("CONTENT_LENGTH"):
        return bytes(environ["wsgi.input"].read(int(environ["CONTENT_LENGTH"])))
    return bytes(environ["wsgi.input"].read()) if environ.get("wsgi.input_terminated") else b""


def _refuse(start_response: Any, fault: str) -> list[bytes]:
    status, code = REFUSALS[fault]
    content = f"<Error><Code>{code}</Code><Message>injected</Message></Error>".encode()
    start_response(
        status,
        [("Content-Type", "application/xml"), ("Content-Length", str(len(content)))],
    )
    return [content]


@contextmanager
def serving(faults: Faults) -> Iterator[str]:
    """The endpoint of a running server with one empty bucket."""
    from moto.server import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import make_server

    application = DomainDispatcherApplication(create_backend_app)
    server = make_server("127.0.0.1", 0, FaultyApplication(application, faults), threaded=True)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    endpoint = f"http://127.0.0.1:{server.server_port}"
    shares, every = faults.shares, faults.every
    faults.shares, faults.every = {}, 0
    try:
        import boto3

        client = boto3.client(
            "s3", endpoint_url=endpoint, region_name=REGION,
            aws_access_key_id="test", aws_secret_access_key="test",
        )  # fmt: skip
        for one in client.list_buckets()["Buckets"]:
            for item in client.list_objects_v2(Bucket=one["Name"]).get("Contents", ()):
                client.delete_object(Bucket=one["Name"], Key=item["Key"])
            client.delete_bucket(Bucket=one["Name"])
        client.create_bucket(
            Bucket=BUCKET, CreateBucketConfiguration={"LocationConstraint": REGION}
        )
        faults.shares, faults.every = shares, every
        faults.sent.clear()
        yield endpoint
    finally:
        server.shutdown()
        thread.join(10)
