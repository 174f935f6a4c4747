"""A flight with planned faults, from the emulator's command line to the sealed records."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from daemon.cli.sim import Emulator, free_first_address, service_toml, simulator_arguments
from tests.system.test_faults_in_flight import read_events, start

pytestmark = [pytest.mark.soak, pytest.mark.timeout(1200)]

FAULTS = (
    "half-frame@#2:SU00",
    "lost@#3:receiver/mark",
    "lost@#4:SU10",
    "corrupt@#5:N",
    "duplicate@#6:SU00",
    "lost@#7:receiver/mark",
    "counter-reset@#11:receiver",
)
SCENARIO = """
[[fault]]  # after it was stored, before its record is sealed
fault = "late"
at_pulse = 7
device = "SU10"
by_s = 6.0

[[fault]]  # the clock is doubted while marks are counted again
fault = "late"
at_pulse = 10
device = "receiver/navigation"
by_s = 2.0
duration_s = 18.0
"""
LIMITS = "frame_timeout_s = 4.0\nmark_timeout_s = 8.0\nexposures_in_memory = 6"
EXPOSURES = 12


def test_each_fault_costs_what_it_hits_and_no_other_exposure(tmp_path: Path) -> None:
    scenario = tmp_path / "faults.toml"
    scenario.write_text(SCENARIO)
    arguments = simulator_arguments("ultracam-l-mini", tmp_path / "sim", seed=3, dc=0, displace=[])
    arguments += ["--first-address", free_first_address(), "--exposures", str(EXPOSURES + 2)]
    for fault in FAULTS:
        arguments += ["--fault", fault]
    emulator = Emulator([*arguments, "--scenario", str(scenario)])
    try:
        assert len(emulator.ready["faults"]) == len(FAULTS) + 2
        config = tmp_path / "service.toml"
        text = service_toml(emulator.ready, root="missions", count=EXPOSURES, end_when_done=True)
        config.write_text(f"{text}\n[limits]\n{LIMITS}\n")
        service = start(config)
        events: list[dict[str, Any]] = list(read_events(service))
        assert service.wait(30) == 0
    finally:
        emulator.end()
    sealed = {event["number"]: event for event in events if event["event"] == "sealed"}
    missing = {number: event["missing"] for number, event in sealed.items() if event["missing"]}
    assert missing == {2: ["SU00"], 4: ["SU10"], 5: ["N"], 7: ["SU10"]}
    sources = [sealed[number]["mark_source"] for number in range(1, 11)]
    assert [n for n, source in enumerate(sources, 1) if source != "event-mark"] == [3, 7]
    reports = {e["number"]: set(e["report"]["flags"]) for e in events if e["event"] == "processed"}
    raised = {
        flag: {number for number, found in reports.items() if flag in found}
        for flag in ("FRAME_CORRUPT", "FRAME_DUPLICATE", "FRAME_LATE", "FRAME_MISSING")
    }
    assert raised == {
        "FRAME_CORRUPT": {2, 5},
        "FRAME_DUPLICATE": {6},
        "FRAME_LATE": {7},
        "FRAME_MISSING": {2, 4, 5, 7},
    }
    assert all("MARK_MISSING" in reports[number] for number in (3, 7))
    assert {"MARK_AMBIGUOUS", "GNSS"} <= reports[EXPOSURES]
    (ended,) = [event for event in events if event["event"] == "ended"]
    assert ended["ledger"]["balanced"]
    assert ended["ledger"]["frames"]["corrupt"] == 2
