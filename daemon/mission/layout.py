"""The mission folder: where things lie in it, how it comes to be, and which one is being flown.

What is written into it, and how, is in `daemon.mission.store.store`, `daemon.mission.store.level2`
and `daemon.mission.log.flight_log`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from daemon.mission.canonical_json import (
    RECORD_MAX_BYTES,
    RecordError,
    canonical_bytes,
    parse_record,
    plain_name,
    sha256_hex,
)
from daemon.mission.foreign_files import is_on_local_disk
from daemon.mission.store import durable
from daemon.mission.verification.chain_file import CHAIN_FILE, ChainFile, first_line
from daemon.mission.writer_lock import MissionError as MissionError
from daemon.mission.writer_lock import is_locked, writer_lock
from processing.rig.toml_text import TomlError, parse_toml

CURRENT_FILE = "current-mission.json"
"""In the root: which mission a restarted service continues; absent between flights."""

MISSION_FORMAT = 2
"""From 2 on a mission is created with its chain file and the hash of its flight plan."""
DISCARDED = ".discarded"
"""In L0: what recovery set aside because it was never reported as stored."""

_SCHEME = re.compile(r"[a-z][a-z0-9+.-]*")
_EXPOSURE_FOLDER = re.compile(r"[0-9]{6,12}")


@dataclass(frozen=True)
class Mission:
    """A flight's folder. `id` is its name."""

    path: Path
    id: str

    @classmethod
    def create(
        cls,
        root: Path,
        rig_name: str,
        *,
        rig_toml: bytes,
        service_toml: bytes,
        plan: tuple[str, bytes] | None = None,
        started_utc: datetime,
        started_gps_ns: int | None = None,
        simulated: bool = False,
    ) -> Mission:
        """Create a mission and make it the one a restarted service continues.

        The folder appears whole or not at all. A second mission within the same second gets
        `-2` behind its id. `plan` is how the name of the flight plan ends, and its content.

        Raises:
            MissionError: a rig name that is no file name, a time without a zone, or another
                mission still being flown.
            OSError: the disk refused.
        """
        if not plain_name(rig_name):
            raise MissionError(f"rig name {rig_name!r}: letters, digits, '_' and '-' make an id")
        if started_utc.tzinfo is None:
            raise MissionError("the start of a mission is in UTC; give a time with its zone")
        durable.make_directories(root)
        if (flying := cls.current(root)) is not None:
            raise MissionError(f"mission {flying.id} is not closed; continue or close it first")
        mission_id = _free_id(root, started_utc, rig_name)
        part = root / f".{mission_id}{durable.PART_SUFFIX}"
        durable.remove_tree(part)
        part.mkdir()
        for folder in ("L0", "L2", "log", "export"):
            (part / folder).mkdir()
        content = {
            "format": MISSION_FORMAT,
            "id": mission_id,
            "rig": rig_name,
            "rig_sha256": sha256_hex(rig_toml),
            "service_sha256": sha256_hex(service_toml),
            "started_utc": _utc_text(started_utc),
            "started_gps_ns": None if started_gps_ns is None else str(started_gps_ns),
            "plan": None
            if plan is None
            else {"file": f"plan{plan[0]}", "sha256": sha256_hex(plan[1])},
            **({"simulated": True} if simulated else {}),
        }
        about = canonical_bytes(content)
        durable.create_file(part / "mission.json", [about])
        durable.create_file(part / CHAIN_FILE, [first_line(sha256_hex(about))], mode=0o644)
        durable.create_file(part / "rig.toml", [rig_toml])
        durable.create_file(part / "service.toml", [service_toml], mode=0o440)
        if plan is not None:
            durable.create_file(part / f"plan{plan[0]}", [plan[1]])
        durable.rename_directory(part, root / mission_id)
        durable.replace_file(root / CURRENT_FILE, canonical_bytes({"mission": mission_id}))
        return cls(root / mission_id, mission_id)

    @classmethod
    def open(cls, path: Path, *, checks_subfolders: bool = True) -> Mission:
        """A mission folder that exists, flown or laid out by hand.

        Args:
            path: the folder.
            checks_subfolders: refuse links and pipes in the folders below as well; without it the
            caller
                does not follow them.

        Raises:
            MissionError: no such folder, one without exposures' folder L0, or one that holds
                anything but plain files and folders: what a link or a pipe leads to is not ours.
        """
        if not path.is_dir():
            raise MissionError(_no_folder(path))
        if not (path / "L0").is_dir():
            raise MissionError(f"{path}: has no folder L0; a mission keeps its exposures there")
        if (
            special_file := _first_special_file(path, checks_subfolders=checks_subfolders)
        ) is not None:
            raise MissionError(
                f"{special_file}: is a link, a pipe or a device; a mission holds plain files and "
                "folders: put what it leads to in its place"
            )
        return cls(path, path.resolve().name)

    @classmethod
    def current(cls, root: Path) -> Mission | None:
        """The mission being flown, or None after an orderly end.

        Raises:
            MissionError: the marker is damaged or names a folder that is gone.
        """
        marker = root / CURRENT_FILE
        try:
            content = parse_record(marker.read_bytes(), CURRENT_FILE)
        except FileNotFoundError:
            return None
        mission_id = content.get("mission")
        if not isinstance(mission_id, str) or not plain_name(mission_id):
            raise MissionError(f"{marker}: names no mission; remove it to start a new one")
        if not (root / mission_id).is_dir():
            raise MissionError(
                f"{marker}: names mission {mission_id}, and {root / mission_id} is no folder; put "
                f"the folder back to continue the mission, or remove {marker} to start without it"
            )
        try:
            return cls.open(root / mission_id)
        except MissionError as error:
            raise MissionError(f"{marker}: {error}; remove the file to start again") from error

    @property
    def root(self) -> Path:
        return self.path.parent

    @property
    def level0_root(self) -> Path:
        return self.path / "L0"

    @property
    def level2_root(self) -> Path:
        return self.path / "L2"

    @property
    def plan_path(self) -> Path | None:
        """The flight plan that was flown after, where there was one."""
        return next(iter(sorted(self.path.glob("plan.*"))), None)

    @property
    def log_dir(self) -> Path:
        return self.path / "log"

    @property
    def export_dir(self) -> Path:
        return self.path / "export"

    @property
    def catalog_path(self) -> Path:
        return self.path / "mission.db"

    @property
    def rig_path(self) -> Path:
        return self.path / "rig.toml"

    @property
    def service_path(self) -> Path:
        return self.path / "service.toml"

    def level0(self, number: int) -> Path:
        """The folder of an exposure's frames and record."""
        return self.level0_root / exposure_name(number)

    def level2(self, number: int) -> Path:
        """The folder of an exposure's products."""
        return self.level2_root / exposure_name(number)

    @property
    def is_simulated(self) -> bool:
        """Whether mission.json states that the hardware is emulated; False where there is none."""
        return self.about().get("simulated") is True

    @property
    def is_current(self) -> bool:
        """Whether a restarted service would continue this mission."""
        marker = self.path.resolve().parent / CURRENT_FILE
        try:
            return parse_record(marker.read_bytes(), CURRENT_FILE).get("mission") == self.id
        except (OSError, RecordError):
            return False

    @property
    def chain_path(self) -> Path:
        return self.path / CHAIN_FILE

    def about(self) -> dict[str, Any]:
        """Content of mission.json; empty where there is none or it is damaged."""
        try:
            return parse_record((self.path / "mission.json").read_bytes(), "mission.json")
        except (OSError, RecordError):
            return {}

    def open_chain(self) -> ChainFile:
        """The chain file, to append to; only for the process that holds the mission.

        Raises:
            OSError: the disk refused.
        """
        is_expected = self.about().get("format") != 1
        return ChainFile(self.path, self.genesis_sha256(), is_expected=is_expected)

    def flown_configuration(self) -> dict[str, Any]:
        """The content of service.toml; empty for a mission without one.

        Raises:
            MissionError: it cannot be read.
        """
        try:
            if self.service_path.stat().st_size > RECORD_MAX_BYTES:
                raise MissionError(f"{self.service_path}: too large for a configuration")
            return parse_toml(self.service_path.read_bytes())
        except FileNotFoundError:
            return {}
        except (OSError, TomlError) as error:
            raise MissionError(
                f"{self.service_path}: cannot be read ({error}); put a copy of what was flown there"
            ) from error

    def file_named(self, name: str | Path) -> Path:
        """Path of a file or folder that the mission's own configuration names.

        A mission comes from anywhere. An absolute path is used where it is on a local disk and
        passes no link; of any other name only the last part, in the mission folder.
        """
        named = Path(name)
        return named if is_on_local_disk(named) else self.path / (named.name or "?")

    def numbers(self) -> list[int]:
        """Numbers of the exposures whose folder is there, ascending."""
        return sorted(
            int(entry.name)
            for entry in os.scandir(self.level0_root)
            if entry.is_dir(follow_symlinks=False) and is_exposure_name(entry.name)
        )

    def next_number(self) -> int:
        """A number that no complete, unfinished or discarded folder has used; the first is 1.

        A trigger whose frames never came leaves no folder: `daemon.mission.verification.recovery`
        finds it in the log, and its report contains the number to continue with.
        """
        return 1 + max((number for number in self._used_numbers()), default=0)

    def genesis_sha256(self) -> str:
        """What the first record of the mission quotes: the hash of its mission.json.

        Empty for a mission laid out by hand, whose records are not chained.
        """
        try:
            return sha256_hex((self.path / "mission.json").read_bytes())
        except FileNotFoundError:
            return ""

    def close(self) -> None:
        """The flight ended normally: a service started later begins a new mission."""
        marker = self.root / CURRENT_FILE
        flying = Mission.current(self.root)
        if flying is not None and flying.id == self.id:
            marker.unlink()
            durable.sync_directory(self.root)

    def is_held(self) -> bool:
        """Whether another process writes into it now: the service that flies it, or a command."""
        return is_locked(self.path)

    @contextmanager
    def held(self, *, is_shared: bool = False) -> Iterator[None]:
        """Keep other writers out of the mission until the block ends.

        Every writer of a mission holds this lock; readers do not.

        Args:
            is_shared: admit other holders that share: runs that commit by manifests.

        Raises:
            MissionError: another process holds it; the sentence names it.
        """
        with writer_lock(self.path, is_shared=is_shared):
            yield

    def _used_numbers(self) -> Iterator[int]:
        for folder in (self.level0_root, self.level0_root / DISCARDED, self.level2_root):
            if folder.is_dir():
                for entry in os.scandir(folder):
                    match = _EXPOSURE_FOLDER.match(entry.name)
                    if match:
                        yield int(match.group())


