"""Errors that the kernel counts on a serial line, on a port whose counters the test writes."""

from __future__ import annotations

import ctypes
import fcntl
import os
import pty
import shutil
import subprocess
from pathlib import Path

import pytest
import serial

from drivers.transport import line_errors
from drivers.transport.line_errors import InterruptCounts, LineErrors
from tests.drivers.fakes import FakeClock, FakePort
from tests.drivers.test_serial_device import _echo_device, _run_until


class Kernel:
    """Answers the request for counters as the kernel does, by file descriptor."""

    def __init__(self) -> None:
        self.counts: dict[int, InterruptCounts] = {}
        self.requests: list[int] = []

    def ioctl(self, descriptor: int, request: int, into: InterruptCounts) -> int:
        self.requests.append(request)
        if descriptor not in self.counts:
            raise OSError(25, "Inappropriate ioctl for device")
        ctypes.pointer(into)[0] = self.counts[descriptor]
        return 0


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Kernel:
    fake = Kernel()
    monkeypatch.setattr(fcntl, "ioctl", fake.ioctl)
    return fake


class Port:
    def fileno(self) -> int:
        return 7


def test_errors_are_counted_from_the_opening_of_the_port(kernel: Kernel) -> None:
    kernel.counts[7] = InterruptCounts(overrun=40, buf_overrun=5, frame=3, parity=9, rx=1000)
    errors = LineErrors(Port())
    assert errors.new() == {}
    kernel.counts[7] = InterruptCounts(overrun=41, buf_overrun=7, frame=3, parity=10, rx=2000)
    assert errors.new() == {"overruns": 3, "parity_errors": 1}
    assert errors.new() == {}
    kernel.counts[7] = InterruptCounts(overrun=41, buf_overrun=7, frame=8, parity=10)
    assert errors.new() == {"framing_errors": 5}
    assert set(kernel.requests) == {line_errors.TIOCGICOUNT}


def test_a_counter_that_wraps_goes_on(kernel: Kernel) -> None:
    kernel.counts[7] = InterruptCounts(overrun=2**31 - 1)
    errors = LineErrors(Port())
    kernel.counts[7] = InterruptCounts(overrun=-(2**31) + 1)
    assert errors.new() == {"overruns": 2}


def test_a_port_without_counters_has_no_errors(kernel: Kernel) -> None:
    assert LineErrors(Port()).new() == {}
    assert LineErrors(None).new() == {}


def test_the_kernel_refuses_the_request_on_a_pseudo_terminal() -> None:
    near, far = pty.openpty()
    try:
        with serial.Serial(os.ttyname(far)) as terminal:
            assert LineErrors(terminal)._read() is None
            assert LineErrors(terminal).new() == {}
    finally:
        os.close(near)
        os.close(far)


def test_bytes_that_were_read_too_late_are_counted_and_reported(kernel: Kernel) -> None:
    clock = FakeClock()
    kernel.counts[7] = InterruptCounts(overrun=1000)

    def talk(port: FakePort) -> bytes:
        clock.now_ns += 100_000_000
        if clock.now_ns > start_ns + 1_000_000_000:
            kernel.counts[7] = InterruptCounts(overrun=1012)
        if clock.now_ns > start_ns + 4_000_000_000:
            raise serial.SerialException("it was unplugged")
        return b"!"

    start_ns = clock.now_ns
    port = FakePort(clock, talk)
    # A fake port has a descriptor for this test.
    port.fileno = lambda: 7  # type: ignore[attr-defined]
    device = _echo_device(clock, port)
    recorder = _run_until(device, clock, 6)
    assert device.statistics()["overruns"] == 12
    (event,) = [e for e in recorder.events if e.name == "overrun"]
    assert event.is_fault
    assert "lost bytes 12 times. Reduce its load" in event.sentence
    assert "parrot polly at /dev/polly" in event.sentence


def test_structure_and_request_are_those_of_the_kernels_header(tmp_path: Path) -> None:
    compiler = shutil.which("gcc")
    if compiler is None:
        pytest.skip("needs gcc (Debian packages gcc, libc6-dev)")
    fields = [field[0] for field in InterruptCounts._fields_]
    prints = "".join(
        f'printf("%zu ", offsetof(struct serial_icounter_struct, {name}));' for name in fields
    )
    source = tmp_path / "layout.c"
    source.write_text(
        "#include <stddef.h>\n#include <stdio.h>\n#include <sys/ioctl.h>\n"
        f"#include <linux/serial.h>\nint main(void) {{ {prints}"
        'printf("%zu %d", sizeof(struct serial_icounter_struct), TIOCGICOUNT); }\n'
    )
    subprocess.run([compiler, "-o", tmp_path / "layout", source], timeout=60, check=True)
    printed = subprocess.run([tmp_path / "layout"], capture_output=True, timeout=10, check=True)
    offsets = [getattr(InterruptCounts, name).offset for name in fields]
    expected = [*offsets, ctypes.sizeof(InterruptCounts), line_errors.TIOCGICOUNT]
    assert [int(number) for number in printed.stdout.split()] == expected
