"""The path of one frame through the code is the one of docs/explanation/architecture.md."""

from __future__ import annotations

import re
import sys
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from daemon.onboard.pipeline import worker
from daemon.onboard.service import messages, service
from daemon.onboard.service.flight_line import FlightLine, Order
from daemon.onboard.service.message_dispatcher import MessageDispatcher
from daemon.onboard.service.supervisor import Supervisor
from daemon.products.exposure_products import ExposureProducts
from tests.daemon.onboard.service.flight_parts import Planted, in_threads, run

ROOT = Path(__file__).parents[4]
PAGE = ROOT / "docs/explanation/architecture.md"
ANY_ORDER = {"Frame", "Fired"}
"""A software trigger answers after the first frames."""
TRANSPORT = {"daemon/onboard/service/processes.py", "daemon/onboard/service/messages.py"}
OTHER_EVENTS = re.compile(
    r"/(fault_latches|event_table|devices|device_states|arming|phases|preflight|mirror|notify|operator_journal|triangulation_link)\.py$"
)
"""What follows the state of devices, disks, faults and operators."""


@pytest.fixture
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Planted]:
    made = Planted(tmp_path, monkeypatch)
    made.change("count = 3", "count = 1")
    made.change("ready_timeout_s = 1.0", "ready_timeout_s = 20.0")
    for cone in "AB":
        made.frames(cone)
    made.write()
    in_threads(made)
    monkeypatch.setattr(worker, "make_products", _small_products)
    monkeypatch.setattr(service, "PING_S", 60.0)  # what runs once a second runs once
    yield made
    sys.setprofile(None)
    # typeshed does not know that None ends profiling.
    threading.setprofile(None)  # type: ignore[arg-type]


def _small_products(*arguments: Any, **further: Any) -> ExposureProducts:
    further["frames_read"]()
    report: dict[str, Any] = {"verdict": "good", "flags": [], "exposure": arguments[2].number}
    return ExposureProducts(report, {"quality.json": [b"{}"]}, {})


class ObservedPath:
    """Files that ran, and messages that were exchanged, from the order of one exposure."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.files: set[str] = set()
        self.messages: list[str] = []
        self._is_on = False
        send, dispatch = Supervisor.send, MessageDispatcher.dispatch
        order = FlightLine.order

        def begin(line: FlightLine, now_ns: int) -> Order:
            self._is_on = True
            return order(line, now_ns)

        def sent(supervisor: Supervisor, name: str, message: object) -> None:
            self._note(message)
            send(supervisor, name, message)

        def received(dispatcher: MessageDispatcher, message: object) -> None:
            self._note(message)
            dispatch(dispatcher, message)
            self._is_on &= not isinstance(message, messages.Processed)

        monkeypatch.setattr(FlightLine, "order", begin)
        monkeypatch.setattr(Supervisor, "send", sent)
        monkeypatch.setattr(MessageDispatcher, "dispatch", received)
        threading.setprofile(self._called)
        sys.setprofile(self._called)

    def _note(self, message: object) -> None:
        name = type(message).__name__
        if self._is_on and name not in self.messages:
            self.messages.append(name)

    def _called(self, frame: FrameType, event: str, _: object) -> None:
        if event == "call" and self._is_on:
            self.files.add(frame.f_code.co_filename)


def documented() -> tuple[list[str], set[str]]:
    """Messages in the order of the steps, and the files that the page names."""
    text = PAGE.read_text("utf-8")
    path = text[text.index("## The path of one frame") : text.index("## The pipeline")]
    rows = "\n".join(line for line in path.splitlines() if re.match(r"\| \d+\.", line))
    names = re.findall(r"`([A-Z]\w+)`", rows)
    known: Mapping[str, object] = vars(messages) | {"Frame": None}
    in_order = [name for name in dict.fromkeys(names) if name in known]
    return in_order, set(re.findall(r"`(daemon/[\w/]+\.py)`", path))


@pytest.mark.trust
def test_one_exposure_takes_the_documented_path(
    planted: Planted, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = ObservedPath(monkeypatch)
    flown = run(planted, lambda so_far: "processed " in so_far.events)
    sys.setprofile(None)
    assert "processed " in flown.events, flown
    steps, files = documented()
    exchanged = [name for name in seen.messages if name in steps]
    assert set(exchanged) == set(steps)
    assert [n for n in exchanged if n not in ANY_ORDER] == [n for n in steps if n not in ANY_ORDER]
    ran = {
        name
        for file in seen.files
        if (name := file.removeprefix(f"{ROOT}/")).startswith("daemon/onboard/")
    }
    onboard = {file for file in files if file.startswith("daemon/onboard/")}
    undocumented = {file for file in ran - onboard - TRANSPORT if not OTHER_EVENTS.search(file)}
    assert undocumented == set(), "the page does not name them"
    assert onboard - ran == set(), "the page names them, and they did not run"
