"""A mission on two disks: what is called stored is on both, and one that fails costs nothing."""

from __future__ import annotations

import errno
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest

from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import logs_of, read
from daemon.mission.log.log_records import Message
from daemon.mission.mirror import mirrored
from daemon.mission.mirror.disk_rejoin import RejoinSettings
from daemon.mission.mirror.generations import read_generations
from daemon.mission.mirror.mirror_startup import begin_mirrored, find_disks, resume_mirrored
from daemon.mission.mirror.mirrored import DiskEvent, MirroredStorage
from daemon.mission.store.disk_identity import Disk, give_disk_id
from daemon.mission.store.level0_folder import read_sealed
from daemon.mission.store.store import verify
from daemon.mission.verification.recovery import recover
from tests.daemon.mission.faulty_disk import refusing, stalling
from tests.daemon.small_camera import (
    capture_of,
    complete_from_log,
    final_record,
    new_mission,
    pixels_of,
)
from tests.support.stopwatch import Stopwatch

pytestmark = [pytest.mark.realtime, pytest.mark.trust]

STALL_S = 0.6
POLL_S = 0.05
TIMEOUT_S = 60.0


class MirroredFlight:
    """A mirrored mission on two folders, and its events."""

    def __init__(self, roots: dict[str, Path]) -> None:
        self.roots = roots
        self.events: list[DiskEvent] = []
        self.start()

    def start(self) -> None:
        self.found = find_disks(self.roots)
        if self.found.mission is None:
            self.found = begin_mirrored(self.found, new_mission)
        else:
            self.found = resume_mirrored(self.found)
        assert self.found.mission is not None
        self.mission = self.found.mission
        recover(self.mission, complete_from_log)
        self.storage = MirroredStorage(
            self.mission.id,
            self.found.disks,
            stall_s=STALL_S,
            rejoin=RejoinSettings(POLL_S, POLL_S),
            emit=self.events.append,
            simulated=True,
        )

    def copy(self, label: str) -> Mission:
        return Mission(self.roots[label] / self.mission.id, self.mission.id)

    def expose(self, number: int) -> tuple[str, ...]:
        """Store and seal an exposure; the ids of the disks that have its frames."""
        capture = capture_of(number)
        self.storage.log.write(Message("raw/gnss", number, b"%d" % number))
        frames, disks = self.storage.write(capture, pixels_of(number))
        self.storage.log.sync()
        self.storage.seal(replace(final_record(replace(capture, frames=frames)), disks=disks))
        return disks

    def until(self, is_so: Callable[[], bool], what: str) -> None:
        watch = Stopwatch()
        while not is_so():
            assert watch.is_within(TIMEOUT_S), f"not {what}: {self.problems()}"
            self.storage.tick()
            time.sleep(0.01)

    def joined(self) -> None:
        """Wait until both disks are in use."""
        self.until(lambda: len(self.storage.in_use) == 2, "joined")

    def problems(self) -> list[str]:
        return [inactive.problem for inactive in self.storage.inactive.values()]


@pytest.fixture
def flown(tmp_path: Path) -> Iterator[MirroredFlight]:
    roots = {"root": tmp_path / "a", "mirror": tmp_path / "b"}
    for root in roots.values():
        root.mkdir()
    flight = MirroredFlight(roots)
    flight.joined()
    yield flight
    flight.storage.close()


def test_what_is_stored_is_on_both_disks_and_the_record_names_them(flown: MirroredFlight) -> None:
    ids = {give_disk_id(root) for root in flown.roots.values()}
    assert len(ids) == 2
    assert set(flown.expose(1)) == ids and set(flown.expose(2)) == ids
    flown.storage.end_mission()
    flown.storage.close()
    for label in flown.roots:
        copy = flown.copy(label)
        assert verify(copy).problems == ()
        records = [read_sealed(copy.level0(number)) for number in (1, 2)]
        assert all(record and set(record.exposure.disks) == ids for record in records)
        assert [m.payload for m in read(logs_of(copy.log_dir)[0])] == [b"1", b"2"]
        assert Mission.current(copy.root) is None
    one, other = (flown.copy(label) for label in flown.roots)
    for number in (1, 2):
        for file in sorted(one.level0(number).iterdir()):
            assert file.read_bytes() == (other.level0(number) / file.name).read_bytes()
    log, mirrored_log = logs_of(one.log_dir)[0], logs_of(other.log_dir)[0]
    assert log.name == mirrored_log.name and log.read_bytes() == mirrored_log.read_bytes()


