"""Every code block of tutorials and how-to pages is run, or listed here with the reason why not.

The blocks of a page run in their order in one scratch folder, as a reader would type them. The word
after the language states how, where it is not the usual way:

    sh until="TEXT"     runs on in a terminal of its own until its section ends; what follows
                        begins when TEXT was printed
    sh status="0 1"     ends with one of these statuses
    sh needs="WHAT"     is not run; listed in NOT_RUN
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import time
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import pytest

from benchmarks import first_exposure
from tests.daemon.mission.stores.faulty_s3 import REGION, Faults, serving
from tests.daemon.rededge_data import RECORDED

ROOT: Final = Path(__file__).parents[2]
DOCS: Final = ROOT / "docs"
PAGES: Final = sorted(
    path.relative_to(DOCS).as_posix()
    for kind in ("tutorials", "how-to")
    for path in (DOCS / kind).rglob("*.md")
)
BLOCK_TIMEOUT_S: Final = 1800
PAGE_TIMEOUT_S: Final = 7200
END_TIMEOUT_S: Final = 300
SYSTEM_PATH: Final = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin"

LONG: Final = {
    "how-to/processing/calibration.md",
    "how-to/processing/midas.md",
    "how-to/processing/multispectral.md",
    "how-to/processing/replay.md",
    "how-to/processing/triangulation.md",
}
"""Pages with a laboratory series, several flights, or full-size recordings; `make soak` runs them.
The tests of their commands run without it."""

OWN_NETWORK: Final = {"tutorials/your-own-hardware.md"}
"""Pages that search for heads or change addresses; they run in a network namespace of their own."""

FLIGHTS: Final = {
    "how-to/processing/midas.md",
    "how-to/processing/replay.md",
    "tutorials/getting-started.md",
}
"""Pages that fly. They have a network of their own where the kernel allows it, as other flights of
the tests may run at the same time."""

STORES: Final = {"how-to/processing/object-stores.md"}
"""Pages that write to an object store: a server on a loopback port with one empty bucket."""

NOT_RUN: Final[Mapping[tuple[str, str], str]] = {
    ("tutorials/getting-started.md", "clone"): "installs the system; the tests run after it",
    (
        "tutorials/your-own-hardware.md",
        "wheel",
    ): "tests/system/test_wheel.py runs it without apt-get",
    ("how-to/flight/installation.md", "root"): "changes the system; tests/installed flies the unit",
    ("how-to/flight/link-budget.md", "devices"): "opens every device of a service",
    ("how-to/flight/finding-devices.md", "devices"): "asks every port and network of the machine",
    ("how-to/flight/tls.md", "root"): "writes to /etc; the tests of TLS run the command elsewhere",
    ("how-to/flight/tls.md", "camera"): "needs a camera computer on the network",
    ("how-to/flight/watching.md", "service"): "needs a service that is armed, with a fault",
    ("how-to/flight/watching.md", "aircraft"): "needs two services; test_fleet.py gathers several",
    (
        "how-to/processing/calibration-board.md",
        "camera",
    ): "follows pictures as they are taken; test_calibrate_board.py makes them",
    (
        "how-to/processing/calibration-flight.md",
        "flight",
    ): "needs a flight at two heights; test_calibrate_flight.py renders one",
    (
        "how-to/processing/common-image.md",
        "rig",
    ): "needs a service with heads, and its missions; test_propose_image.py has a flight",
    (
        "how-to/processing/many-exposures.md",
        "cluster",
    ): "runs until stopped on fixed ports; test_cluster.py starts one on free ports",
    (
        "how-to/processing/orthomosaic.md",
        "photographs",
    ): "needs photographs of a flight; seneca_photographs.py has some",
    ("how-to/processing/midas.md", "block"): "needs a measured block; its tests make one",
    (
        "how-to/processing/midas.md",
        "points",
    ): "needs points measured in images; its tests make them",
    (
        "how-to/processing/orientation.md",
        "control",
    ): "needs a block with control; its tests make one",
}
"""Blocks that are not run: page, what they need, and why no test gives it."""


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, its options, its text, and the section it stands in."""

    language: str
    options: Mapping[str, str]
    text: str
    section: str


def blocks(page: str) -> Iterator[Block]:
    """The fenced blocks of a page in their order."""
    section = ""
    for heading, language, options, text in re.findall(
        r"^(?:## ([^\n]+)|```(\w*) ?([^\n]*)\n(.*?)^```)$", page, re.MULTILINE | re.DOTALL
    ):
        if heading:
            section = heading
        else:
            yield Block(language, dict(re.findall(r'(\w+)="([^"]*)"', options)), text, section)


def page_of(name: str) -> str:
    return (DOCS / name).read_text("utf-8")


