"""HTTP and WebSocket protocols of uvicorn, with limits.

Requests are refused here before the application runs and before a token is checked: bodies of
unknown or excessive length, compressed or unexpected bodies, and clients that send too much.
"""

from __future__ import annotations

import http
import json
import logging
import time
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from daemon.onboard.monitoring.web.request_body import BODY_MAX_BYTES

HEAD_MAX_BYTES = 16_384
"""Request line and headers."""
HEADERS_MAX = 64
SLICE_BYTES = 16_384
"""Bytes parsed at a time, so that the limits are checked in between."""
MESSAGE_MAX_BYTES = 4096
"""Limit of a WebSocket message; clients send none."""
RECEIVED_BURST_BYTES, RECEIVED_BYTES_PER_S = 2 * HEAD_MAX_BYTES, 1024
"""Per client, header and frames; pong frames take a few bytes per second."""
LOGGED_PER_S, LOGGED_BURST = 0.1, 10
PROBLEM_JSON = b"application/problem+json"


class LimitedHttp(H11Protocol):
    """HTTP/1.1 with limits."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._limited = _LimitedConnection(h11.SERVER, HEAD_MAX_BYTES)
        self.conn = self._limited

    def data_received(self, data: bytes) -> None:
        for start in range(0, len(data), SLICE_BYTES):
            if self.transport.is_closing():
                return
            # After an upgrade the transport belongs to another protocol.
            protocol: Any = self.transport.get_protocol()
            part = data[start : start + SLICE_BYTES]
            if protocol is self:
                super().data_received(part)
            else:
                protocol.data_received(part)

    def send_400_response(self, msg: str) -> None:
        """Answer a request that is not served, and close; called by uvicorn."""
        status, detail = self._limited.refusal or (400, msg)
        phrase = http.HTTPStatus(status).phrase
        problem = {"type": "about:blank", "title": phrase, "status": status, "detail": detail}
        headers = [(b"content-type", PROBLEM_JSON), (b"connection", b"close")]
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            for event in (
                h11.Response(status_code=status, headers=headers, reason=phrase.encode()),
                h11.Data(data=json.dumps(problem).encode()),
                h11.EndOfMessage(),
            ):
                self.transport.write(self.conn.send(event) or b"")
        self.transport.close()


class _LimitedConnection(h11.Connection):
    """Refuses a request by its header, before anything of its body is read."""

    refusal: tuple[int, str] | None = None

    def next_event(self) -> Any:
        event = super().next_event()
        if isinstance(event, h11.Request):
            self.refusal = _refusal(event)
            if self.refusal is not None:
                raise h11.RemoteProtocolError(self.refusal[1])
        return event


def _refusal(request: h11.Request) -> tuple[int, str] | None:
    headers = list(request.headers)
    named = {name.lower(): value for name, value in headers}
    if len(headers) > HEADERS_MAX:
        return 431, f"{len(headers)} headers; {HEADERS_MAX} are allowed"
    if b"transfer-encoding" in named:
        return 411, "the length of the body is not known; send Content-Length"
    length = int(named.get(b"content-length", b"0"))
    if length > BODY_MAX_BYTES:
        return 413, f"a body of {length} bytes; {BODY_MAX_BYTES} are allowed"
    if length and request.method != b"POST":
        return 413, f"{request.method.decode('ascii')} takes no body"
    if named.get(b"content-encoding", b"identity").lower() != b"identity":
        return 415, "the body is compressed; send it as it is"
    return None


class LimitedWebSocket(WebSocketsSansIOProtocol):
    """WebSocket with a limit on received bytes."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._allowed_bytes = float(RECEIVED_BURST_BYTES)
        self._then_s = time.monotonic()

    def data_received(self, data: bytes) -> None:
        now_s = time.monotonic()
        gained = (now_s - self._then_s) * RECEIVED_BYTES_PER_S
        self._allowed_bytes = min(self._allowed_bytes + gained, RECEIVED_BURST_BYTES)
        self._then_s = now_s
        self._allowed_bytes -= len(data)
        if self._allowed_bytes < 0:
            self.transport.abort()
            return
        super().data_received(data)


class RateLimitFilter(logging.Filter):
    """Limits the rate of log records, so that unknown senders cannot fill the log."""

    def __init__(self) -> None:
        super().__init__()
        self._allowed = float(LOGGED_BURST)
        self._then_s = time.monotonic()

    def filter(self, record: logging.LogRecord) -> bool:
        now_s = time.monotonic()
        self._allowed += (now_s - self._then_s) * LOGGED_PER_S
        self._allowed = min(self._allowed, LOGGED_BURST)
        self._then_s = now_s
        if self._allowed < 1.0:
            return False
        self._allowed -= 1.0
        return True
