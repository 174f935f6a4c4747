"""`syntopic init`: options, questions, wrong answers, absent and vanishing devices, Ctrl-C."""

from __future__ import annotations

import io
import json
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import typer

from daemon.cli.command_table import TABLE, load
from daemon.configuration.model import ConfigurationError
from daemon.initialization import discovery
from daemon.initialization.discovery import Discovery, discover
from daemon.onboard.preflight.service_file import load as load_configuration
from drivers.cameras.aravis.discovery import FoundHead
from drivers.cameras.v4l2.discovery import FoundNode
from drivers.contract import DeviceError
from drivers.detection import port_search
from drivers.detection.port_search import search
from tests.daemon.initialization.heads import head, heads
from tests.drivers.pty_line import PtyLine

OPTICS = ("--focal-length", "50", "--pixel-size", "5.5")
QUIET = ("--no-check", "--no-receiver")


class Terminal(io.StringIO):
    """Lines that a person types."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def connected(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The heads that a discovery finds; a test changes the list."""
    listed: list[Any] = heads(2)
    monkeypatch.setattr(discovery, "discover", lambda wanted=(): Discovery(tuple(listed)))
    return listed


def run(*arguments: str, typed: Sequence[str] | None = None) -> int:
    """The exit status of `syntopic init`; `typed` are the lines of a person at a terminal."""
    command = load(TABLE["init"])
    before = sys.stdin
    sys.stdin = io.StringIO() if typed is None else Terminal("".join(f"{x}\n" for x in typed))
    try:
        return int(command.main([*arguments], standalone_mode=False) or 0)
    finally:
        sys.stdin = before


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []


def test_options_answer_every_question(connected: list[Any], tmp_path: Path) -> None:
    place = tmp_path / "pair"
    options = ("--arrangement", "side-by-side", "--angle", "20", "--interval", "1.5")
    assert run(str(place), *OPTICS, *options, *QUIET) == 0
    configuration, rig = load_configuration(place / "service.toml")
    assert rig.name == "pair" and len(rig.cones) == 2 and not configuration.navigator
    assert files(place) == ["rig.schema.json", "rig.toml", "service.schema.json", "service.toml"]


