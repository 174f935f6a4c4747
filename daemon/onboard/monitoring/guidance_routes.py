"""Guidance for page and pilot over a WebSocket of its own, newest frame first.

A client answers each frame with its number. At most `WINDOW` frames are under way, so that a slow
or lossy link loses rate and never builds a queue: what is shown is never older than the link makes
it. The state has no queue either; a frame that was not sent is replaced by the next one.
"""

from __future__ import annotations

import asyncio
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from fastapi import FastAPI, WebSocket
from fastapi.responses import FileResponse
from starlette.websockets import WebSocketDisconnect

from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.monitoring.web.watch_admission import WatchAccess, admit_watcher

TICK_S: Final = 0.02
WINDOW: Final = 6
"""Frames without an answer: 5 Hz over a round trip of 1.2 s."""
KEEPALIVE_S: Final = 1.0
"""Without a new frame the last one is sent again with its age."""
SEND_TIMEOUT_S: Final = 5.0


@dataclass
class FrameWindow:
    """Which frame is due for one client, and the round trip of those it answered.

    Attributes:
        rtt_s: smoothed round trip, s; None before the first answer.
    """

    rtt_s: float | None = None
    _number: int = 0
    _sent_s: dict[int, float] = field(default_factory=dict)
    _last_count: int = -1
    _last_sent_s: float = float("-inf")

    def frame(self, state: FlightState, now_s: float, now_ns: int) -> dict[str, Any] | None:
        """The next frame with its number and age; None if none is due or the window is full.

        Args:
            state: the state of the flight.
            now_s: time of any monotonic clock, s.
            now_ns: CLOCK_MONOTONIC, ns, as in the sample.

        Returns:
            The frame.
        """
        if not state.guidance or len(self._sent_s) >= WINDOW:
            return None
        is_new = state.guidance_count != self._last_count
        if not is_new and now_s - self._last_sent_s < KEEPALIVE_S:
            return None
        self._number += 1
        self._sent_s[self._number] = self._last_sent_s = now_s
        self._last_count = state.guidance_count
        age_s = (now_ns - int(state.guidance["sample_mono_ns"])) * 1e-9
        content = {key: value for key, value in state.guidance.items() if key != "sample_mono_ns"}
        return {
            "frame": self._number,
            "age_s": round(age_s, 3),
            "rtt_s": None if self.rtt_s is None else round(self.rtt_s, 3),
            **content,
        }

    def answered(self, text: str, now_s: float) -> None:
        """Note an answer; text that is no number of a frame is ignored."""
        if not (text.isascii() and text.isdecimal() and len(text) < 16):
            return
        number = int(text)
        sent_s = self._sent_s.get(number)
        if sent_s is None:
            return
        for earlier in [one for one in self._sent_s if one <= number]:
            del self._sent_s[earlier]
        rtt_s = now_s - sent_s
        self.rtt_s = rtt_s if self.rtt_s is None else 0.8 * self.rtt_s + 0.2 * rtt_s


def add_guidance(app: FastAPI, state: FlightState, access: WatchAccess, page: Path) -> None:
    """Add the routes; `access` authorizes and counts readers, `page` is the pilot's."""

    @app.get("/pilot", include_in_schema=False)
    async def pilot() -> FileResponse:
        return FileResponse(page)

    @app.websocket("/api/v1/guidance")
    async def guidance(socket: WebSocket) -> None:
        """Frames as in docs/reference/flight/guidance.md, until the client disconnects."""
        if not await admit_watcher(socket, access):
            return
        window = FrameWindow()
        answers = asyncio.ensure_future(_read_answers(socket, window))
        try:
            while not answers.done():
                frame = window.frame(state, time.monotonic(), time.monotonic_ns())
                if frame is not None:
                    await asyncio.wait_for(socket.send_json(frame), SEND_TIMEOUT_S)
                await asyncio.wait([answers], timeout=TICK_S)
        except (TimeoutError, WebSocketDisconnect, RuntimeError):
            pass  # it stalled or disconnected
        finally:
            answers.cancel()
            with suppress(RuntimeError, WebSocketDisconnect):
                await socket.close()


async def _read_answers(socket: WebSocket, window: FrameWindow) -> None:
    with suppress(WebSocketDisconnect, RuntimeError, KeyError):
        while True:
            window.answered(await socket.receive_text(), time.monotonic())
