"""A flight with planned faults, from the emulator's command line to the sealed records."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from daemon.cli.sim import Emulator, free_first_address, service_toml, simulator_arguments
from tests.system.test_faults_in_flight import heard, start

pytestmark = [pytest.mark.soak, pytest.mark.timeout(1200)]

FAULTS = (
    "half-frame@#2:SU00",
    "lost@#3:receiver/mark",
    "lost@#4:SU10",
    "corrupt@#5:N",
)


def test_each_fault_costs_what_it_hits_and_no_other_exposure(tmp_path: Path) -> None:
    arguments = simulator_arguments("ultracam-l-mini", tmp_path / "sim", seed=3, dc=0, displace=[])
    arguments += ["--first-address", free_first_address(), "--exposures", "8"]
    for fault in FAULTS:
        arguments += ["--fault", fault]
    emulator = Emulator(arguments)
    try:
        assert len(emulator.ready["faults"]) == len(FAULTS)
        config = tmp_path / "service.toml"
        config.write_text(
            service_toml(emulator.ready, root="missions", count=6, end_when_done=True)
        )
        service = start(config)
        events: list[dict[str, Any]] = list(heard(service))
        assert service.wait(30) == 0
    finally:
        emulator.end()
    sealed = {event["number"]: event for event in events if event["event"] == "sealed"}
    missing = {number: event["missing"] for number, event in sealed.items()}
    assert missing == {1: [], 2: ["SU00"], 3: [], 4: ["SU10"], 5: ["N"], 6: []}
    sources = {number: event["mark_source"] for number, event in sealed.items()}
    assert sources == dict.fromkeys(sources, "event-mark") | {3: "interpolated"}
    (ended,) = [event for event in events if event["event"] == "ended"]
    assert ended["ledger"]["balanced"]
    assert ended["ledger"]["frames"]["corrupt"] == 2