def test_questions_are_at_most_eight_and_wrong_answers_are_asked_again(
    connected: list[Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "pair"
    typed = [
        *("tower", "single", "fore"),
        *("1 1", "0 1", "2 1"),
        *("0.05", "fifty", "5,0", "50 51"),
        *("0.0055", "5.5"),
        *("90", "10"),
        "",
        *("0", "1.5"),
        *("maybe", "y"),
    ]
    assert run(str(place), *QUIET, typed=typed) == 0
    printed = capsys.readouterr().out
    for number in range(1, 9):
        assert f"{number}. " in printed
    assert "9. " not in printed
    for refusal in ("tower", "given twice", "write 50", "decimal point", "write 5.5", "yes or no"):
        assert refusal in printed, refusal
    _, rig = load_configuration(place / "service.toml")
    assert [sensor.serial for sensor in rig.sensors] == ["S2", "S1"]
    assert [cone.lens.f_mm for cone in rig.cones] == [50.0, 51.0]
    assert [cone.name for cone in rig.cones] == ["front", "back"]


def test_optics_that_are_impossible_together_are_asked_again(
    connected: list[Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    del connected[1]
    typed = ["1.5", "7.2", "15", "7.2", "", "yes"]
    assert run(str(tmp_path / "a"), *QUIET, typed=typed) == 0
    assert "check focal length (mm) and pixel size (um)" in capsys.readouterr().out.replace(
        "\n", " "
    )


def test_a_person_who_does_not_agree_gets_no_files(connected: list[Any], tmp_path: Path) -> None:
    del connected[1]
    assert run(str(tmp_path / "a"), *OPTICS, *QUIET, typed=["2", "no"]) == 0
    assert files(tmp_path) == []


@pytest.mark.parametrize("answered", range(8))
def test_an_interruption_at_any_question_leaves_no_file(
    answered: int, connected: list[Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    typed = ["side", "1 2", "50", "5.5", "0", "100", "2", "y"][:answered]
    assert run(str(tmp_path / "a"), *QUIET, typed=typed) == 130
    assert files(tmp_path) == []
    assert "run the same command again" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--focal-length", "0.05", "--pixel-size", "5.5"), "write 50"),
        (("--focal-length", "50", "--pixel-size", "0.0055"), "write 5.5"),
        (("--focal-length", "50"), "--pixel-size is needed"),
        ((), "--focal-length and --pixel-size are needed"),
        ((*OPTICS, "--arrangement", "tower"), "one of single"),
        ((*OPTICS, "--angle", "100"), "0 to 75"),
        ((*OPTICS, "--distance", "far"), "no number"),
        ((*OPTICS, "--interval", "0"), "0.05 to 3600"),
        ((*OPTICS, "--trigger-unit", "10.0.0.9"), "HOST:PORT"),
        ((*OPTICS, "--name", "a/b"), "letters"),
        (OPTICS, "give --arrangement"),
        ((*OPTICS, "--arrangement", "single"), "2 are chosen"),
        (
            ("--focal-length", "50 51 52", "--pixel-size", "5", "--arrangement", "side-by-side"),
            "3 v",
        ),
    ],
)
def test_a_wrong_option_is_refused_with_its_reason(
    options: tuple[str, ...], reason: str, connected: list[Any], tmp_path: Path
) -> None:
    with pytest.raises(typer.BadParameter) as caught:
        run(str(tmp_path / "a"), *options, *QUIET)
    assert reason in str(caught.value)
    assert files(tmp_path) == []


def test_an_existing_rig_is_refused_before_any_device_is_searched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "service.toml").write_text("mine")
    monkeypatch.setattr(discovery, "discover", lambda _: pytest.fail("searched"))
    with pytest.raises(ConfigurationError, match="--replace"):
        run(str(tmp_path), *OPTICS, *QUIET)
    assert (tmp_path / "service.toml").read_text() == "mine"


def test_an_existing_rig_is_replaced_on_request(connected: list[Any], tmp_path: Path) -> None:
    del connected[1]
    (tmp_path / "rig.toml").write_text("mine")
    assert run(str(tmp_path), *OPTICS, *QUIET, "--replace") == 0
    kept = [path for path in tmp_path.iterdir() if "-until-" in path.name]
    assert [path.read_text() for path in kept] == ["mine"]


def test_without_a_head_nothing_is_written(
    connected: list[Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    connected.clear()
    assert run(str(tmp_path / "a"), *OPTICS, *QUIET, "--json") == 1
    found = json.loads(capsys.readouterr().out)
    assert "No head was found. Check power" in found["problems"][0]
    assert files(tmp_path) == []


def test_a_head_without_software_trigger_needs_a_trigger_unit(
    connected: list[Any], tmp_path: Path
) -> None:
    connected[:] = [head(is_triggerable=False)]
    assert run(str(tmp_path / "a"), *OPTICS, *QUIET) == 1
    assert files(tmp_path) == []
    assert run(str(tmp_path / "a"), *OPTICS, *QUIET, "--trigger-unit", "10.0.0.9:3957") == 0
    configuration, _ = load_configuration(tmp_path / "a" / "service.toml")
    assert configuration.trigger.driver == "pulse-bus"


def test_json_has_devices_files_and_assumptions(
    connected: list[Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    del connected[1]
    assert run(str(tmp_path / "a"), *OPTICS, *QUIET, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["heads"][0]["serial"] == "S1" and found["outcome"] == "not tried"
    assert [Path(path).name for path in found["written"]][:2] == ["rig.toml", "service.toml"]
    assert {"what", "taken_as", "replaced_by"} == set(found["provisional"][0])


def gone(_: Any) -> Any:
    raise DeviceError("head M at 127.0.0.1: the head cannot be opened; check power and cable")


def test_a_head_that_disappears_after_the_discovery_is_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = FoundHead("127.0.0.1", "V", "M", "S", "GigEVision")
    monkeypatch.setattr(discovery.aravis_description, "describe", gone)
    result = discover(find_genicam=lambda: [found], find_video=list)
    assert not result.heads and "cannot be opened" in result.problems[0]


def test_what_cannot_be_searched_is_noted() -> None:
    def missing() -> Any:
        raise DeviceError("Run: pip install 'syntopic[aravis]'")

    nodes = [FoundNode("/dev/video0", problem="Permission denied"), FoundNode("/dev/video1", "Web")]
    result = discover(find_genicam=missing, find_video=lambda: nodes)
    assert not result.heads and not result.problems
    assert ["pip" in result.notes[0], "group video" in result.notes[1]] == [True, True]
    assert "left out" in result.notes[2]


def test_a_wanted_head_that_is_not_there_is_a_problem() -> None:
    result = discover(["/dev/video7"], find_genicam=list, find_video=list)
    assert result.problems == ("no head at /dev/video7; found: none. Check its power and cable",)


def test_a_busy_port_is_named_and_left_out(
    connected: list[Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import fcntl

    del connected[1]
    with PtyLine() as line, Path(line.near).open("rb+", buffering=0) as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert run(str(tmp_path / "a"), *OPTICS, "--no-check", "--port", line.near) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "has it open already" in printed
    configuration, _ = load_configuration(tmp_path / "a" / "service.toml")
    assert not configuration.navigator


def test_a_port_that_hangs_ends_the_search_in_time(
    connected: list[Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    del connected[1]
    hung = threading.Event()

    def hanging(*_: Any) -> Any:
        hung.wait(30.0)
        raise DeviceError("port x is gone")

    def limited(names: Sequence[str], **options: Any) -> Any:
        return search(names, **{**options, "timeout_s": 0.3}, open_port=hanging)

    monkeypatch.setattr(port_search, "search", limited)
    assert run(str(tmp_path / "a"), *OPTICS, "--no-check", "--port", "/dev/ttyX") == 0
    hung.set()
    assert "did not answer within 0.3 s" in " ".join(capsys.readouterr().out.split())
