"""Counters of the kernel for the network: dropped packets and time in software interrupts.

`counter_problems` compares two readings; nothing else is decided here.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

PROC: Final = Path("/proc")
SOFTIRQ_SHARE_MAX: Final = 0.7
"""Share of a core in software interrupts above which packets are at risk."""
SOFTIRQ_FIELD: Final = 6
"""Position of softirq among the times of a core in /proc/stat."""


@dataclass(frozen=True)
class KernelCounters:
    """Counters since the computer was started.

    `softirq` and `busy` are times of each core in software interrupts and in total, in jiffies.
    """

    mono_ns: int
    backlog_drops: int = 0
    socket_drops: int = 0
    reverse_path_drops: int = 0
    softirq: Mapping[str, int] = field(default_factory=dict)
    total: Mapping[str, int] = field(default_factory=dict)


def read_counters(proc: Path = PROC) -> KernelCounters:
    """Read the counters; those that the kernel does not have are zero."""
    softirq, total = _core_times(_text(proc / "stat"))
    return KernelCounters(
        time.monotonic_ns(),
        backlog_drops(_text(proc / "net" / "softnet_stat")),
        named_counter(_text(proc / "net" / "snmp"), "Udp", "RcvbufErrors"),
        named_counter(_text(proc / "net" / "netstat"), "TcpExt", "IPReversePathFilter"),
        softirq,
        total,
    )


def backlog_drops(softnet_stat: str) -> int:
    """Packets that found the input queue of a core full: the second column, hexadecimal."""
    rows = [line.split() for line in softnet_stat.splitlines()]
    return sum(int(row[1], 16) for row in rows if len(row) > 1)


def named_counter(text: str, protocol: str, name: str) -> int:
    """A counter of /proc/net/snmp or netstat: a line of names, then one of values."""
    rows = [line.split() for line in text.splitlines() if line.startswith(f"{protocol}:")]
    for names, values in zip(rows[::2], rows[1::2], strict=False):
        if name in names:
            return int(values[names.index(name)])
    return 0


def softirq_shares(before: KernelCounters, after: KernelCounters) -> dict[str, float]:
    """Share of each core's time in software interrupts between two readings."""
    shares = {}
    for core, time_after in after.total.items():
        passed = time_after - before.total.get(core, 0)
        if passed > 0:
            shares[core] = (after.softirq[core] - before.softirq.get(core, 0)) / passed
    return shares


def counter_problems(
    before: KernelCounters, after: KernelCounters, *, softirq_share_max: float = SOFTIRQ_SHARE_MAX
) -> Iterator[tuple[str, str]]:
    """Name and sentence of each problem between two readings."""
    seconds = (after.mono_ns - before.mono_ns) * 1e-9
    backlog = after.backlog_drops - before.backlog_drops
    if backlog > 0:
        yield (
            "input queue",
            f"the kernel dropped {backlog} packets in {seconds:.1f} s because the input queue of a "
            "core was full; run: sudo sysctl -w net.core.netdev_max_backlog=10000, and use larger "
            "packets",
        )
    sockets = after.socket_drops - before.socket_drops
    if sockets > 0:
        yield (
            "sockets",
            f"the kernel dropped {sockets} datagrams in {seconds:.1f} s because the buffer of "
            "their socket was full; raise net.core.rmem_max and end other programs",
        )
    for core, share in softirq_shares(before, after).items():
        if share > softirq_share_max:
            yield (
                f"interrupts of {core}",
                f"{core} spends {share:.0%} of its time in network interrupts; use packets of 9000 "
                "bytes, and spread the queues of the interface over the cores (ethtool -L, RPS)",
            )


def _core_times(stat: str) -> tuple[dict[str, int], dict[str, int]]:
    softirq, total = {}, {}
    for line in stat.splitlines():
        name, *times = line.split()
        if name.startswith("cpu") and name != "cpu" and len(times) > SOFTIRQ_FIELD:
            values = [int(value) for value in times[:8]]
            softirq[name], total[name] = values[SOFTIRQ_FIELD], sum(values)
    return softirq, total


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError):
        return ""