def exposure_name(number: int) -> str:
    """The name of an exposure's folder, six digits or more."""
    if number < 1:
        raise MissionError(f"exposure {number}: exposures are counted from 1")
    return f"{number:06d}"


def _no_folder(path: Path) -> str:
    """Why there is no folder: `Path` makes "s3:/bucket/a" of an address."""
    scheme, separator, rest = str(path).partition(":/")
    if not separator or not _SCHEME.fullmatch(scheme):
        return f"{path}: no such folder; give the path of a mission"
    rest = rest.lstrip("/")
    if scheme == "file":
        return f"file:///{rest}: this command works on folders; give the path: /{rest}"
    return (
        f"{scheme}://{rest}: this command works on folders. Copy the mission into a folder with "
        "the store's own client, and check the copy: syntopic verify FOLDER. `syntopic process`, "
        "`verify` and `catalog` read a store; `transfer` writes into one"
    )


def is_exposure_name(name: str) -> bool:
    """Whether a folder of this name is an exposure's: `000000` and `0000001` are not."""
    return (
        _EXPOSURE_FOLDER.fullmatch(name) is not None
        and int(name) > 0
        and exposure_name(int(name)) == name
    )


def _first_special_file(folder: Path, *, checks_subfolders: bool) -> str | None:
    """The first entry below a folder that is neither plain file nor folder; None where none is."""
    waiting = [str(folder)]
    while waiting:
        try:
            entries = list(os.scandir(waiting.pop()))
        except OSError:
            continue  # being replaced, or unreadable; its reader reports that
        for entry in entries:
            if entry.is_dir(follow_symlinks=False):
                waiting += [entry.path] if checks_subfolders else []
            elif not entry.is_file(follow_symlinks=False):
                return entry.path
    return None


def _free_id(root: Path, started_utc: datetime, rig_name: str) -> str:
    first = f"{started_utc.astimezone(UTC):%Y%m%dT%H%M%SZ}-{rig_name}"
    mission_id, repetition = first, 1
    while (root / mission_id).exists():
        repetition += 1
        mission_id = f"{first}-{repetition}"
    return mission_id


def _utc_text(instant: datetime) -> str:
    return f"{instant.astimezone(UTC):%Y-%m-%dT%H:%M:%S.%fZ}"
