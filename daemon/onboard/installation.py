"""Installation of the service: unit, user, folders, device rules, kernel settings.

The manifest records the hash of each installed file. A file that was edited by hand is never
overwritten, and `uninstall` removes only what `install` wrote. Missions, configuration and the user
remain.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from daemon import DaemonError
from daemon.mission.canonical_json import sha256_hex
from daemon.mission.store import durable

CONFIGURATION = PurePosixPath("/etc/syntopic/service.toml")
MANIFEST = PurePosixPath("/etc/syntopic/installed.json")
KERNEL_CACHE = PurePosixPath("/var/cache/syntopic")
USER = "syntopic"

TARGETS = {
    "syntopic.service": PurePosixPath("/etc/systemd/system/syntopic.service"),
    "syntopic-disk-health.service": PurePosixPath(
        "/etc/systemd/system/syntopic-disk-health.service"
    ),
    "syntopic-disk-health.timer": PurePosixPath("/etc/systemd/system/syntopic-disk-health.timer"),
    "syntopic-poweroff.service": PurePosixPath("/etc/systemd/system/syntopic-poweroff.service"),
    "syntopic-poweroff.socket": PurePosixPath("/etc/systemd/system/syntopic-poweroff.socket"),
    "sysusers.conf": PurePosixPath("/etc/sysusers.d/syntopic.conf"),
    "tmpfiles.conf": PurePosixPath("/etc/tmpfiles.d/syntopic.conf"),
    "sysctl.conf": PurePosixPath("/etc/sysctl.d/60-syntopic.conf"),
    "udev.rules": PurePosixPath("/etc/udev/rules.d/70-syntopic.rules"),
}
DROP_IN = PurePosixPath("/etc/systemd/system/syntopic.service.d/missions.conf")
"""Lets the hardened service write where the configuration keeps missions."""

STATE_FOLDER = PurePosixPath("/var/lib/syntopic")
HIDDEN_FROM_SERVICE = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")
"""What ProtectHome= and PrivateTmp= of the unit hide."""

COMMAND_IN_TEMPLATE = "/opt/syntopic/bin/syntopic run /etc/syntopic/service.toml"
HEALTH_IN_TEMPLATE = "/opt/syntopic/bin/syntopic disk-health"
COMMAND_TIMEOUT_S = 60.0
KERNELS_TIMEOUT_S = 900.0


class InstallationError(DaemonError):
    """The service cannot be installed here; the message states what to do."""


@dataclass(frozen=True)
class InstallationStep:
    """A command to be run after the files are there, and why."""

    purpose: str
    command: tuple[str, ...]
    timeout_s: float = COMMAND_TIMEOUT_S
    needs_booted_systemd: bool = False


@dataclass
class InstallationReport:
    """What was done: files written or removed, files kept, steps with their outcome."""

    files: list[str] = field(default_factory=list)
    retained: list[str] = field(default_factory=list)
    steps: dict[str, str] = field(default_factory=dict)
    failed: list[str] = field(default_factory=list)

    def run(self, step: InstallationStep) -> None:
        """Run a step and note its outcome."""
        try:
            self.steps[step.purpose] = _run(step)
        except InstallationError as error:
            self.steps[step.purpose] = str(error)
            self.failed.append(step.purpose)


def templates_dir() -> Path:
    """Folder of the files to install: in the checkout, or in the data folder of the wheel."""
    checkout = Path(__file__).resolve().parents[2] / "systemd"
    installed = Path(sysconfig.get_path("data")) / "share" / "syntopic" / "systemd"
    for folder in (checkout, installed):
        if (folder / "syntopic.service").is_file():
            return folder
    raise InstallationError(f"the unit files are neither in {checkout} nor in {installed}")


def contents(
    command: Path,
    configuration: PurePosixPath,
    missions: Path | None,
    mirror: Path | None = None,
    copy_to: Sequence[Path] = (),
) -> dict[str, str]:
    """Text by absolute target path.

    Args:
        command: the installed `syntopic`.
        configuration: what the service will run with.
        missions: where missions are kept, where that is known.
        mirror: where they are mirrored; it may be missing when the service starts.
        copy_to: folders that a mission may be copied into after landing; they may be missing, too.

    Raises:
        InstallationError: the hardened service could not see the command or the configuration.
    """
    for path, what in ((command, "the command"), (configuration, "the configuration")):
        if str(path).startswith(tuple(f"{folder}/" for folder in HIDDEN_FROM_SERVICE)):
            raise InstallationError(
                f"{what} is {path}, which the service cannot see: it runs without access to "
                f"{', '.join(HIDDEN_FROM_SERVICE)}. Keep the program in /opt/syntopic "
                "(python3 -m venv /opt/syntopic) and the configuration in /etc/syntopic"
            )
    folder = templates_dir()
    texts = {str(to): (folder / name).read_text("utf-8") for name, to in TARGETS.items()}
    unit = str(TARGETS["syntopic.service"])
    texts[unit] = texts[unit].replace(COMMAND_IN_TEMPLATE, f"{command} run {configuration}")
    health = str(TARGETS["syntopic-disk-health.service"])
    texts[health] = texts[health].replace(HEALTH_IN_TEMPLATE, f"{command} disk-health")
    # Of two disks either may be missing at the start.
    optional = "" if mirror is None else "-"
    writable = [
        f"ReadWritePaths={optional}{folder}\n"
        for folder in (missions, mirror)
        if folder is not None and not folder.is_relative_to(STATE_FOLDER)
    ]
    writable += [f"ReadWritePaths=-{folder}\n" for folder in copy_to]
    if writable:
        texts[str(DROP_IN)] = "".join(("[Service]\n", *writable))
    return texts


def steps(command: Path, rig: str | None) -> list[InstallationStep]:
    """Steps after the files are written: user, folders, kernels, and reloading the system."""
    first = [
        InstallationStep("make the user", ("systemd-sysusers", str(TARGETS["sysusers.conf"]))),
        InstallationStep(
            "make the folders", ("systemd-tmpfiles", "--create", str(TARGETS["tmpfiles.conf"]))
        ),
    ]
    compile_kernels = InstallationStep(
        "compile the pipeline's kernels",
        (
            *("runuser", "-u", USER, "--", "env", f"NUMBA_CACHE_DIR={KERNEL_CACHE}"),
            *(str(command), "kernels", rig or ""),
        ),
        KERNELS_TIMEOUT_S,
    )
    last = [
        InstallationStep(
            "kernel settings", ("sysctl", "-q", "-p", str(TARGETS["sysctl.conf"])), 10.0, True
        ),
        InstallationStep("device rules", ("udevadm", "control", "--reload"), 10.0, True),
        InstallationStep("device rules for what is plugged in", ("udevadm", "trigger"), 10.0, True),
        InstallationStep("read the unit", ("systemctl", "daemon-reload"), COMMAND_TIMEOUT_S, True),
    ]
    return [*first, *([compile_kernels] if rig else []), *last]


def install(
    texts: dict[str, str],
    todo: Sequence[InstallationStep],
    *,
    root: Path,
    log: Callable[[str], None],
    replace: bool = False,
) -> InstallationReport:
    """Write the files below `root` and, where `root` is the machine itself, run the steps.

    Args:
        texts: text by absolute path, see `contents`.
        todo: see `steps`; a staged installation (`root` is not `/`) leaves them to the first boot.
        root: `/`, or the root of an image.
        log: called with each step as it begins.
        replace: overwrite files that were edited by hand.

    Raises:
        InstallationError: a file was edited by hand, or may not be written.
    """
    noted = _manifest(root)
    edited = [
        path
        for path, text in texts.items()
        if (there := _hash_of(_below(root, path))) is not None
        and there not in (noted.get(path), sha256_hex(text.encode()))
    ]
    if edited and not replace:
        raise InstallationError(
            f"edited by hand since it was installed: {', '.join(edited)}. Move the change into a "
            "drop-in (systemctl edit syntopic), or give --replace"
        )
    done = InstallationReport()
    hashes = dict(noted)
    try:
        for path, text in sorted(texts.items()):
            log(f"write {path}")
            _write(_below(root, path), text)
            hashes[path] = sha256_hex(text.encode())
            done.files.append(path)
        _write(_below(root, MANIFEST), json.dumps(hashes, indent=1, sort_keys=True) + "\n")
    except OSError as error:
        raise InstallationError(
            f"{error.filename} cannot be written ({error.strerror}); install as root: "
            f"sudo {sys.argv[0]} install"
        ) from error
    if root == Path("/"):
        for step in todo:
            log(step.purpose)
            done.run(step)
    return done


def uninstall(*, root: Path, log: Callable[[str], None]) -> InstallationReport:
    """Remove what `install` wrote, unless it was edited since, and the compiled kernels.

    Raises:
        InstallationError: nothing was installed here, or it may not be removed.
    """
    noted = _manifest(root)
    if not noted:
        raise InstallationError(f"nothing was installed here: {_below(root, MANIFEST)} is missing")
    done = InstallationReport()
    if root == Path("/"):
        stop = InstallationStep(
            "stop the service", ("systemctl", "disable", "--now", "syntopic"), 120.0, True
        )
        log(stop.purpose)
        done.run(stop)
        helper = ("systemctl", "disable", "--now", "syntopic-poweroff.socket")
        done.run(InstallationStep("stop the shutdown helper", helper, 60.0, True))
    try:
        for path, hash_noted in sorted(noted.items()):
            there = _hash_of(_below(root, path))
            if there == hash_noted:
                log(f"remove {path}")
                _below(root, path).unlink()
                done.files.append(path)
            elif there is not None:
                done.retained.append(path)
        _remove_kernels(_below(root, KERNEL_CACHE))
        _below(root, MANIFEST).unlink()
        _remove_if_empty(_below(root, DROP_IN).parent)
    except OSError as error:
        raise InstallationError(
            f"{error.filename} cannot be removed ({error.strerror}); uninstall as root"
        ) from error
    if root == Path("/"):
        done.run(InstallationStep("forget the unit", ("systemctl", "daemon-reload"), 60.0, True))
    return done


def _below(root: Path, path: str | PurePosixPath) -> Path:
    return root / str(path).lstrip("/")


def _hash_of(path: Path) -> str | None:
    try:
        return sha256_hex(path.read_bytes())
    except FileNotFoundError:
        return None


def _manifest(root: Path) -> dict[str, str]:
    try:
        noted = json.loads(_below(root, MANIFEST).read_text("utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise InstallationError(f"{_below(root, MANIFEST)} cannot be read ({error})") from error
    known = {str(path) for path in (*TARGETS.values(), DROP_IN)}
    if not isinstance(noted, dict) or not set(noted) <= known:
        raise InstallationError(f"{_below(root, MANIFEST)} names files that are not ours")
    return {str(path): str(text) for path, text in noted.items()}


def _write(path: Path, text: str) -> None:
    with durable.new_file(path) as part:
        part.write_text(text, "utf-8")
        part.chmod(0o644)  # whatever the umask of the administrator


def _run(step: InstallationStep) -> str:
    """Run a step; returns its outcome in words.

    Raises:
        InstallationError: the step failed; the message states why.
    """
    if step.needs_booted_systemd and not Path("/run/systemd/system").is_dir():
        return "left to the next boot: systemd is not running here"
    try:
        ended = subprocess.run(
            step.command, capture_output=True, text=True, timeout=step.timeout_s, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise InstallationError(f"{' '.join(step.command)}: {error}") from error
    if ended.returncode != 0:
        output = (ended.stderr or ended.stdout).strip().splitlines()
        raise InstallationError(
            f"{' '.join(step.command)} ended with {ended.returncode}: {' '.join(output[-2:])}"
        )
    return "done"


def _remove_kernels(cache: Path) -> None:
    """Only files of the compiler's cache: index (.nbi) and data (.nbc), also half written."""
    for folder, _, names in os.walk(cache, topdown=False):
        for name in names:
            if name.removesuffix(".part").endswith((".nbi", ".nbc")):
                (Path(folder) / name).unlink()
        if Path(folder) != cache:
            _remove_if_empty(Path(folder))


def _remove_if_empty(folder: Path) -> None:
    with suppress(FileNotFoundError):
        if not any(folder.iterdir()):
            folder.rmdir()