class Session:
    """A reader's shells in one folder; those that run on end with their section.

    Args:
        folder: where the commands run.
        inside: command that runs others in a network of their own.
        variables: what the reader has set before, such as credentials.
    """

    def __init__(
        self,
        folder: Path,
        inside: tuple[str, ...] = (),
        variables: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self._folder = folder
        self._inside = inside
        self._environment = {
            **{name: os.environ[name] for name in ("HOME", "LANG") if name in os.environ},
            "PATH": ":".join((str(folder / "bin"), str(ROOT / ".venv/bin"), SYSTEM_PATH)),
            "COLUMNS": "120",
            "PYTHONUNBUFFERED": "1",
            **variables,
        }
        self._terminals: list[tuple[subprocess.Popen[bytes], str]] = []

    def __enter__(self) -> Session:
        (self._folder / ".venv").symlink_to(ROOT / ".venv")
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def run(self, block: Block) -> None:
        """Run a block to its end."""
        allowed = {int(one) for one in block.options.get("status", "0").split()}
        done = subprocess.run(
            [*self._inside, "bash", "-euo", "pipefail", "-c", block.text],
            cwd=self._folder, env=self._environment, stdin=subprocess.DEVNULL,
            capture_output=True, text=True, timeout=BLOCK_TIMEOUT_S, check=False,
        )  # fmt: skip
        printed = (done.stdout + done.stderr)[-3000:]
        assert done.returncode in allowed, f"{block.text}\nended with {done.returncode}:\n{printed}"

    def start(self, block: Block) -> None:
        """Start a block in a terminal of its own and wait for the text it prints when it is
        ready."""
        log = self._folder / f"terminal-{len(self._terminals)}.log"
        with log.open("wb") as output:
            process = subprocess.Popen(
                [
                    *(*self._inside, "env", "--default-signal=INT"),
                    *("bash", "-euo", "pipefail", "-c", block.text),
                ],
                cwd=self._folder, env=self._environment, stdin=subprocess.DEVNULL,
                stdout=output, stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip
        self._terminals.append((process, block.section))
        deadline = time.monotonic() + BLOCK_TIMEOUT_S
        while block.options["until"] not in log.read_text("utf-8", errors="replace"):
            printed = log.read_text("utf-8", errors="replace")[-3000:]
            assert process.poll() is None, f"{block.text}\nended with {process.poll()}:\n{printed}"
            assert time.monotonic() < deadline, f"{block.text}\nis not ready:\n{printed}"
            time.sleep(0.2)

    def enter(self, section: str) -> None:
        """End the terminals of the section before."""
        if any(begun_in != section for _, begun_in in self._terminals):
            self.end()

    def end(self) -> None:
        """Ctrl-C in every terminal, the latest first."""
        while self._terminals:
            process, _ = self._terminals.pop()
            os.killpg(process.pid, signal.SIGINT)
            try:
                process.wait(END_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait(20)
                raise


@contextmanager
def network_of(name: str) -> Iterator[tuple[str, ...]]:
    """A command that runs those of a page in a new network namespace, or none."""
    needed = first_exposure.missing()
    if name in OWN_NETWORK and needed is not None:
        pytest.skip(needed)
    if name not in OWN_NETWORK | FLIGHTS or needed is not None:
        yield ()
        return
    holder = subprocess.Popen(
        [*first_exposure.NAMESPACE, "sh", "-c", "ip link set lo up && echo up && exec sleep 86400"],
        stdout=subprocess.PIPE,
    )
    try:
        assert holder.stdout is not None and holder.stdout.readline() == b"up\n"
        yield ("nsenter", "--target", str(holder.pid), "--user", "--net")
    finally:
        holder.kill()
        holder.wait(END_TIMEOUT_S)


@contextmanager
def store_of(name: str) -> Iterator[Mapping[str, str]]:
    """The credentials that a page asks its reader to set, of a server that runs meanwhile."""
    if name not in STORES:
        yield {}
        return
    with serving(Faults()) as endpoint:
        yield {
            "AWS_ENDPOINT_URL": endpoint,
            "AWS_ALLOW_HTTP": "true",
            "AWS_REGION": REGION,
            "AWS_ACCESS_KEY_ID": "test",
            "AWS_SECRET_ACCESS_KEY": "test",
        }


def allow_as_root(folder: Path) -> None:
    """A `sudo` for commands that are root in their namespace already."""
    shim = folder / "bin" / "sudo"
    shim.parent.mkdir()
    shim.write_text('#!/bin/sh\nexec "$@"\n')
    shim.chmod(0o755)


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration in which the sections of a page replace those of the base key by key."""
    result = dict(base)
    for key, value in changes.items():
        both = isinstance(value, dict) and isinstance(result.get(key), dict)
        result[key] = merged(result[key], value) if both else value
    return result


def check_configuration(text: str) -> None:
    """A part of service.toml, with what it leaves out, is accepted by the model."""
    from daemon.configuration.model import Configuration

    base = {
        "mission": {"root": "missions", "rig": "ultracam-x-mini"},
        "trigger": {"driver": "software"},
        "head": [{"sensor": "SU00", "driver": "folder", "folder": "L0"}],
    }
    Configuration.model_validate(merged(base, tomllib.loads(text)))


RUNNERS: Final[Mapping[str, Callable[[str], None]]] = {
    "toml": check_configuration,
    "python": lambda text: exec(compile(text, "page", "exec"), {}),
    "text": lambda text: None,
}
"""What is done with the blocks that are no commands; text is what a command prints."""


BEGINNINGS: Final = Counter(
    next((block.text for block in blocks(page_of(name)) if block.language == "sh"), "")
    for name in PAGES
)
"""How many pages begin with the same commands."""


class Beginnings:
    """Folders as commands left them with which several pages begin, so that they run once."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._left: dict[str, Path] = {}

    def run(self, session: Session, block: Block, folder: Path) -> None:
        """Run the first commands of a page, or copy what they left for another one."""
        if block.text in self._left:
            shutil.copytree(self._left[block.text], folder, symlinks=True, dirs_exist_ok=True)
            return
        session.run(block)
        if BEGINNINGS[block.text] > 1:
            left = self._folder / str(len(self._left))
            shutil.copytree(folder, left, symlinks=True, ignore=lambda *_: (".venv", "bin"))
            self._left[block.text] = left


@pytest.fixture(scope="module")
def beginnings(tmp_path_factory: pytest.TempPathFactory) -> Beginnings:
    return Beginnings(tmp_path_factory.mktemp("beginnings"))


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ground that demonstrations build, for the next one."""
    return tmp_path_factory.mktemp("scenes")


@pytest.mark.system
@pytest.mark.timeout(PAGE_TIMEOUT_S)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.soak] if name in LONG else [])
        for name in PAGES
        if list(blocks(page_of(name)))
    ],
)
def test_the_blocks_of_a_page_run_in_their_order(
    name: str, tmp_path: Path, beginnings: Beginnings, scenes: Path
) -> None:
    listed = list(blocks(page_of(name)))
    if name in FLIGHTS:
        (tmp_path / "flights").mkdir()
        (tmp_path / "flights/scenes").symlink_to(scenes)
    if "0000SET" in page_of(name):
        if not RECORDED.is_dir():
            pytest.skip("needs recorded exposures in ../shared/data/rededge")
        (tmp_path / "0000SET").symlink_to(RECORDED / "0000SET")
    with ExitStack() as stack:
        inside = stack.enter_context(network_of(name))
        if inside:
            allow_as_root(tmp_path)
        variables = stack.enter_context(store_of(name))
        session = stack.enter_context(Session(tmp_path, inside, variables))
        for number, block in enumerate(listed):
            session.enter(block.section)
            if block.language != "sh":
                RUNNERS[block.language](block.text)
            elif "until" in block.options:
                session.start(block)
            elif "needs" in block.options:
                continue
            elif number == 0:
                beginnings.run(session, block, tmp_path)
            else:
                session.run(block)


def test_what_is_not_run_is_listed_and_what_is_listed_is_there() -> None:
    needed = {
        (name, block.options["needs"])
        for name in PAGES
        for block in blocks(page_of(name))
        if "needs" in block.options
    }
    assert needed == NOT_RUN.keys()


@pytest.mark.parametrize("name", PAGES)
def test_every_block_is_fenced_and_states_its_language(name: str) -> None:
    page = page_of(name)
    fenced = re.sub(r"^```.*?^```$", "", page, flags=re.MULTILINE | re.DOTALL)
    assert re.findall(r"\n\n(?: {4}|\t)(?![-*\d ])[^\n]+", fenced) == []
    assert {block.language for block in blocks(page)} <= {"sh", *RUNNERS}
    printed = "".join(block.text for block in blocks(page) if block.language == "text")
    assert re.findall(r"^(?:syntopic|make|sudo|pip|python|dask) .*", printed, re.MULTILINE) == []


def test_a_block_that_fails_is_found(tmp_path: Path) -> None:
    (wrong, right) = blocks('```sh\nfalse | cat\n```\n\n```sh status="0 3"\nexit 3\n```\n')
    with Session(tmp_path) as session:
        session.run(right)
        with pytest.raises(AssertionError, match="ended with 1"):
            session.run(wrong)
    with pytest.raises(ValueError, match="gain_most"):
        check_configuration("[exposure]\ngain_most = 3\n")
