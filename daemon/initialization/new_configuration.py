"""Writing the files of a new rig: all of them complete and readable, or none."""

from __future__ import annotations

import datetime
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from daemon.configuration.model import ConfigurationError
from daemon.configuration.schemas import SCHEMA_FILES, schema_file_name
from daemon.mission.store.durable import new_files
from daemon.onboard.preflight.service_file import load

RIG_FILE: Final = "rig.toml"
SERVICE_FILE: Final = "service.toml"


class ExistingConfigurationError(ConfigurationError):
    """A folder that has a configuration already; the message names its files and the cure."""


def refuse_existing(folder: Path) -> None:
    """Raise where the folder has a rig file or a service configuration.

    Raises:
        ExistingConfigurationError: it has one.
    """
    there = existing_files(folder)
    if there:
        names = " and ".join(path.name for path in there)
        raise ExistingConfigurationError(
            [
                f"{folder.resolve()} has {names} already; nothing was changed. Give another "
                "folder, or --replace to keep the old files under another name and write new ones"
            ]
        )


def existing_files(folder: Path) -> list[Path]:
    """Files that a new configuration would replace."""
    paths = (folder / RIG_FILE, folder / SERVICE_FILE)
    return [path for path in paths if path.exists() or path.is_symlink()]


def write_configuration(folder: Path, rig: str, service: str, *, replace: bool) -> list[Path]:
    """Write both files and their schemas. They are read back first, as the service reads them.

    Args:
        folder: created if it is missing.
        rig: text of the rig file.
        service: text of the service configuration.
        replace: whether files that exist are kept under another name; otherwise they are refused.

    Returns:
        The files written, then the names under which earlier ones are kept.

    Raises:
        ExistingConfigurationError: there are files, and `replace` is false.
        ConfigurationError: the files contradict each other.
        OSError: the disk refused.
    """
    if not replace:
        refuse_existing(folder)
    texts = {RIG_FILE: rig, SERVICE_FILE: service}
    kept: list[Path] = []
    with _without_interruption(), new_files(folder, last=SERVICE_FILE) as part:
        for name, text in texts.items():
            (part / name).write_text(text, encoding="utf-8")
        for kind, shipped in SCHEMA_FILES.items():
            (part / schema_file_name(kind)).write_bytes(shipped.read_bytes())
        load(part / SERVICE_FILE)
        kept = [_keep(path) for path in existing_files(folder)]
    written = [folder / name for name in texts]
    return [*written, *(folder / schema_file_name(kind) for kind in SCHEMA_FILES), *kept]


def _keep(path: Path) -> Path:
    """Rename an earlier file to a free name with the present time."""
    now = datetime.datetime.now(datetime.UTC).strftime("%Y%m%dT%H%M%S.%fZ")
    kept = path.with_name(f"{path.stem}-until-{now}{path.suffix}")
    path.rename(kept)
    return kept


@contextmanager
def _without_interruption() -> Iterator[None]:
    """Hold Ctrl-C back for the short time of writing; it then ends the command."""
    earlier = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, earlier)
