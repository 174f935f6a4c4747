"""A mission on one of several disks: its thread, Level-0 writer and file of the flight log.

What is done on which disk is decided in `daemon.mission.mirror.mirrored`. Methods that touch the
disk are to be called in its thread.
"""

from __future__ import annotations

from contextlib import ExitStack, suppress

from daemon.mission.layout import CURRENT_FILE, Mission
from daemon.mission.log.log_seals import close_run, seal_logs
from daemon.mission.mirror.mirrored_log import LogFile
from daemon.mission.mirror.resync import MirrorError, Resync
from daemon.mission.store import durable
from daemon.mission.store.disk_executor import DiskExecutor
from daemon.mission.store.disk_identity import Disk
from daemon.mission.store.store import Level0Writer
from daemon.mission.verification.chain_file import ChainFile


class MissionCopy:
    """The mission on one disk. `refusal` is the error of its log's last refused write."""

    def __init__(self, disk: Disk, mission_id: str) -> None:
        self.disk = disk
        self.mission = Mission(disk.root / mission_id, mission_id)
        self.executor = DiskExecutor(disk, self._release)
        self.refusal: OSError | None = None
        self._holding = ExitStack()
        self._writer: Level0Writer | None = None
        self._chain: ChainFile | None = None
        self._log: LogFile | None = None

    @property
    def writer(self) -> Level0Writer:
        """Writes Level-0 here, once `open` or `join` has been done."""
        assert self._writer is not None
        return self._writer

    def open(self, log_name: str) -> None:
        """Open the index, seal the logs of earlier runs, and begin a new one.

        Raises:
            OSError, CatalogError: it cannot be written.
            MissionError: another process holds it.
        """
        self._holding.enter_context(self.mission.held())
        durable.make_directories(self.mission.log_dir)
        chain = self._open_writer()
        with suppress(OSError):
            seal_logs(self.mission, chain)
        self._log = LogFile(self.mission.log_dir / log_name)
        with suppress(OSError):  # recovery notes it if the disk refuses
            chain.log_begun(log_name)

    def join(self, leading: MissionCopy, resync: Resync, log_name: str, offset: int) -> None:
        """Take over index and log of the leading copy; all else is here already.

        The copy is held until it is let go of.

        Raises:
            OSError, CatalogError: a disk refused.
            MissionError: another process holds the copy here.
            MirrorError: the chain of records here ends with another one.
        """
        self._holding.enter_context(self.mission.held())
        resync.step = self.executor.step
        resync.copy_open_log(log_name, offset)
        resync.copy_chain_and_index()
        self._open_writer()
        if self.writer.head_sha256 != leading.writer.head_sha256:
            raise MirrorError("its chain of records ends with another one; run syntopic repair")
        self._log = LogFile(self.mission.log_dir / log_name, offset)
        marker = leading.disk.root / CURRENT_FILE
        durable.replace_file(self.disk.root / CURRENT_FILE, marker.read_bytes())

    def append_log(self, data: bytes) -> None:
        """Append to the log; a refusal is kept in `refusal`."""
        if self._log is not None:
            try:
                self._log.append(data)
            except OSError as error:
                self.refusal = error

    def sync_log(self) -> None:
        """Sync the log; a refusal is kept in `refusal`."""
        if self._log is not None:
            try:
                self._log.sync()
            except OSError as error:
                self.refusal = error

    def write_note(self, name: str, data: bytes) -> None:
        """Write a small file below the disk's root; a refusal is kept in `refusal`."""
        try:
            durable.replace_file(self.disk.root / name, data)
        except OSError as error:
            self.refusal = error

    def close(self) -> None:
        """Close log, chain file and index; the disk may be unmounted then."""
        assert self._chain is not None
        self.sync_log()
        self._close_log()
        with suppress(OSError):
            seal_logs(self.mission, self._chain)
        if not self.writer.unindexed:
            with suppress(OSError):  # `syntopic repair` closes it if the disk refuses
                close_run(self.mission, self._chain, "landing")
        self._release()

    def _open_writer(self) -> ChainFile:
        self._chain = self.mission.open_chain()
        self._writer = Level0Writer(self.mission, chain=self._chain, step=self.executor.step)
        return self._chain

    def _close_log(self) -> None:
        if self._log is not None:
            self._log.close()
            self._log = None

    def _release(self) -> None:
        # An index that is closed late would take files of its successor's away by their names.
        self._close_log()
        if self._writer is not None:
            self._writer.close()
        if self._chain is not None:
            self._chain.close()
        self._holding.close()
