"""The wheels in an environment of their own, away from the source tree.

The environment has the dependencies of this one as links, so that nothing is downloaded.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from daemon.cli.exit_status import ExitStatus
from tests.repository.test_document_examples import blocks, page_of

ROOT = Path(__file__).parents[2]
TUTORIAL = "tutorials/your-own-hardware.md"
BUILD_TIMEOUT_S = 300.0
COMPILED_HERE = "line_means"
"""The module of `processing` whose kernels the installation compiles itself."""
FLIGHT_TIMEOUT_S = 900.0
WHEEL_NBYTES_MAX = 4_000_000
"""The photographs alone have 8 MB."""

pytestmark = [pytest.mark.system, pytest.mark.timeout(2 * FLIGHT_TIMEOUT_S + BUILD_TIMEOUT_S)]


@dataclass(frozen=True)
class Installation:
    """Wheels, and the environment where they are installed."""

    wheels: Mapping[str, Path]
    prefix: Path
    work: Path

    def run(self, *command: str, timeout_s: float = 120.0) -> subprocess.CompletedProcess[str]:
        """A program of the environment, in a folder without sources."""
        return subprocess.run(
            [str(self.prefix / "bin" / command[0]), *command[1:]],
            cwd=self.work,
            env={"PATH": os.environ["PATH"], "HOME": str(self.work), "COLUMNS": "120"},
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
        )


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installation:
    folder = tmp_path_factory.mktemp("wheel")
    source, prefix, work = folder / "source", folder / "environment", folder / "work"
    work.mkdir()
    tracked = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard", "-z"],
        cwd=ROOT,
        capture_output=True,
        check=True,
    )
    for name in filter(None, tracked.stdout.decode().split("\0")):
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, source / name)
    subprocess.run(
        ["make", "-o", ".venv/ready", "wheel", f"BIN={Path(sys.executable).parent}"],
        cwd=source,
        check=True,
        timeout=BUILD_TIMEOUT_S,
    )
    (source / "dist").rename(folder / "dist")
    shutil.rmtree(source)
    wheels = {path.name.partition("-")[0]: path for path in (folder / "dist").glob("*.whl")}
    venv.create(prefix, with_pip=False)
    packages = Path(sysconfig.get_path("purelib", vars={"base": str(prefix)}))
    for entry in Path(sysconfig.get_path("purelib")).iterdir():
        if "syntopic" not in entry.name and entry.suffix != ".pth" and entry.name != "__pycache__":
            (packages / entry.name).symlink_to(entry)
    result = Installation(wheels, prefix, work)
    done = result.run(
        *("python", "-m", "pip", "install", "--no-deps", "--no-index", "--no-compile"),
        *map(str, wheels.values()),
        timeout_s=BUILD_TIMEOUT_S,
    )
    assert done.returncode == 0, done.stderr
    return result


def test_the_source_tree_is_not_used(installed: Installation) -> None:
    for name in ("daemon", "drivers", "processing", "sim_hw"):
        done = installed.run("python", "-c", f"import {name}; print({name}.__file__)")
        assert Path(done.stdout.strip()).is_relative_to(installed.prefix), done


def test_the_wheel_has_page_templates_tables_units_and_the_manual_page(
    installed: Installation,
) -> None:
    with zipfile.ZipFile(installed.wheels["syntopic"]) as archive:
        names = archive.namelist()
    tracked = subprocess.run(
        ["git", "ls-files", "daemon", "drivers", "processing", "sim_hw"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    expected = {
        name for name in tracked.stdout.splitlines() if not name.startswith("sim_hw/scenes/")
    }
    assert expected <= set(names), sorted(expected - set(names))[:10]
    assert {name.partition("/")[0] for name in names} == {
        *("daemon", "drivers", "processing", "sim_hw"),
        *(f"syntopic-{_version(installed)}.{end}" for end in ("dist-info", "data")),
    }
    assert not [name for name in names if name.startswith("sim_hw/scenes/")]
    assert installed.wheels["syntopic"].stat().st_size < WHEEL_NBYTES_MAX
    assert (installed.prefix / "share/man/man1/syntopic.1").is_file()
    assert (installed.prefix / "share/syntopic/systemd/syntopic.service").is_file()


def _version(installed: Installation) -> str:
    return installed.wheels["syntopic"].name.split("-")[1]


def test_the_tutorial_installs_the_wheel_as_it_states(
    installed: Installation, tmp_path: Path
) -> None:
    """The block of the tutorial as it stands, but for the packages of the system.

    The dependencies are on the path, so that pip finds them there and needs no index.
    """
    block = next(b for b in blocks(page_of(TUTORIAL)) if b.options.get("needs") == "wheel")
    lines = [line for line in block.text.splitlines() if "apt-get" not in line]
    assert len(lines) == 3, lines
    (tmp_path / "dist").symlink_to(installed.wheels["syntopic"].parent)
    dependencies = tmp_path / "dependencies"
    dependencies.mkdir()
    for entry in Path(sysconfig.get_path("purelib")).iterdir():
        if "syntopic" not in entry.name and entry.suffix != ".pth":
            (dependencies / entry.name).symlink_to(entry)
    done = subprocess.run(
        ["bash", "-euc", "\n".join([*lines, "command -v syntopic", "syntopic --version"])],
        cwd=tmp_path,
        env={
            "PATH": f"{Path(sys.base_prefix) / 'bin'}:{os.environ['PATH']}",
            "HOME": str(tmp_path),
            "PYTHONPATH": str(dependencies),
            "PIP_NO_INDEX": "1",
            "PIP_NO_COMPILE": "no",  # pip's way to say yes: its user guide, boolean options
        },
        capture_output=True,
        text=True,
        timeout=BUILD_TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    program, version = done.stdout.splitlines()[-2:]
    assert program == str(tmp_path / ".venv/bin/syntopic")
    assert version == f"syntopic {_version(installed)}"


def test_the_command_prints_version_and_help(installed: Installation) -> None:
    assert installed.run("syntopic", "--version").stdout == f"syntopic {_version(installed)}\n"
    assert "demo" in installed.run("syntopic", "--help").stdout


PAGE_CODE = """
from fastapi.testclient import TestClient
from daemon.onboard.monitoring.access.command_gateway import CommandGateway
from daemon.onboard.monitoring.access.tokens import read_tokens
from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.monitoring.web.api import AccessSettings, create_app

