"""Counters of the kernel: read from its own files, and raised by real floods of packets."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from daemon.onboard.preflight.kernel_counters import (
    KernelCounters,
    backlog_drops,
    counter_problems,
    named_counter,
    read_counters,
    softirq_shares,
)
from daemon.onboard.preflight.network_diagnosis import governor
from tests.support.head_network import head_network

SOFTNET = """\
00002609 00000003 00000001 00000000 00000000
00001111 0000000a 00000000 00000000 00000000
"""
SNMP = """\
Udp: InDatagrams NoPorts InErrors OutDatagrams RcvbufErrors SndbufErrors
Udp: 100 2 7 90 5 0
UdpLite: InDatagrams NoPorts InErrors OutDatagrams RcvbufErrors SndbufErrors
UdpLite: 0 0 0 0 9 0
"""
FLOOD = """
import json, socket, sys, time
from daemon.onboard.preflight.kernel_counters import counter_problems, read_counters
small = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
small.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
small.bind(("127.0.0.1", 0))
sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
before = read_counters()
until = time.monotonic() + 60.0
sent, found = 0, []
# On a busy machine the flood is a small share of a core, so it lasts until both are counted.
while len(found) < 2 and time.monotonic() < until:
    for _ in range(2000):
        sender.sendto(bytes(1400), small.getsockname())
    sent += 2000
    found = list(counter_problems(before, read_counters(), softirq_share_max=0.0))
print(json.dumps([sent, found]))
"""


def test_columns_and_names_of_the_kernels_files() -> None:
    assert backlog_drops(SOFTNET) == 13
    assert named_counter(SNMP, "Udp", "RcvbufErrors") == 5
    assert named_counter(SNMP, "Udp", "Unknown") == 0
    assert named_counter("", "Udp", "RcvbufErrors") == 0


def test_this_kernels_own_files_are_read() -> None:
    counters = read_counters()
    assert counters.total
    assert counters.total.keys() == counters.softirq.keys()
    assert all(counters.total[core] >= counters.softirq[core] for core in counters.total)


def test_files_that_are_missing_count_nothing(tmp_path: Path) -> None:
    assert read_counters(tmp_path).socket_drops == 0


def test_a_flood_is_found_as_drops_of_a_socket_and_as_load_of_interrupts() -> None:
    with head_network() as network:
        ended = network.at_computer(sys.executable, "-c", FLOOD)
    sent, found = json.loads(ended.stdout)
    problems = dict(found)
    assert sent > 1000
    assert "because the buffer of their socket was full" in problems["sockets"]
    dropped = int(problems["sockets"].split()[3])
    assert 0 < dropped <= sent
    assert any(name.startswith("interrupts of cpu") for name in problems)


def counters(mono_ns: int, **more: object) -> KernelCounters:
    # Any counter by name.
    return KernelCounters(mono_ns, **more)  # type: ignore[arg-type]


def test_the_share_of_interrupts_is_that_between_two_readings() -> None:
    before = counters(0, softirq={"cpu0": 1000, "cpu1": 0}, total={"cpu0": 2000, "cpu1": 0})
    after = counters(1, softirq={"cpu0": 1075, "cpu1": 10}, total={"cpu0": 2100, "cpu1": 100})
    assert softirq_shares(before, after) == {"cpu0": 0.75, "cpu1": 0.1}
    ((name, sentence),) = counter_problems(before, after)
    assert name == "interrupts of cpu0"
    assert "cpu0 spends 75% of its time in network interrupts" in sentence


def test_drops_of_the_input_queue_are_reported_with_count_and_time() -> None:
    ((name, sentence),) = counter_problems(
        counters(0, backlog_drops=10), counters(2_000_000_000, backlog_drops=13)
    )
    assert name == "input queue"
    assert "dropped 3 packets in 2.0 s" in sentence
    assert "netdev_max_backlog" in sentence


def test_without_change_nothing_is_reported() -> None:
    assert not list(counter_problems(counters(0, backlog_drops=7), counters(1, backlog_drops=7)))


@pytest.mark.parametrize(
    ("governors", "outcome", "text"),
    [
        ((), "pass", "does not scale"),
        (("performance", "performance"), "pass", ""),
        (("schedutil",), "pass", ""),
        (("performance", "powersave"), "fail", "governor of 1 cores is powersave"),
        (("ondemand", "powersave"), "fail", "governor of 2 cores is ondemand, powersave"),
    ],
)
def test_a_governor_that_lowers_the_frequency_is_reported(
    tmp_path: Path, governors: tuple[str, ...], outcome: str, text: str
) -> None:
    for index, name in enumerate(governors):
        folder = tmp_path / f"cpu{index}" / "cpufreq"
        folder.mkdir(parents=True)
        (folder / "scaling_governor").write_text(f"{name}\n")
    (tmp_path / "cpufreq").mkdir()
    result = governor(tmp_path)
    assert result.outcome == outcome
    assert text in result.sentence
