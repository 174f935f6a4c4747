"""Run `make demo` and `make test` in a fresh root of every release that the README names.

    python -m tests.installed.release_check [RELEASE ...] [--commands demo test] [--folder FOLDER]
        [--reuse] [--options 'WORKERS=1']

debootstrap makes the root from the distribution's packages. A clean clone of this repository's
HEAD is in it, and nothing else of this machine but its kernel, devices and network. Needs root.
Results are written to the release's row of `releases.md` next to this file.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
PAGE: Final = Path(__file__).with_name("releases.md")
SCRIPT: Final = Path(__file__).with_name("in_root.sh")
CERTIFICATES: Final = Path("usr/local/share/ca-certificates")
PASSED_ON: Final = re.compile(
    r"(?i)(https?|no)_proxy$|PIP_INDEX_URL$|PIP_CERT$|\w+_CA_CERTS$|SSL_CERT_\w+$"
)
"""Variables of the network that also hold in the root."""
LIMIT_S: Final = 6 * 3600
COMMANDS: Final = ("demo", "test")
KEEP_TAIL_LINES: Final = 60


@dataclass(frozen=True)
class Release:
    """A release as debootstrap knows it."""

    name: str
    suite: str
    mirror: str
    components: str = "main"
    keyring: Path = Path("/usr/share/keyrings/debian-archive-keyring.gpg")
    script: str = "sid"
    """Of debootstrap, which may be older than the release."""


DEBIAN: Final = "http://deb.debian.org/debian"
RELEASES: Final = {
    "debian-12": Release("Debian 12", "bookworm", DEBIAN),
    "debian-13": Release("Debian 13", "trixie", DEBIAN),
    "ubuntu-24.04": Release(
        "Ubuntu 24.04",
        "noble",
        "http://archive.ubuntu.com/ubuntu",
        "main,universe",
        Path("/usr/share/keyrings/ubuntu-archive-keyring.gpg"),
        "gutsy",
    ),
}


@dataclass(frozen=True)
class Result:
    """What one command did: exit status, seconds, and the line that sums it up."""

    status: int
    seconds: float
    summary: str

    def __str__(self) -> str:
        outcome = "passed" if self.status == 0 else f"failed (exit status {self.status})"
        details = f": {self.summary}" if self.summary else ""
        return f"{outcome} in {self.seconds / 60:.0f} min{details}"


def make_root(release: Release, folder: Path) -> None:
    """Bootstrap a root with make and git, and what the network of this machine asks for."""
    subprocess.run(
        [
            *("debootstrap", "--variant=minbase", f"--components={release.components}"),
            f"--keyring={release.keyring}",
            *("--include=make,git,ca-certificates", release.suite, str(folder)),
            *(release.mirror, release.script),
        ],
        check=True,
        timeout=LIMIT_S,
    )
    shutil.copy("/etc/resolv.conf", folder / "etc/resolv.conf")
    for certificate in (Path("/") / CERTIFICATES).glob("*.crt"):
        shutil.copy(certificate, folder / CERTIFICATES)
    subprocess.run(["chroot", folder, "update-ca-certificates"], check=True, timeout=LIMIT_S)


def clone(folder: Path) -> None:
    """Put a clone of HEAD at `/src/syntopic` of the root, or bring the one there to HEAD."""
    target = folder / "src/syntopic"
    if not target.exists():
        _git("clone", "-q", "--no-hardlinks", "--no-checkout", str(ROOT), str(target))
    _git("-C", str(target), "fetch", "-q", str(ROOT), "HEAD")
    _git("-C", str(target), "checkout", "-q", "--force", "--detach", "FETCH_HEAD")


def _git(*arguments: str) -> str:
    command = ["git", *arguments]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=LIMIT_S)
    return done.stdout.strip()


def commit() -> str:
    """The commit that is checked, shortened."""
    return _git("-C", str(ROOT), "rev-parse", "--short=10", "HEAD")


def run_in(folder: Path, command: str, log: Path) -> Result:
    """Run a shell command in the clone, in namespaces of its own; everything it prints is in
    `log`."""
    variables = {name: value for name, value in os.environ.items() if PASSED_ON.match(name)}
    variables |= {
        "HOME": "/root",
        "LANG": "C.UTF-8",
        "PATH": "/usr/sbin:/usr/bin:/sbin:/bin",
        "FOLDER": str(folder),
    }
    begun = time.monotonic()
    with log.open("wb") as out:
        done = subprocess.run(
            [
                *("unshare", "--mount", "--pid", "--fork", "--kill-child", "--ipc", "--uts"),
                *("sh", str(SCRIPT), command),
            ],
            env=variables,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            timeout=LIMIT_S,
            check=False,
        )
    return Result(
        done.returncode, time.monotonic() - begun, summary_of(log.read_text("utf-8", "replace"))
    )


def summary_of(text: str) -> str:
    """The last line in which pytest counts its tests; empty where no pytest ran."""
    found = re.findall(r"^=* ?((?:\d+ \w+,? ?)+) in [\d.]+s.*$", text, re.MULTILINE)
    return found[-1] if found else ""


def with_results(page: str, release: str, python: str, results: Mapping[str, str]) -> str:
    """The page with the cells of a release replaced by the results of the commands that ran."""
    rows = {line.split("|")[1].strip(): line for line in page.splitlines() if line.startswith("| ")}
    before = [cell.strip() for cell in rows.get(release, "||||").split("|")[3:5]]
    cells = dict(zip(COMMANDS, before, strict=True)) | results
    row = (
        " | ".join([f"| {release}", python, *(cells[one] or "not run" for one in COMMANDS)]) + " |"
    )
    kept = [line for line in page.splitlines() if not line.startswith(f"| {release} |")]
    return "\n".join([*kept, row]) + "\n"


def check(
    release: Release, commands: Sequence[str], folder: Path, options: str, *, reuse: bool
) -> bool:
    """Make a root, run the commands in it, and write the row; whether all of them passed."""
    if not (reuse and folder.exists()):
        shutil.rmtree(folder, ignore_errors=True)
        folder.parent.mkdir(parents=True, exist_ok=True)
        make_root(release, folder)
    clone(folder)
    tested = f"{datetime.now(UTC):%Y-%m-%d}, {commit()}"
    results: dict[str, Result] = {}
    for name in commands:
        log = folder.with_name(f"{folder.name}-{name}.log")
        print(f"{release.name}: make {name} (output in {log})", flush=True)
        results[name] = run_in(folder, f"make {name} {options}", log)
        print(f"{release.name}: make {name} {results[name]}", flush=True)
        if results[name].status != 0:
            print("\n".join(log.read_text("utf-8", "replace").splitlines()[-KEEP_TAIL_LINES:]))
    log = folder.with_name("python.log")
    run_in(folder, ".venv/bin/python --version", log)
    python = log.read_text("utf-8").strip().removeprefix("Python ")
    cells = {name: f"{result} ({tested})" for name, result in results.items()}
    PAGE.write_text(with_results(PAGE.read_text("utf-8"), release.name, python, cells), "utf-8")
    return all(result.status == 0 for result in results.values())


def main(arguments: Sequence[str]) -> int:
    """The exit status: 0 where every command passed in every release."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("releases", nargs="*", metavar="RELEASE", help=", ".join(RELEASES))
    parser.add_argument("--commands", nargs="+", default=list(COMMANDS), choices=COMMANDS)
    parser.add_argument("--folder", type=Path, default=Path("/var/tmp/syntopic-releases"))
    parser.add_argument("--options", default="", help="Variables for make, such as WORKERS=1.")
    parser.add_argument("--reuse", action="store_true", help="Go on in the root of an earlier run.")
    parsed = parser.parse_args(arguments)
    unknown = set(parsed.releases) - set(RELEASES)
    if unknown:
        parser.error(f"unknown: {', '.join(sorted(unknown))}; one of {', '.join(RELEASES)}")
    if os.geteuid() != 0 or shutil.which("debootstrap") is None:
        print("Run this as root, after: apt-get install debootstrap", file=sys.stderr)
        return 2
    names = parsed.releases or list(RELEASES)
    for name in names:
        if not RELEASES[name].keyring.exists():
            print(f"{name} needs {RELEASES[name].keyring}: package ubuntu-archive-keyring")
            return 2
    print(f"{platform.platform()}, {os.cpu_count()} cores, commit {commit()}")
    passed = [
        check(
            RELEASES[name],
            parsed.commands,
            parsed.folder / name,
            parsed.options,
            reuse=parsed.reuse,
        )
        for name in names
    ]
    return 0 if all(passed) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
