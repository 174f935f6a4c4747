"""`syntopic transfer`: a mission on its way from the aircraft's disk to another."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from daemon.cli.options import AsJson
from daemon.configuration.model import ConfigurationError
from daemon.terminal.console import Console
from drivers.base.extras import require

if TYPE_CHECKING:
    from daemon.mission.transfer.store_transfer import StoreTransferReport
    from daemon.mission.transfer.transfer import Progress as ShowProgress
    from daemon.mission.transfer.transfer import TransferReport

HELP = """Copy a mission to another disk or an object store and verify every file.

Each file is read back from the copy and compared by hash, in every run. An interrupted
transfer continues when the same command is run again. The source remains unless --remove-source is
given: then the copy is sealed, the source is removed, and no later run changes the copy.

An object store is named as s3://bucket/folder, gs://bucket/folder or az://container/folder and
requires `pip install 'syntopic[stores]'`. Credentials come from the environment.

Examples: `syntopic transfer MISSION /media/shuttle`,
`syntopic transfer MISSION s3://survey/2026 --remove-source`
"""


def _to_disk(
    mission: Path, disk: Path, show: ShowProgress, *, remove_source: bool
) -> TransferReport:
    from daemon.mission.layout import Mission
    from daemon.mission.transfer.transfer import finish_transfer, transfer

    finished = None if mission.exists() else finish_transfer(mission, disk, progress=show)
    return finished or transfer(
        Mission.open(mission), disk, remove_source=remove_source, progress=show
    )


def _to_store(
    mission: Path, url: str, show: ShowProgress, *, remove_source: bool
) -> StoreTransferReport:
    from daemon.mission.layout import Mission
    from daemon.mission.transfer.object_store import ObjectStore
    from daemon.mission.transfer.store_transfer import finish_store_transfer, transfer_to_store

    require("stores")
    folder = ObjectStore(url)
    finished = None if mission.exists() else finish_store_transfer(mission, folder, progress=show)
    return finished or transfer_to_store(
        Mission.open(mission), folder, remove_source=remove_source, progress=show
    )


def folder_of(target: str) -> Path:
    """The folder of a path or of a file:// address.

    Raises:
        ConfigurationError: an address of another kind.
    """
    from urllib.parse import unquote, urlsplit

    if "://" not in target:
        return Path(target)
    parts = urlsplit(target)
    if parts.scheme != "file" or parts.netloc not in ("", "localhost") or parts.query:
        raise ConfigurationError(
            [f"{target}: no folder; a path, file:///folder, s3://, gs:// and az:// are right"]
        )
    return Path(unquote(parts.path))


def transfer(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    target: Annotated[str, typer.Argument(help="Folder of the other disk, or of an object store.")],
    remove_source: Annotated[
        bool, typer.Option("--remove-source", help="Remove the source after the copy is sealed.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    from daemon.mission.transfer.object_store import is_store_url

    columns = (BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("copying and reading back", total=None)

        def show(done: int, total: int) -> None:
            progress.update(task, completed=done, total=total)

        report: TransferReport | StoreTransferReport
        if is_store_url(target):
            report = _to_store(mission, target, show, remove_source=remove_source)
        else:
            report = _to_disk(mission, folder_of(target), show, remove_source=remove_source)
    uploads = None if isinstance(report.target, Path) else report.uploads
    if uploads is not None and uploads.sentence:
        Console(stderr=True, soft_wrap=True).print(uploads.sentence, highlight=False)
    if as_json:
        typer.echo(
            json.dumps(
                {
                    "target": str(report.target),
                    "copied": report.copied,
                    "already_present": report.already_present,
                    "nbytes": report.nbytes,
                    "exposures": report.verified.exposures,
                    "frames": report.verified.frames,
                    "source_removed": report.source_removed,
                    "sealed_utc": report.sealed_utc,
                    **({} if uploads is None else {"unfinished_uploads": asdict(uploads)}),
                }
            )
        )
        return
    console = Console(soft_wrap=True)
    console.print(
        f"{report.copied} files copied, {report.already_present} identical files unchanged, "
        f"{report.nbytes / 1e9:.2f} GB in all; {report.verified.exposures} exposures and "
        f"{report.verified.frames} frames verified in {report.target}"
    )
    if report.sealed_utc:
        console.print(f"The copy is sealed since {report.sealed_utc}.")
    console.print("The source is removed." if report.source_removed else "The source is unchanged.")
