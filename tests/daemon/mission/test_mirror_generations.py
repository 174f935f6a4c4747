"""After a split: which of two copies leads, what is brought together, and what is left alone."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.layout import DISCARDED, Mission
from daemon.mission.mirror.generations import next_generation, read_generations, write_generations
from daemon.mission.mirror.mirror_startup import _copy_missing_tail, find_disks
from daemon.mission.store.durable import remove_tree
from daemon.mission.store.level0_folder import CAPTURE_FILE, EXPOSURE_FILE
from daemon.mission.store.store import verify
from tests.daemon.mission.faulty_disk import refusing
from tests.daemon.mission.test_mirrored import MirroredFlight
from tests.daemon.small_camera import capture_of, new_mission, pixels_of

pytestmark = pytest.mark.trust


@pytest.fixture
def flown(tmp_path: Path) -> Iterator[MirroredFlight]:
    roots = {"root": tmp_path / "a", "mirror": tmp_path / "b"}
    for root in roots.values():
        root.mkdir()
    flight = MirroredFlight(roots)
    flight.joined()
    flight.expose(1)
    yield flight
    flight.storage.close()


def kill(flown: MirroredFlight) -> None:
    """The process is gone: nothing is closed in good order, the locks are released."""
    for inactive in flown.storage.inactive.values():
        inactive.end(5.0)
    for copy in flown.storage._copies:
        assert copy.executor.end(5.0)


def again(flown: MirroredFlight, *labels: str) -> None:
    """Another start of the service, which finds these disks only."""
    roots = dict(flown.roots)
    for label in set(roots) - set(labels):
        roots[label].rename(roots[label].with_suffix(".away"))
    flown.start()
    for label in set(roots) - set(labels):
        roots[label].with_suffix(".away").rename(roots[label])


def files(root: Path) -> dict[str, bytes]:
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file() and path.name != ".held"
    }


def test_the_copy_that_went_on_alone_leads_whatever_the_configuration_prefers(
    flown: MirroredFlight,
) -> None:
    with refusing(flown.roots["root"]):
        flown.expose(2)
        kill(flown)
    found = find_disks(flown.roots)
    assert found.mission == flown.copy("mirror") and found.findings == ()
    assert [disk.label for disk in found.disks] == ["mirror", "root"]


def test_what_a_killed_flight_wrote_to_one_disk_only_is_on_both_afterwards(
    flown: MirroredFlight,
) -> None:
    storage = flown.storage
    mirror = next(copy for copy in storage._copies if copy.disk.label == "mirror")
    capture = capture_of(2)
    # Between the two disks: the mirror has the frames and their name, the root has a part of them.
    mirror.executor.submit(lambda: mirror.writer.write_frames(capture, pixels_of(2))).result(10)
    part = flown.copy("root").level0(2).with_suffix(".part")
    part.mkdir()
    (part / "SU00.tif").write_bytes(b"half")
    kill(flown)
    again(flown, "root", "mirror")
    assert flown.found.done and "exposure 2" in flown.found.done[0]
    flown.joined()
    flown.expose(3)
    for label in flown.roots:
        assert flown.copy(label).numbers() == [1, 2, 3]
        assert verify(flown.copy(label)).problems == ()


@pytest.mark.parametrize("with_history", [(), (0,), (1,)])
def test_without_a_history_of_both_copies_nothing_is_taken_over(
    tmp_path: Path, with_history: tuple[int, ...]
) -> None:
    copies = [new_mission(tmp_path / name) for name in ("a", "b")]
    for index in with_history:
        write_generations(copies[index].path, next_generation((), ["1"], 1))
    findings: list[str] = []
    assert (_copy_missing_tail(copies[0], copies[1], findings), findings) == ([], [])


def test_a_log_that_lost_its_end_on_one_disk_is_taken_from_the_other(flown: MirroredFlight) -> None:
    (log,) = (flown.copy("root").log_dir).glob("*.mcap")
    kill(flown)
    intact = log.read_bytes()
    os.truncate(log, len(intact) - 5)
    again(flown, "root", "mirror")
    assert any(log.name in sentence for sentence in flown.found.done)
    assert log.read_bytes() == intact


def split(flown: MirroredFlight) -> None:
    """Each disk flies one exposure without the other."""
    kill(flown)
    for number, label in ((2, "root"), (3, "mirror")):
        again(flown, label)
        flown.expose(number)
        kill(flown)


def test_copies_that_each_went_on_alone_are_reported_and_left_as_they_are(
    flown: MirroredFlight,
) -> None:
    split(flown)
    numbers = {label: read_generations(flown.copy(label).path)[-1].number for label in flown.roots}
    assert len(set(numbers.values())) == 1, "both claim the same generation"
    before = {label: files(root / flown.mission.id) for label, root in flown.roots.items()}
    found = find_disks(flown.roots)
    assert any("nothing is overwritten" in finding for finding in found.findings)
    done = CliRunner().invoke(
        app, ["repair", str(flown.copy("root").path), "--mirror", str(flown.copy("mirror").path)]
    )
    assert done.exit_code != 0 and "each went on without the other" in str(done.exception)
    # In flight, too: the one that is configured first goes on, the other one is not touched.
    again(flown, "root", "mirror")
    flown.until(lambda: any("nothing is over" in p for p in flown.problems()), "reported")
    assert files(flown.copy("mirror").path) == before["mirror"]
    assert {k: v for k, v in files(flown.copy("root").path).items() if k.startswith("L0")} == {
        k: v for k, v in before["root"].items() if k.startswith("L0")
    }


def test_copies_of_one_generation_with_different_content_are_reported_and_left_as_they_are(
    flown: MirroredFlight,
) -> None:
    kill(flown)
    record = flown.copy("mirror").level0(1) / EXPOSURE_FILE
    record.chmod(0o644)
    record.write_bytes(record.read_bytes().replace(b'"mark_sigma_ns":60', b'"mark_sigma_ns":61'))
    before = {label: files(root / flown.mission.id) for label, root in flown.roots.items()}
    found = find_disks(flown.roots)
    (finding,) = found.findings
    assert "hold different exposure.json" in finding and "nothing is overwritten" in finding
    done = CliRunner().invoke(
        app, ["repair", str(flown.copy("mirror").path), "--mirror", str(flown.copy("root").path)]
    )
    assert done.exit_code != 0 and "hold different exposure.json" in str(done.exception)
    assert {label: files(root / flown.mission.id) for label, root in flown.roots.items()} == before


def test_repair_brings_the_copy_that_is_behind_up_to_date_and_sets_aside_what_differs(
    flown: MirroredFlight,
) -> None:
    with refusing(flown.roots["mirror"]):
        flown.expose(2)
        flown.expose(3)
        flown.storage.end_mission()
        flown.storage.close()
    outdated = flown.copy("mirror")
    stray = outdated.level0(2)
    shutil.copytree(flown.copy("root").level0(1), stray)
    assert Mission.current(outdated.root) is not None
    paths = [str(flown.copy(label).path) for label in ("mirror", "root")]
    done = CliRunner().invoke(app, ["repair", paths[0], "--mirror", paths[1], "--json"])
    assert done.exit_code == 0, done.output
    assert any("brought up to date" in one for one in json.loads(done.stdout)["done"])
    for label in flown.roots:
        assert verify(flown.copy(label)).problems == ()
        assert Mission.current(flown.roots[label]) is None
    assert outdated.numbers() == [1, 2, 3]
    assert (outdated.level0_root / DISCARDED / "000002-1" / CAPTURE_FILE).exists()
    one, other = (read_generations(flown.copy(label).path) for label in flown.roots)
    assert one == other and len(one[-1].disks) == 2
    again_done = CliRunner().invoke(app, ["repair", *paths[:1], "--mirror", paths[1], "--json"])
    assert json.loads(again_done.stdout)["done"][-1].endswith("0 items were copied")


def test_repair_refuses_what_is_not_the_other_copy(flown: MirroredFlight, tmp_path: Path) -> None:
    flown.storage.close()
    paths = [str(flown.copy("root").path)] * 2
    done = CliRunner().invoke(app, ["repair", paths[0], "--mirror", paths[1]])
    assert done.exit_code != 0 and "one folder" in str(done.exception)
    other = tmp_path / "c" / flown.mission.id
    shutil.copytree(flown.copy("root").path, other)
    (other / "mission.json").chmod(0o644)
    (other / "mission.json").write_bytes(b"{}")
    done = CliRunner().invoke(app, ["repair", paths[0], "--mirror", str(other)])
    assert done.exit_code != 0 and "not copies of one mission" in str(done.exception)


def test_a_mission_closed_while_a_disk_was_away_is_not_resumed_from_it(
    flown: MirroredFlight,
) -> None:
    with refusing(flown.roots["root"]):
        flown.expose(2)
        flown.storage.end_mission()
        flown.storage.close()
    assert Mission.current(flown.roots["root"]) is not None
    assert find_disks(flown.roots).mission is None
    remove_tree(flown.copy("mirror").path)
    assert find_disks(flown.roots).mission is not None, "the only copy is being flown"