def test_a_disk_whose_thread_ends_late_joins_and_has_what_was_stored_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a busy machine a thread takes longer to end than one poll."""
    monkeypatch.setattr(mirrored, "POLL_S", 0.0)
    roots = {"root": tmp_path / "a", "mirror": tmp_path / "b"}
    for root in roots.values():
        root.mkdir()
    flight = MirroredFlight(roots)
    try:
        (inactive,) = flight.storage.inactive.values()
        flight.until(lambda: inactive._ended.is_set(), "stopped")
        flight.expose(1)
        flight.joined()
        assert flight.copy("mirror").level0(1).is_dir()
    finally:
        flight.storage.close()
    assert flight.events[-1].name == "disk-joined"


@pytest.mark.parametrize("failing", ["root", "mirror"])
@pytest.mark.parametrize("code", [errno.EIO, errno.ENOSPC, errno.ENODEV, errno.EROFS])
def test_a_disk_that_refuses_a_frame_is_dropped_and_the_exposure_is_stored_on_the_other(
    flown: MirroredFlight, failing: str, code: int
) -> None:
    flown.expose(1)
    (left,) = set(flown.roots) - {failing}
    with refusing(flown.roots[failing], code):
        disks = flown.expose(2)
        # As soon as it refuses no more, the disk is brought up to date.
        assert not flown.copy(failing).level0(2).exists()
    assert disks == (give_disk_id(flown.roots[left]),)
    dropped = [event for event in flown.events if event.name == "disk-dropped"]
    assert [event.disk.label for event in dropped] == [failing]
    assert dropped[0].dropped_count == 1 and [d.label for d in dropped[0].in_use] == [left]
    assert failing in dropped[0].sentence and "storing goes on with" in dropped[0].sentence
    assert verify(flown.copy(left)).problems == ()
    # Before the exposure was called stored, the disk that has it recorded that it is single.
    assert read_generations(flown.copy(left).path)[-1].disks == disks


@pytest.mark.parametrize("stalled", ["root", "mirror"])
def test_a_disk_that_makes_no_progress_is_dropped_in_time_and_does_not_block_the_other(
    flown: MirroredFlight, stalled: str
) -> None:
    flown.expose(1)
    (left,) = set(flown.roots) - {stalled}
    with stalling(flown.roots[stalled]):
        begun_s = time.monotonic()
        disks = flown.expose(2)
        took_s = time.monotonic() - begun_s
        assert disks == (give_disk_id(flown.roots[left]),)
        assert took_s >= STALL_S
        watch = Stopwatch()
        flown.expose(3)
        assert watch.is_within(took_s), "a disk that was dropped is waited for"
    # What the stalled thread was about to write never gets its name.
    flown.joined()
    assert verify(flown.copy(stalled)).problems == ()
    for number in (1, 2, 3):
        one, other = (read_sealed(flown.copy(label).level0(number)) for label in flown.roots)
        assert one is not None and one == other


def test_where_both_disks_wait_none_is_accused(flown: MirroredFlight) -> None:
    with ExitStack() as stack:
        for root in flown.roots.values():
            stack.enter_context(stalling(root))
        flown.storage.note_products(1, {}, None)
        for copy in flown.storage._copies:
            # mypy infers no type for the default of a parameter of a lambda.
            copy.executor.submit(lambda root=copy.disk.root: list(root.iterdir()))  # type: ignore[misc]
        end_s = time.monotonic() + 3 * STALL_S
        while time.monotonic() < end_s:
            flown.storage.tick()
            time.sleep(0.01)
        assert len(flown.storage.in_use) == 2
    assert len(flown.expose(1)) == 2


def test_where_no_disk_takes_an_exposure_it_is_not_stored_and_both_stay_in_use(
    flown: MirroredFlight,
) -> None:
    with refusing(flown.roots["root"]), refusing(flown.roots["mirror"]):
        with pytest.raises(OSError, match="Input/output"):
            flown.storage.write(capture_of(1), pixels_of(1))
        assert len(flown.storage.in_use) == 2
    assert len(flown.expose(1)) == 2


def test_what_the_last_disk_cannot_say_of_itself_is_not_acknowledged(flown: MirroredFlight) -> None:
    """The survivor takes the frames and refuses the new generation: nothing is called stored."""
    flown.expose(1)
    state = flown.copy("root").path / ".disks.json"
    with refusing(flown.roots["mirror"]), refusing(state):
        with pytest.raises(OSError, match="Input/output"):
            flown.storage.write(capture_of(2), pixels_of(2))
        assert not flown.copy("root").level0(2).exists()
    assert len(flown.expose(3)) == 1
    assert flown.copy("root").numbers() == [1, 3]
    assert len(read_generations(flown.copy("root").path)[-1].disks) == 1


def test_a_disk_that_returns_is_brought_up_to_date_and_joins(flown: MirroredFlight) -> None:
    flown.expose(1)
    with refusing(flown.roots["root"]):
        for number in (2, 3, 4):
            assert len(flown.expose(number)) == 1
    flown.joined()
    assert [disk.label for disk in flown.storage.in_use] == ["mirror", "root"]
    assert len(flown.expose(5)) == 2
    flown.storage.end_mission()
    flown.storage.close()
    names = [event.name for event in flown.events]
    assert names == ["disk-joined", "disk-dropped", "disk-joined"]
    for label in flown.roots:
        assert flown.copy(label).numbers() == [1, 2, 3, 4, 5]
        assert verify(flown.copy(label)).problems == ()
    logs = [logs_of(flown.copy(label).log_dir)[0].read_bytes() for label in flown.roots]
    assert logs[0] == logs[1]
    histories = [read_generations(flown.copy(label).path) for label in flown.roots]
    assert histories[0] == histories[1] and len(histories[0]) == 4


def test_a_record_written_differently_on_one_disk_drops_it(flown: MirroredFlight) -> None:
    flown.expose(1)
    flown.storage._copies[1].writer._head_sha256 = "0" * 64
    flown.expose(2)
    assert [e.disk.label for e in flown.events if e.name == "disk-dropped"] == ["mirror"]
    assert "something else" in flown.events[-1].sentence
    assert verify(flown.copy("root")).problems == ()


def test_a_released_disk_is_left_alone_until_it_is_accepted(flown: MirroredFlight) -> None:
    flown.expose(1)
    flown.storage.release("mirror", "commanded by a test")
    flown.expose(2)
    end_s = time.monotonic() + 10 * POLL_S
    while time.monotonic() < end_s:
        flown.storage.tick()
        time.sleep(0.01)
    assert flown.copy("mirror").numbers() == [1] and len(flown.storage.in_use) == 1
    flown.storage.accept("mirror")
    flown.joined()
    assert flown.copy("mirror").numbers() == [1, 2]
    assert not any(event.name == "disk-dropped" for event in flown.events)


def test_an_empty_mount_point_is_not_taken_for_the_disk_and_a_new_disk_when_it_is_accepted(
    flown: MirroredFlight, tmp_path: Path
) -> None:
    flown.expose(1)
    root = flown.roots["mirror"]
    with refusing(root):
        flown.expose(2)
        old = Disk("mirror", root, give_disk_id_of(tmp_path, root))
    flown.until(lambda: any("no disk of Syntopic" in p for p in flown.problems()), "recognised")
    assert list(root.iterdir()) == []
    flown.storage.accept("mirror")
    flown.joined()
    assert give_disk_id(root) != old.id
    assert len(flown.expose(3)) == 2
    assert flown.copy("mirror").numbers() == [1, 2, 3]
    assert verify(flown.copy("mirror")).problems == ()


def give_disk_id_of(tmp_path: Path, root: Path) -> str:
    """Pull the disk: its folder is empty from now on. Its id."""
    import os

    pulled = tmp_path / "pulled"
    # The name of the target decides what is refused, so that the move itself is not.
    os.system(f"mv {root} {pulled} && mkdir {root}")
    return give_disk_id(pulled)


def test_a_disk_without_room_does_not_return(flown: MirroredFlight) -> None:
    flown.storage._rejoin = RejoinSettings(POLL_S, POLL_S, required_nbytes=1 << 62)
    with refusing(flown.roots["mirror"]):
        flown.expose(1)
    flown.until(lambda: any("GB are needed" in p for p in flown.problems()), "reported")
    assert len(flown.storage.in_use) == 1 and flown.copy("mirror").numbers() == []
