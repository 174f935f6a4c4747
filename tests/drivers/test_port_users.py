"""A serial port that another program holds: the error names it as far as it can be known."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import sys
import termios
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from daemon.cli import app
from drivers.base.registry import driver_for
from drivers.contract import DeviceError
from drivers.transport import port_users, serial_device
from drivers.transport.port_users import PortHolder, holders, other_holders, port_in_use_sentence
from drivers.transport.serial_device import SerialDevice, open_serial_port
from tests.drivers.pty_line import PtyLine

pytestmark = pytest.mark.trust

HOLD = """
import fcntl, os, sys
fd = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
if sys.argv[2] == "lock":
    fcntl.flock(fd, fcntl.LOCK_EX)
print("open", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def line() -> Iterator[PtyLine]:
    with PtyLine() as line:
        yield line


@pytest.fixture(params=["lock", "open"])
def held(line: PtyLine, request: pytest.FixtureRequest) -> Iterator[subprocess.Popen[str]]:
    """A process that holds the near end, with a lock or without."""
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, line.near, request.param],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert holder.stdout is not None and holder.stdin is not None
    assert holder.stdout.readline() == "open\n"
    yield holder
    holder.stdin.close()
    holder.wait(10)
    holder.stdout.close()


@pytest.fixture
def like_real_ports(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pseudo-terminals are treated as real ports."""
    monkeypatch.setattr(port_users, "PTS_MAJORS", range(0))


def test_a_held_port_is_refused_and_the_error_names_the_holder(
    line: PtyLine, held: subprocess.Popen[str], like_real_ports: None
) -> None:
    with pytest.raises(DeviceError, match=rf"is in use by .+ \(process {held.pid}\); end that"):
        open_serial_port(line.near, 9600, "N")


def test_check_find_names_the_holder(
    line: PtyLine, held: subprocess.Popen[str], like_real_ports: None
) -> None:
    run_result = CliRunner().invoke(app, ["check", "--find", line.near, "--json"])
    assert f"(process {held.pid})" in run_result.stdout and "is in use by" in run_result.stdout, (
        run_result.output
    )


def test_a_device_on_a_held_port_names_the_holder(
    line: PtyLine, held: subprocess.Popen[str], like_real_ports: None
) -> None:
    device = driver_for("navigator", "nmea")("gnss", {"port": line.near})
    assert isinstance(device, SerialDevice)
    with pytest.raises(DeviceError, match=rf"gnss: port .+ is in use by .+ \(process {held.pid}\)"):
        device.bind()


def test_a_port_opened_twice_by_us_reports_it(line: PtyLine) -> None:
    port = open_serial_port(line.near, 9600, "N")
    with pytest.raises(DeviceError, match="this program has it open already"):
        open_serial_port(line.near, 9600, "N")
    port.close()
    open_serial_port(line.near, 9600, "N").close()


def test_the_maker_of_a_pseudo_terminal_does_not_count_as_a_holder(line: PtyLine) -> None:
    assert [holder.pid for holder in holders(line.near)] == [os.getpid()]
    assert other_holders(line.near) == []
    open_serial_port(line.near, 9600, "N").close()


def test_an_exclusively_opened_port_that_the_kernel_refuses_names_the_holder(
    line: PtyLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuses(*_arguments: object, **_settings: object) -> None:
        raise serial_device.serial.SerialException(errno.EBUSY, "could not open port: busy")

    monkeypatch.setattr(serial_device.serial, "Serial", refuses)
    monkeypatch.setattr(serial_device, "holders", lambda _path: [PortHolder(812, "gpsd")])
    with pytest.raises(
        DeviceError, match=r"in use by gpsd \(process 812\); run: systemctl stop gps"
    ):
        open_serial_port(line.near, 9600, "N")


def test_the_kernel_keeps_others_out_of_an_open_port(
    line: PtyLine, like_real_ports: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    ioctl_requests: list[int] = []
    ioctl = fcntl.ioctl
    monkeypatch.setattr(
        fcntl, "ioctl", lambda fd, *rest: (ioctl_requests.append(rest[0]), ioctl(fd, *rest))[1]
    )
    open_serial_port(line.near, 9600, "N").close()
    assert termios.TIOCEXCL in ioctl_requests


def test_a_holder_that_cannot_be_seen_is_named_by_its_lock_file_or_not_at_all(
    tmp_path: Path, line: PtyLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(port_users, "_has_open", lambda _pid, _device: False)
    monkeypatch.setattr(port_users, "LOCK_FOLDERS", (tmp_path,))
    assert holders(line.near) == []
    assert "this user cannot see; run: sudo fuser -v" in port_in_use_sentence(line.near, [])
    lock = tmp_path / f"LCK..{Path(line.near).name}"
    lock.write_text(f"{os.getppid():10d}\n")
    assert [holder.pid for holder in holders(line.near)] == [os.getppid()]
    lock.write_text("999999999\n")
    assert holders(line.near) == []
    lock.write_text("nonsense")
    assert holders(line.near) == []


def test_a_silent_port_that_another_program_opened_meanwhile_reports_it(
    line: PtyLine, held: subprocess.Popen[str], like_real_ports: None
) -> None:
    sentence = serial_device._port_shared_sentence(line.near)
    assert f"(process {held.pid})" in sentence and sentence.startswith(" The port is shared")
    assert serial_device._port_shared_sentence("tcp://127.0.0.1:1") == ""
