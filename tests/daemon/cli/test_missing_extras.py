"""Without an optional library every command that requires it states how to install it."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from daemon.mission.layout import Mission
from drivers.base.extras import EXTRAS, MissingExtraError, missing_module, require
from tests.daemon.small_camera import new_mission

ROOT = Path(__file__).parents[3]
CPU_WITHIN_S = 4.0
"""What the sentence costs, imports included; about 0.6 s on a quiet machine of 2026."""
BLOCKER = """
import os, sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in os.environ["BLOCKED"].split():
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Blocker())
"""
CONFIGURATION = """
[mission]
root = "missions"
rig = "ultracam-x-mini"
{plan}
[trigger]
driver = "{trigger}"
{port}

[[head]]
sensor = "SU00"
driver = "{head}"
trigger_source = "{source}"
{where}
{more}
"""
FOLDER = {"head": "folder", "where": 'folder = "."', "source": "software", "trigger": "software"}
ARAVIS = {
    "head": "aravis",
    "where": 'address = "127.0.0.9"',
    "source": "line",
    "trigger": "pulse-bus",
    "port": "port = 9",
}
WATCH = {**FOLDER, "more": "[watch]\nport = 0\n"}
MAVLINK = {**FOLDER, "more": '[[navigator]]\nname = "n"\ndriver = "mavlink"\nport = "/dev/null"\n'}
CAMERA = {**FOLDER, "more": "[watch]\nport = 0\n[watch.mavlink]\n"}
TERRAIN = {**FOLDER, "plan": '[plan]\nelevation = "dem.tif"\nelevation_crs = "EPSG:25833"\n'}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    blocker = tmp_path / "blocker"
    blocker.mkdir()
    (blocker / "sitecustomize.py").write_text(BLOCKER)
    (tmp_path / "dem.tif").write_bytes(b"II*\0")
    return tmp_path


def configured(folder: Path, **parts: str) -> str:
    path = folder / "service.toml"
    every = dict.fromkeys(("plan", "port", "more"), "") | parts
    path.write_text(CONFIGURATION.format(**every))
    return str(path)


def output_without(
    modules: tuple[str, ...], folder: Path, *arguments: str
) -> tuple[subprocess.CompletedProcess[str], float]:
    """What the command prints where these modules cannot be imported, and its CPU seconds."""
    environment = os.environ | {
        "PYTHONPATH": f"{folder / 'blocker'}:{ROOT}",
        "BLOCKED": " ".join(modules),
        "COLUMNS": "400",
    }
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-m", "daemon", *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return done, spent_s


COMMANDS: tuple[tuple[str, tuple[str, ...], dict[str, str] | None], ...] = (
    ("aravis", ("demo", "--out", "flights"), None),
    ("aravis", ("run", "CONFIG"), ARAVIS),
    ("aravis", ("check", "CONFIG"), ARAVIS),
    ("aravis", ("check", "--find-heads"), None),
    ("watch", ("demo", "--out", "flights"), None),
    ("watch", ("run", "CONFIG"), WATCH),
    ("watch", ("check", "CONFIG"), WATCH),
    ("watch", ("monitor", "127.0.0.1:9"), None),
    ("watch", ("monitor",), None),
    ("watch", ("send", "start", "--socket", "nowhere.sock"), None),
    ("mavlink", ("demo", "--receiver", "mavlink", "--out", "flights"), None),
    ("mavlink", ("run", "CONFIG"), MAVLINK),
    ("mavlink", ("check", "CONFIG"), MAVLINK),
    ("mavlink", ("run", "CONFIG"), CAMERA),
    ("mavlink", ("check", "--find", "/dev/null"), None),
    ("plots", ("adjust", "."), None),
    ("geotiff", ("check", "CONFIG"), TERRAIN),
    ("geotiff", ("sim", "ultracam-x-mini", "--out", "sim", "--scene", "dem.tif"), None),
    ("geotiff", ("export", "pictures", "MISSION"), None),
)


@pytest.mark.trust
@pytest.mark.parametrize(
    ("extra", "arguments", "parts"),
    COMMANDS,
    ids=[f"{extra}: {' '.join(arguments)}" for extra, arguments, _ in COMMANDS],
)
def test_a_missing_library_is_one_sentence_with_the_command_that_installs_it(
    folder: Path, extra: str, arguments: tuple[str, ...], parts: dict[str, str] | None
) -> None:
    real = {"CONFIG": configured(folder, **(parts or FOLDER))}
    if "MISSION" in arguments:
        real["MISSION"] = str(_mission(folder).path)
    given = [real.get(argument, argument) for argument in arguments]
    done, spent_s = output_without(EXTRAS[extra].modules, folder, *given)
    output = done.stdout + done.stderr
    assert f"Run: pip install 'syntopic[{extra}]'" in output, output
    assert output.count("pip install") == 1 and "Traceback" not in output
    assert done.returncode in (1, 2)
    assert spent_s < CPU_WITHIN_S
    assert not (folder / "missions").is_dir() or not any((folder / "missions").glob("2*"))


@pytest.mark.trust
def test_the_system_library_has_its_own_command(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done, _ = output_without(("gi",), folder, "run", configured(folder, **ARAVIS))
    assert "sudo apt install gir1.2-aravis-0.8" in done.stdout + done.stderr

    class _NoTypelib:
        @staticmethod
        def require_version(name: str, _version: str) -> None:
            raise ValueError(f"Namespace {name} not available")

    # A module is replaced by an object that fails on import.
    monkeypatch.setitem(sys.modules, "gi", _NoTypelib())  # type: ignore[arg-type]
    monkeypatch.setattr("drivers.base.extras._is_there", lambda _module: True)
    with pytest.raises(MissingExtraError, match=r"Namespace Aravis not available.*apt install"):
        require("aravis")


def test_the_extras_are_those_of_the_package() -> None:
    packaged = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert set(EXTRAS) == set(packaged["optional-dependencies"])


def test_an_import_that_belongs_to_no_extra_is_not_explained_away() -> None:
    assert missing_module(ImportError("no", name="numpy")) is None
    found = missing_module(ImportError("no", name="starlette.exceptions"))
    assert found is not None and "syntopic[watch]" in str(found)


def _mission(folder: Path) -> Mission:
    return new_mission(folder / "flown")
