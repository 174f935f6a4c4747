"""A pulse per second: the kernel's structures, and edges on the monotonic clock come what may."""

from __future__ import annotations

import errno
import shutil
import socket
import subprocess
import threading
from collections.abc import Sequence
from pathlib import Path

import pytest

from drivers.contract import DeviceError, DeviceEvent, LifeCycle, PpsEdge, Record
from drivers.triggers.pps import binding
from drivers.triggers.pps.binding import CAN_WAIT, CAPTURE_ASSERT, CAPTURE_CLEAR, Edges, edges_of
from drivers.triggers.pps.device import PpsDevice, wall_clock
from drivers.triggers.pps.emulated import EmulatedPps

NS = 1_000_000_000
OFFSET_NS = 1_790_000_000 * NS

PROGRAM = r"""
#include <stdio.h>
#include <stddef.h>
#include <linux/pps.h>
int main(void) {
  printf("%lu %lu %lu %lu\n", (unsigned long)PPS_GETPARAMS, (unsigned long)PPS_SETPARAMS,
         (unsigned long)PPS_GETCAP, (unsigned long)PPS_FETCH);
  printf("%zu %zu %zu\n", sizeof(struct pps_fdata), sizeof(struct pps_kparams),
         sizeof(struct pps_ktime));
  printf("%zu %zu %zu %zu\n", offsetof(struct pps_fdata, info.assert_tu),
         offsetof(struct pps_fdata, info.clear_tu), offsetof(struct pps_fdata, info.current_mode),
         offsetof(struct pps_fdata, timeout));
  printf("%d %d %d\n", PPS_CAPTUREASSERT, PPS_CAPTURECLEAR, PPS_CANWAIT);
  struct pps_fdata d = {0};
  d.info.assert_sequence = 7; d.info.clear_sequence = 9;
  d.info.assert_tu.sec = 1790000001; d.info.assert_tu.nsec = 123456789;
  d.info.clear_tu.sec = 1790000002; d.info.clear_tu.nsec = 987654321;
  d.info.current_mode = 3;
  for (size_t k = 0; k < sizeof d; k++) printf("%02x", ((unsigned char *)&d)[k]);
  printf("\n");
}
"""


@pytest.mark.peer
def test_structures_and_requests_are_those_of_the_kernels_header(tmp_path: Path) -> None:
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None or not Path("/usr/include/linux/pps.h").exists():
        pytest.skip("needs a C compiler and linux/pps.h: Debian packages gcc and linux-libc-dev")
    (tmp_path / "pps.c").write_text(PROGRAM)
    subprocess.run([compiler, "-o", "pps", "pps.c"], cwd=tmp_path, check=True, timeout=60)
    done = subprocess.run(
        [str(tmp_path / "pps")], capture_output=True, text=True, check=True, timeout=10
    )
    requests, sizes, offsets, bits, memory = done.stdout.splitlines()
    ours = (binding.GETPARAMS, binding.SETPARAMS, binding.GETCAP, binding.FETCH)
    assert [int(number_text) for number_text in requests.split()] == list(ours)
    assert [int(number_text) for number_text in sizes.split()] == [
        binding.FDATA.size,
        binding.PARAMS.size,
        binding.KTIME.size,
    ]
    assert [int(number_text) for number_text in offsets.split()] == [8, 24, 40, 48]
    assert [int(number_text) for number_text in bits.split()] == [
        CAPTURE_ASSERT,
        CAPTURE_CLEAR,
        CAN_WAIT,
    ]
    assert edges_of(bytes.fromhex(memory)) == Edges(
        7, 9, 1_790_000_001_123_456_789, 1_790_000_002_987_654_321
    )


class ScriptedSource:
    """A source that returns given edges, then nothing; OSError entries are raised.

    `unwaited` is what it answers who does not wait.
    """

    def __init__(
        self,
        *script: Edges | OSError | None,
        unwaited: Sequence[Edges] = (),
        can: int = 0x103,
        mode: int = 1,
    ) -> None:
        self.script, self.unwaited = list(script), list(unwaited)
        self.can, self.is_mode = can, mode
        self.is_closed = False

    def capabilities(self) -> int:
        return self.can

    def mode(self) -> int:
        return self.is_mode

    def set_mode(self, mode: int) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    def fetch(self, timeout_s: float) -> Edges | None:
        scripted_value = self.script.pop(0) if self.script else None
        if isinstance(scripted_value, OSError):
            raise scripted_value
        return scripted_value

    def latest(self) -> Edges | None:
        return self.unwaited.pop(0) if self.unwaited else None

    def is_there(self) -> bool:
        return True

    def close(self) -> None:
        self.is_closed = True


class FakeWallClock:
    """A wall clock that can be set; each look at it is a second later."""

    def __init__(self) -> None:
        self.mono_ns = 100 * NS
        self.offset_ns = OFFSET_NS

    def __call__(self) -> tuple[int, int]:
        return self.mono_ns, self.offset_ns

    def edge(self, sequence: int, age_ns: int = 300_000) -> Edges:
        self.mono_ns += NS
        return Edges(sequence, 0, self.mono_ns - age_ns + self.offset_ns, 0)


def device(wall: FakeWallClock, **settings: object) -> PpsDevice:
    return PpsDevice("pps", {"device": "/dev/pps9", **settings}, wall=wall)


