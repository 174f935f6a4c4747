"""Ctrl-C and kill -9 at every change a command makes on the disk, as a user meets them."""

from __future__ import annotations

import io
import json
import shutil
import signal
import sys
import zipfile
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest

from daemon import cli
from daemon.cli import interrupt_messages
from daemon.cli.exit_status import ExitStatus
from daemon.mission.log.flight_log import read
from daemon.mission.store import durable
from tests.robustness.crash.kill_at_call import run_to_call
from tests.robustness.crash.kill_transfer import three_exposures

pytestmark = pytest.mark.trust

MISSION = "20261121T101500Z-small"
DBAT = Path(__file__).parents[2] / "processing/bundle/data/dbat-camcal/camcaldemo.xml"


@dataclass(frozen=True)
class Case:
    """A command that writes: its arguments below a folder that holds a mission."""

    name: str
    arguments: Callable[[Path], list[str]]
    positions: int = 8
    reruns: bool = True
    before: Callable[[Path], list[str]] | None = None
    """What is run first, to its end."""


def _mission(*command: str, options: tuple[str, ...] = ()) -> Callable[[Path], list[str]]:
    return lambda folder: [*command, str(folder / "flown" / MISSION), *options]


def _install(folder: Path) -> list[str]:
    return ["install", "--root", str(folder / "root")]


def _token(action: str, folder: Path) -> list[str]:
    return ["token", action, "tower", "--file", str(folder / "tokens.toml")]


def _add_token(folder: Path) -> list[str]:
    return _token("add", folder)


CASES = (
    Case("report", _mission("report")),
    Case("report", _mission("report", options=("--bundle",)), positions=3),
    Case("export raw", _mission("export", "raw")),
    Case("export foxglove", _mission("export", "foxglove")),
    Case("repair", _mission("repair", options=("--rebuild",))),
    Case(
        "transfer",
        lambda folder: [
            *_mission("transfer")(folder),
            str(folder / "disk"),
            "--remove-source",
        ],
    ),
    Case("token add", _add_token, reruns=False),
    Case(
        "rigs show",
        lambda f: ["rigs", "show", "ultracam-x-mini", "--drawing", str(f / "rig.svg")],
    ),
    Case("calibrate validity", _mission("calibrate", "validity")),
    Case(
        "certificate",
        lambda f: ["certificate", "--folder", str(f / "tls"), "--name", "camera"],
    ),
    Case("install", _install, positions=6),
    Case("uninstall", lambda f: ["uninstall", "--root", str(f / "root")], before=_install),
    Case("token remove", lambda f: _token("remove", f), reruns=False, before=_add_token),
    Case("import dbat", lambda f: ["import", "dbat", str(DBAT), "--out", str(f / "camcal")]),
)


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pristine")
    three_exposures(folder / "flown")
    (folder / "tokens.toml").touch(mode=0o640)
    return folder


def run(arguments: list[str], output_file: Path) -> Callable[[], None]:
    """The command as the shell starts it; its status and what it prints go into a file."""

    def action() -> None:
        sys.argv = ["/opt/syntopic/bin/syntopic", *arguments]
        errors = io.StringIO()
        status: object = None
        with redirect_stderr(errors), redirect_stdout(io.StringIO()):
            try:
                cli.main()
            except SystemExit as ended:
                status = ended.code
        with output_file.open("w") as file:
            json.dump({"status": status, "errors": errors.getvalue()}, file)

    return action


def check_complete(folder: Path) -> None:
    """Every file with its final name is complete.

    Raises:
        AssertionError: one is empty or cut.
    """
    for path in folder.rglob("*"):
        if not path.is_file() or any(
            part.endswith(durable.PART_SUFFIX) for part in path.relative_to(folder).parts
        ):
            continue
        data = path.read_bytes()
        if path.suffix == ".json":
            json.loads(data)
        elif path.suffix == ".html" and data != b"report":
            assert data.rstrip().endswith(b"</html>"), path
        elif path.suffix == ".svg":
            assert data.rstrip().endswith(b"</svg>"), path
        elif path.suffix == ".csv":
            assert data.endswith(b"\n"), path
        elif path.suffix == ".zip":
            with zipfile.ZipFile(path) as bundle:
                assert bundle.testzip() is None
        elif path.suffix == ".mcap":
            list(read(path)) if path.parent.name == "log" else None
            assert data.endswith(b"\x89MCAP0\r\n"), path


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_an_interrupted_command_leaves_complete_files_and_states_how_to_continue(
    case: Case, original: Path, tmp_path: Path
) -> None:
    folder, output_file, begun = tmp_path / "trial", tmp_path / "output.json", tmp_path / "begun"
    shutil.copytree(original, begun)
    if case.before is not None:
        run_to_call(run(case.before(begun), output_file), None)
        assert json.loads(output_file.read_text())["status"] == 0, output_file.read_text()

    def run_case(last: int | None, by: signal.Signals = signal.SIGKILL) -> list[str]:
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(begun, folder)
        output_file.unlink(missing_ok=True)
        return run_to_call(run(case.arguments(folder), output_file), last, torn=True, by=by)

    shutil.copytree(begun, folder)
    run(case.arguments(folder), output_file)()  # what it imports is there for the trials
    count = len(run_case(None))
    assert json.loads(output_file.read_text())["status"] == 0, output_file.read_text()
    assert count > 3
    expected_names = sorted(str(p.relative_to(folder)) for p in folder.rglob("*"))
    interrupted = 0
    # Neighbours differ little where a command changes the disk in many small steps.
    for last in range(1, count, max(1, count // case.positions)):
        run_case(last, signal.SIGINT)
        answer = json.loads(output_file.read_text())
        assert answer["status"] == ExitStatus.INTERRUPTED, (last, answer)
        lines = [line for line in answer["errors"].splitlines() if line.strip()]
        assert lines[-1] == interrupt_messages.sentence_of(case.name), (last, answer)
        assert "Traceback" not in answer["errors"]
        assert not list(folder.rglob("*.part")), last
        check_complete(folder)
        interrupted += 1
        if interrupted % 2:
            run_case(last)
            check_complete(folder)
        if interrupted % 3 == 1 or not case.reruns:
            continue
        # Again, as the message asks.
        run_to_call(run(case.arguments(folder), output_file), None)
        assert json.loads(output_file.read_text())["status"] == 0, (last, output_file.read_text())
        assert expected_names == sorted(str(p.relative_to(folder)) for p in folder.rglob("*")), last
    assert interrupted >= 3


def test_every_command_has_a_sentence_of_its_own() -> None:
    import typer.main

    # typer declares a command, and a group it is.
    commands = typer.main.get_command(cli.app).commands  # type: ignore[attr-defined]
    missing = [name for name in commands if name not in interrupt_messages.SENTENCES]
    assert missing == []
    for name in commands:
        sentence = interrupt_messages.sentence_of(name)
        assert sentence.count(".") == 1 and sentence.endswith(".") and ";" in sentence


def test_a_disk_that_refuses_ends_in_a_sentence(
    original: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, output_file = tmp_path / "trial", tmp_path / "output.json"
    shutil.copytree(original, folder)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(durable, "write_all", full)
    run(_mission("report")(folder), output_file)()
    answer = json.loads(output_file.read_text())
    assert answer["status"] == 1
    assert "No space left on device" in answer["errors"] and "Traceback" not in answer["errors"]
    assert not list(folder.rglob("*.part"))
