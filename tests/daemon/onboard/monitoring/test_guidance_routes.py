"""Guidance never queues: a client that does not answer gets no more than a window of frames."""

from __future__ import annotations

from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.monitoring.guidance_routes import KEEPALIVE_S, WINDOW, FrameWindow

NS = 1_000_000_000


def state_with(number: int = 1) -> FlightState:
    state = FlightState("test")
    for k in range(number):
        state.apply({"event": "guidance", "sample_mono_ns": str(k * NS), "line": f"A{k}"})
    return state


def test_the_newest_frame_is_sent_with_its_age() -> None:
    state, window = state_with(3), FrameWindow()
    assert state.sequence == 0, "guidance is no event of the telemetry"
    frame = window.frame(state, 0.0, 2 * NS + 250_000_000)
    assert frame is not None
    assert (frame["line"], frame["age_s"], frame["frame"]) == ("A2", 0.25, 1)
    assert "sample_mono_ns" not in frame
    assert window.frame(state, 0.1, 3 * NS) is None, "nothing new"


def test_without_news_the_last_frame_comes_again_and_is_older() -> None:
    state, window = state_with(), FrameWindow()
    window.frame(state, 0.0, NS)
    window.answered("1", 0.1)
    again = window.frame(state, KEEPALIVE_S, 5 * NS)
    assert again is not None
    assert again["age_s"] == 5.0
    assert again["rtt_s"] == 0.1


def test_a_silent_client_gets_one_window_of_frames() -> None:
    state, window = state_with(), FrameWindow()
    sent = 0
    for k in range(50):
        state.apply({"event": "guidance", "sample_mono_ns": "0", "line": "A"})
        sent += window.frame(state, 0.2 * k, NS) is not None
    assert sent == WINDOW
    window.answered(str(WINDOW), 20.0)
    assert window.frame(state, 20.0, NS) is not None


def test_answers_that_are_none_are_ignored() -> None:
    state, window = state_with(), FrameWindow()
    window.frame(state, 0.0, NS)
    for text in ("", "x", "-1", "99", "1" * 40, "٣"):
        window.answered(text, 1.0)
    assert window.rtt_s is None


def test_before_the_first_sample_there_is_no_frame() -> None:
    assert FrameWindow().frame(FlightState("test"), 0.0, NS) is None