def events_until(sequence: int, pps: PpsDevice) -> list[Record]:
    """The records of a driver up to that edge; the driver is closed then, and has ended."""
    got: list[Record] = []
    seen = threading.Event()

    def sink(record: Record) -> None:
        got.append(record)
        if isinstance(record, PpsEdge) and record.sequence == sequence:
            seen.set()

    thread = threading.Thread(target=pps.run, args=(sink,), daemon=True)
    thread.start()
    assert seen.wait(20)
    pps.close()
    thread.join(20)
    assert not thread.is_alive()
    return got


def test_an_edge_is_carried_to_the_monotonic_clock_and_its_latency_taken_off() -> None:
    wall = FakeWallClock()
    pps = device(wall, latency_ns=4_000, sigma_ns=1_500)
    edge = pps.edge_of(wall.edge(17))
    assert edge == PpsEdge("pps", 17, 101 * NS - 300_000 - 4_000, 1_500)


def test_an_edge_reported_twice_counts_once_and_missed_ones_are_counted_across_the_wrap() -> None:
    wall = FakeWallClock()
    pps = device(wall)
    assert pps.edge_of(edges := wall.edge(2**32 - 2)) is not None
    assert pps.edge_of(edges) is None
    assert pps.edge_of(wall.edge(1)) is not None
    assert pps.statistics()["edges_missed"] == 2
    assert pps.statistics()["edges_repeated"] == 1


def test_a_wall_clock_that_is_set_moves_no_edge() -> None:
    wall = FakeWallClock()
    pps = device(wall)
    first = pps.edge_of(wall.edge(1))
    across = wall.edge(2)
    wall.offset_ns += 3600 * NS
    assert pps.edge_of(across) is None, "stamped before the clock was set, read after it"
    after = pps.edge_of(wall.edge(3))
    assert first is not None and after is not None
    assert after.mono_ns - first.mono_ns == 2 * NS
    assert pps.statistics()["wall_clock_steps"] == 1


def test_a_slewed_wall_clock_is_followed() -> None:
    wall = FakeWallClock()
    pps = device(wall)
    for sequence in range(1, 20):
        wall.offset_ns += 500_000
        edge = pps.edge_of(wall.edge(sequence))
        assert edge is not None and edge.mono_ns == wall.mono_ns - 300_000
    assert pps.statistics()["wall_clock_steps"] == 0


def test_an_old_edge_of_a_source_that_has_stopped_is_not_taken_for_a_new_one() -> None:
    wall = FakeWallClock()
    pps = device(wall)
    assert pps.edge_of(wall.edge(5, age_ns=40 * NS)) is None


def test_an_edge_that_came_between_two_waits_is_delivered_and_an_old_one_is_not() -> None:
    wall = FakeWallClock()
    before = wall.edge(1)
    between = wall.edge(2)
    source = ScriptedSource(None, None, wall.edge(3), unwaited=[before, between, between])
    pps = PpsDevice("pps", {"device": "/dev/pps9"}, source_opener=lambda _: source, wall=wall)
    got = events_until(3, pps)
    assert [record.sequence for record in got if isinstance(record, PpsEdge)] == [2, 3]
    assert pps.statistics()["edges_repeated"] == pps.statistics()["edges_missed"] == 0


def test_what_cannot_be_opened_names_the_cure() -> None:
    with pytest.raises(DeviceError, match="load pps-ldisc or pps-gpio"):
        PpsDevice("pps", {"device": "/dev/pps-none"}).bind()
    wrong = PpsDevice(
        "pps",
        {"device": "/dev/pps9", "edge": "clear"},
        source_opener=lambda _: ScriptedSource(can=CAN_WAIT | CAPTURE_ASSERT),
    )
    with pytest.raises(DeviceError, match='set edge = "assert"'):
        wrong.bind()
    refused = PpsDevice(
        "pps",
        {"device": "/dev/pps9", "edge": "clear"},
        source_opener=lambda _: ScriptedSource(mode=1),
    )
    with pytest.raises(DeviceError, match="permission denied"):
        refused.bind()


def test_it_goes_on_after_a_loss_and_states_what_happened() -> None:
    wall = FakeWallClock()
    lost = ScriptedSource(wall.edge(1), OSError(errno.ENODEV, "No such device"))
    again = ScriptedSource(wall.edge(2))
    sources = [lost, again]
    pps = PpsDevice(
        "pps",
        {"device": "/dev/pps9"},
        source_opener=lambda _: sources.pop(0) if sources else ScriptedSource(),
        wall=lambda: (102 * NS, OFFSET_NS),
    )
    got = events_until(2, pps)
    assert lost.is_closed and pps.state is LifeCycle.INACTIVE
    names = [record.name for record in got if isinstance(record, DeviceEvent)]
    assert names[:3] == ["opened", "lost", "opened"]


def test_an_emulated_source_speaks_through_the_same_interface_and_odd_lines_are_skipped() -> None:
    listener = socket.create_server(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    source = EmulatedPps(f"tcp://127.0.0.1:{port}")
    peer, _ = listener.accept()
    peer.sendall(b"7 1790000001000000123\nnonsense\n-1 x\n8 17900000")
    assert source.fetch(10.0) == Edges(7, 0, 1_790_000_001_000_000_123, 0)
    assert source.fetch(0.1) is None
    peer.sendall(b"02000000456\n")
    assert source.fetch(10.0) == Edges(8, 0, 1_790_000_002_000_000_456, 0)
    peer.close()
    with pytest.raises(OSError, match="closed the connection"):
        source.fetch(10.0)
    source.close()
    listener.close()


def test_the_two_clocks_are_read_at_one_moment() -> None:
    first_mono, first_offset = wall_clock()
    second_mono, second_offset = wall_clock()
    assert second_mono >= first_mono
    assert abs(second_offset - first_offset) < 50_000_000