settings = AccessSettings(read_tokens(None), anonymous_read=True)
app = create_app(FlightState("syntopic"), CommandGateway(lambda command: None), settings)
with TestClient(app) as client:
    page = client.get("/")
    assert page.status_code == 200, page.text
    assert "Syntopic" in page.text, page.text
    name = page.text.partition('<script type="module" src="')[2].partition('"')[0]
    script = client.get("/" + name)
    assert script.status_code == 200, script.text
    assert "javascript" in script.headers["content-type"], script.headers
    print("page", len(page.text), len(script.text))
"""


def test_the_page_is_served_from_the_wheel(installed: Installation) -> None:
    done = installed.run("python", "-c", PAGE_CODE)
    assert done.stdout.startswith("page "), done.stderr


def test_without_the_photographs_the_emulator_names_the_missing_distribution(
    installed: Installation,
) -> None:
    code = (
        "import sys; sys.modules['syntopic_scenes'] = None\n"
        "from sim_hw.world.scene import shipped_pictures; shipped_pictures()"
    )
    done = installed.run("python", "-c", code)
    assert "Run: pip install syntopic-scenes" in done.stderr


def test_the_demonstration_flies_and_check_reads_its_configuration(
    installed: Installation,
) -> None:
    present = _copy_compiled_kernels(installed)
    compiled = installed.run("syntopic", "kernels", "--json", timeout_s=FLIGHT_TIMEOUT_S)
    assert json.loads(compiled.stdout)["compiled"] > (3 if present else 100), compiled.stderr
    again = installed.run("syntopic", "kernels", "--json")
    assert json.loads(again.stdout)["compiled"] == 0, again.stderr
    done = installed.run(
        "syntopic", "demo", "--exposures", "3", "--json", timeout_s=FLIGHT_TIMEOUT_S
    )
    assert done.stdout, done.stderr
    result: dict[str, Any] = json.loads(done.stdout)
    # Flights of their own test that nothing is lost, also on a busy machine.
    assert result["ledger_balanced"] and result["lost"] < 3, done.stderr
    assert done.returncode == (ExitStatus.PROBLEM if result["lost"] else ExitStatus.DONE)
    (identity,) = (installed.work / "flights").glob("demo-*/missions/*/mission.json")
    mission = identity.parent
    assert installed.run("syntopic", "verify", str(mission)).returncode == 0
    report = installed.run("syntopic", "report", str(mission), "--json")
    assert report.returncode == 0, report.stderr
    assert any(mission.glob("export/*.html"))
    (configuration,) = (installed.work / "flights").glob("demo-*/service.toml")
    text = configuration.read_text("utf-8")
    # The devices are gone: a root that cannot be a folder ends the check before it opens them.
    configuration.write_text(text.replace('root = "missions"', 'root = "service.log/missions"'))
    _plant_python_daemon(installed)
    checked = installed.run("syntopic", "check", str(configuration), "--json")
    findings = {one["name"]: one for one in json.loads(checked.stdout)["findings"]}
    assert checked.returncode == 1
    assert "python-daemon installs daemon/daemon.py" in findings["python-daemon"]["sentence"]


def _copy_compiled_kernels(installed: Installation) -> int:
    """Copy what `make setup` compiled, but for one module; the number of files.

    All of them take more than a minute of one core, and tests/processing/test_kernel_compilation.py
    compiles them.
    """
    copied = 0
    packages = Path(sysconfig.get_path("purelib", vars={"base": str(installed.prefix)}))
    for cache in (ROOT / "processing").rglob("*.nb[ic]"):
        name = cache.relative_to(ROOT)
        if not name.name.startswith(f"{COMPILED_HERE}."):
            target = packages / name
            target.parent.mkdir(exist_ok=True)
            shutil.copy2(cache, target)
            copied += 1
    # The compiler's cache holds for a source of the same size and time.
    for source in (ROOT / "processing").rglob("*.py"):
        shutil.copystat(source, packages / source.relative_to(ROOT))
    return copied


def _plant_python_daemon(installed: Installation) -> None:
    """The files of a distribution that installs a package `daemon` as well."""
    packages = Path(sysconfig.get_path("purelib", vars={"base": str(installed.prefix)}))
    (packages / "daemon/daemon.py").touch()
    info = packages / "python_daemon-3.1.2.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: python-daemon\nVersion: 3.1.2\n")
    (info / "RECORD").write_text("daemon/daemon.py,,\n")
