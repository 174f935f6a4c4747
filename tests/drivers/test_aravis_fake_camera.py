"""The Aravis head against Aravis' own fake camera, which we did not write."""

from __future__ import annotations

import functools
import json
import shutil
import socket
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.peer,
    pytest.mark.skipif(
        shutil.which("arv-fake-gv-camera-0.8") is None,
        reason="needs arv-fake-gv-camera-0.8 (Debian package aravis-tools)",
    ),
]

REPOSITORY = Path(__file__).parents[2]


@functools.cache
def _namespace() -> tuple[str, ...]:
    """How to start a program in a network of its own; skips where port 3956 is not to be had."""
    pytest.importorskip("gi", reason="needs PyGObject (extra aravis) and gir1.2-aravis-0.8")
    prefix = ("unshare", "--map-root-user", "--net")
    if shutil.which("unshare") is not None:
        tried = subprocess.run([*prefix, "true"], capture_output=True, timeout=10, check=False)
        if tried.returncode == 0:
            return prefix
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        try:
            port.bind(("127.0.0.1", 3956))
        except OSError:
            pytest.skip("needs UDP port 3956 of 127.0.0.1, or unshare (Debian package util-linux)")
    return ()


def _scenario(name: str) -> dict[str, Any]:
    """Run a scenario of `aravis_scenarios`; what it found."""
    done = subprocess.run(
        [*_namespace(), sys.executable, "-m", "tests.drivers.aravis_scenarios", name],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        cwd=REPOSITORY,
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def test_frames_land_in_the_memory_we_gave_pixel_by_pixel() -> None:
    outcome = _scenario("frames_land_in_our_memory")
    assert outcome["states_at_opened"] == ["active"], "an open head can be triggered"
    assert outcome["statuses"] == ["complete"] * 8
    assert outcome["slots"] == [0, 1, 2, 3, 0, 1, 2, 3], "slots are used in turn"
    assert [b - a for a, b in zip(outcome["ids"], outcome["ids"][1:], strict=False)] == [1] * 7
    assert outcome["is_diagonal_ramp"] == [True] * 8
    assert outcome["next_is_shifted_by_one"] == [True] * 7
    assert outcome["behind_the_pixels_untouched"]
    assert outcome["size"] == [512, 512]
    assert outcome["settings"]["ExposureTime"] == 2000.0
    assert outcome["settings"]["PixelFormat"] == "Mono16"
    assert outcome["settings"]["GevSCPSPacketSize"] >= 576
    assert outcome["found"]["model"] == "Fake"
    assert outcome["found"]["serial"] == "T1"
    assert outcome["statistics"]["frames"] == 8
    assert outcome["statistics"]["missing_packets"] == 0
    assert (outcome["state"], outcome["thread_ended"]) == ("inactive", True)
    # The fake camera exposes on a grid of 40 ms, so this bounds our share from above.
    assert statistics.median(outcome["delays_ms"]) < 100


def test_a_killed_head_is_noticed_within_five_seconds_and_opened_again() -> None:
    outcome = _scenario("a_killed_head_is_found_again")
    assert outcome["events"] == ["opened", "lost", "opened"]
    assert outcome["faults"] == [False, True, False]
    assert outcome["lost_after_s"] < 5
    assert outcome["reopened_after_s"] < 12
    assert outcome["frames"] == 4
    assert outcome["opened"] == 2


def test_a_head_that_restarts_at_once_is_noticed_too() -> None:
    outcome = _scenario("a_quick_restart_is_noticed")
    assert outcome["events"] == ["opened", "lost", "opened"]
    assert outcome["back_after_s"] < 8
    assert outcome["frames"] == 3


def test_the_hold_of_a_dead_controller_is_waited_out_and_shown() -> None:
    outcome = _scenario("a_dead_controllers_hold_is_waited_out")
    assert outcome["controls"] == "True"
    assert "another program has had control of the head for 1 s" in outcome["refused"]
    assert outcome["reported"] == ["held-by-another"]
    assert outcome["waited_s"] < 8, "the fake camera lets go 3 s after the last heartbeat"
    assert outcome["frames"] == 2


def test_settings_that_the_head_refuses_come_all_at_once_and_let_it_go() -> None:
    outcome = _scenario("refused_settings_come_together")
    four, serial, line, small, absent = outcome["refusals"]
    assert "pixel_format is 'Mono12p'; the head has" in four
    assert "exposure_time_us is 5e+07; the head takes 10 to 1e+07" in four
    assert "gain_db is 6; the head has no gain in dB; it has GainRaw in steps of its own" in four
    assert "tdi_shifts is 12; the head has no feature TdiShifts, set 0" in four
    assert "serial number is 'T1' where 'T2' is configured" in serial
    assert "trigger_line is refused (TriggerSource has no entry Line7" in line
    assert "a frame has 524288 bytes, its slot 1000" in small
    assert "nothing answers at 127.0.0.1; check the head's power, cable" in absent
    assert outcome["privilege_afterwards"] == 0


def test_lost_packets_give_an_incomplete_frame_and_its_reason() -> None:
    outcome = _scenario("lost_packets_make_incomplete_frames")
    counted = outcome["statistics"]
    assert outcome["statuses"].count("incomplete") == counted["frames_incomplete"] > 0
    assert (
        counted["incomplete_timeout"] + counted.get("incomplete_missing_packets", 0)
        == (counted["frames_incomplete"])
    )
    assert counted["missing_packets"] > 0
    assert counted["resend_requests"] > 0


def test_frames_that_come_while_all_slots_are_taken_are_counted_and_reported() -> None:
    outcome = _scenario("taken_slots_lose_frames_at_the_stream")
    assert outcome["underruns"] == 2
    assert outcome["events"] == ["opened", "underrun"]
    assert outcome["frames"] == 5, "three before, two after the slots were handed back"
    assert "slot 0 was not handed out" in outcome["twice"]


def test_closing_a_dead_head_takes_two_seconds_at_most() -> None:
    outcome = _scenario("closing_a_dead_head_takes_two_seconds_at_most")
    assert outcome["closed_s"] < 2.1
    assert outcome["ended_s"] < 2.1
    assert outcome["state"] == "inactive"


def test_a_head_that_waits_for_its_line_refuses_a_software_trigger() -> None:
    outcome = _scenario("a_head_that_waits_for_its_line_refuses_a_software_trigger")
    assert 'set trigger_source = "software"' in outcome["refused"]
    assert outcome["frames"] == 0


def test_the_packet_size_is_negotiated_down_to_what_the_network_carries() -> None:
    if not _namespace():
        pytest.skip("needs unshare and user namespaces: the loopback's own MTU is not touched")
    outcome = _scenario("packets_fit_the_network")
    assert outcome["statuses"] == ["complete", "complete"]
    assert outcome["equal"] == [True, True]
    assert all(1000 < size <= 1500 for size in outcome["packet_sizes"]), outcome["packet_sizes"]


def test_light_that_changes_is_followed_and_every_frame_states_what_it_was_exposed_with() -> None:
    outcome = _scenario("light_that_changes_is_followed")
    count = len(outcome["sun"])
    assert len(outcome["reported"]) == len(outcome["asked"]) == count
    for asked, reported in zip(outcome["asked"], outcome["reported"], strict=True):
        assert reported == pytest.approx(asked, rel=1e-4, abs=1e-3)
    times_us, gains_db, shifts = zip(*outcome["reported"], strict=True)
    assert max(times_us) / min(times_us) > 3.0
    assert max(gains_db) <= 12.0
    assert len(set(shifts)) >= 3
    assert min(outcome["bright"][5:]) > 0.42
    assert max(outcome["bright"][5:]) < 0.8
    # Divided by what was really used, the pictures say how bright the light was.
    ratios = [r / s for r, s in zip(outcome["radiance"], outcome["sun"], strict=True)]
    assert max(ratios[5:]) / min(ratios[5:]) < 1.03
    assert "are refused" in outcome["refused"]
