"""Publication of product folders: a complete set of files replaces an earlier one atomically.

A new set is written into a part folder of its own name, which its writer holds by a lock, so that
two writers cannot mix their files and what a dead writer left can be recognised. Publication
exchanges the two folders in one step (renameat2 with RENAME_EXCHANGE). A file system without that
step gets two renames: between them the name is absent for an instant, and a kill there leaves the
earlier set under a name from which `sweep` puts it back.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from daemon.mission.store import durable

REPLACED_SUFFIX = ".replaced"
"""Ends the name of an earlier set while a newer one takes its place in two renames."""

_SUFFIXES = (durable.PART_SUFFIX, REPLACED_SUFFIX)
_AT_FDCWD = -100
_RENAME_EXCHANGE = 2
_NO_EXCHANGE = frozenset({errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP})
_NAME_TAKEN = frozenset({errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR})
_LEFTOVER = re.compile(r"(?P<final>.+?)(?P<token>\.[0-9a-f]{8})?(?P<suffix>\.part|\.replaced)")


class StagedFolder:
    """A new folder for a set of files, which takes the name `final` when it is published.

    `part` is where the files are written; they must be durable before `publish`. `close` removes
    what was not published, or the earlier set that was replaced.

    Args:
        final: the folder; the one above it is made where it is missing.

    Raises:
        OSError: the disk refused.
    """

    def __init__(self, final: Path) -> None:
        durable.make_directories(final.parent)
        sweep(final.parent, final.name)
        self.final = final
        self.part, self._lock = _begin(final)

    def publish(self) -> None:
        """Give the files their final name in one step; an earlier set is replaced.

        Raises:
            OSError: the disk refused; an earlier set is still there.
        """
        durable.sync_directory(self.part)
        _take_name(self.part, self.final)
        durable.sync_directory(self.final.parent)

    def close(self) -> None:
        """Remove the part folder; call it once, whatever happened."""
        try:
            with suppress(OSError):
                durable.remove_tree(self.part)
        finally:
            if self._lock is not None:
                os.close(self._lock)


@contextmanager
def published(final: Path) -> Iterator[Path]:
    """A new folder to write a set of files into; it takes the name `final` when the block ends.

    The files in it must be durable by then. When the block fails, nothing of the set is left and
    an earlier set is still there.

    Args:
        final: the folder; the one above it is made where it is missing.

    Raises:
        OSError: the disk refused.
    """
    with closing(StagedFolder(final)) as staged:
        yield staged.part
        staged.publish()


def sweep(folder: Path, name: str = "") -> list[str]:
    """Clear what dead writers left in a folder of product folders.

    What a living writer holds stays. Without `name` everything unfinished in `folder` is cleared.

    Args:
        name: only what was left of the set of this name.

    Returns:
        One sentence for each thing done.
    """
    try:
        names = sorted(entry.name for entry in folder.iterdir())
    except FileNotFoundError:
        return []
    done = []
    for found in names:
        match = _LEFTOVER.fullmatch(found) if found.endswith(_SUFFIXES) else None
        if match is None or (name and (match["final"] != name or match["token"] is None)):
            continue
        entry, final = folder / found, folder / match["final"]
        if match["suffix"] == REPLACED_SUFFIX:
            with suppress(OSError):  # its writer lives, or another one was faster
                if final.exists():
                    _discard(entry, final)
                else:
                    entry.rename(final)
                    done.append(f"{folder.name}/{final.name}: earlier products put back")
        elif _remove_abandoned(entry):
            done.append(f"{folder.name}/{found}: removed, its writer did not finish")
    if done:
        durable.sync_directory(folder)
    return done


def _begin(final: Path) -> tuple[Path, int | None]:
    """A new part folder, and the descriptor that holds its lock."""
    while True:
        part = _part_name(final)
        try:
            part.mkdir()
            lock = _locked(part)
        except (FileExistsError, BlockingIOError, FileNotFoundError):
            continue  # a sweep came between the two calls
        return part, lock


def _locked(folder: Path) -> int | None:
    """A descriptor that locks the folder; None where the file system locks no folders.

    Raises:
        BlockingIOError: another process holds it.
        FileNotFoundError: it was removed in the meantime.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if folder.stat().st_ino != os.fstat(descriptor).st_ino:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(folder))
    except (BlockingIOError, FileNotFoundError):
        os.close(descriptor)
        raise
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def _remove_abandoned(entry: Path) -> bool:
    """Remove what no live writer holds; no writer can begin to hold it during removal."""
    try:
        lock = _locked(entry)
    except NotADirectoryError:
        entry.unlink(missing_ok=True)
        return True
    except OSError:
        return False
    if lock is None:
        return False
    try:
        durable.remove_tree(entry)
    finally:
        os.close(lock)
    return True


def _take_name(part: Path, final: Path) -> None:
    """Give the part folder its final name; what had that name has the part's afterwards, or none.

    Another writer may publish under the same name at the same time: the later one wins, whole.
    """
    while True:
        try:
            try:
                _exchange(part, final)
            except FileNotFoundError:
                part.rename(final)
        except OSError as error:
            if error.errno in _NO_EXCHANGE:
                if _renamed_in_two_steps(part, final):
                    return
            elif error.errno not in _NAME_TAKEN:
                raise
        else:
            return


def _renamed_in_two_steps(part: Path, final: Path) -> bool:
    """Like `_take_name` where folders cannot be exchanged; False: another writer was faster."""
    replaced = part.with_suffix(REPLACED_SUFFIX)
    with suppress(FileNotFoundError):
        final.rename(replaced)
        durable.sync_directory(final.parent)
    try:
        part.rename(final)
    except OSError as error:
        if error.errno in _NAME_TAKEN:
            _discard(replaced, final)
            return False
        with suppress(OSError):
            replaced.rename(final)
        raise
    durable.sync_directory(final.parent)
    _discard(replaced, final)
    return True


def _discard(replaced: Path, final: Path) -> None:
    """Remove a set that was replaced; half removed it must not be taken for a set to put back."""
    unneeded = _part_name(final)
    try:
        replaced.rename(unneeded)
    except FileNotFoundError:
        return  # put back by a sweep, or discarded by it
    durable.remove_tree(unneeded)


def _part_name(final: Path) -> Path:
    return final.with_name(f"{final.name}.{secrets.token_hex(4)}{durable.PART_SUFFIX}")


def _exchange(one: Path, other: Path) -> None:
    """Exchange two names in one step.

    Source: renameat2(2), RENAME_EXCHANGE.

    Raises:
        FileNotFoundError: one of them is absent.
        OSError: ENOSYS or EINVAL where the C library, the kernel or the file system does not have
            it.
    """
    try:
        renameat2 = ctypes.CDLL(None, use_errno=True).renameat2
    except AttributeError:
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS)) from None
    if renameat2(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE):
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code), str(one), None, str(other))
