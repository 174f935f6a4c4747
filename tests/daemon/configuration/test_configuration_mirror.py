"""A mirror is refused where it cannot protect, and looked at by `check`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from daemon.configuration.model import Configuration, ConfigurationError
from daemon.onboard.preflight.check_results import CheckOutcome
from daemon.onboard.preflight.prerequisites import storage
from daemon.onboard.preflight.service_file import load
from processing.rig import Rig

pytestmark = pytest.mark.trust


def loaded(tmp_path: Path, mission: str, limits: str = "") -> tuple[Configuration, Rig]:
    config = tmp_path / "service.toml"
    config.write_text(
        f'[mission]\nroot = "a"\nrig = "ultracam-d-mini"\n{mission}\n[limits]\n{limits}\n'
        '[trigger]\ndriver = "software"\n[[head]]\ndriver = "folder"\nsensor = "SU00"\n'
        f"folder = {json.dumps(str(tmp_path))}\n"
    )
    return load(config)


def refusal(tmp_path: Path, mission: str, limits: str = "") -> str:
    with pytest.raises(ConfigurationError) as refused:
        loaded(tmp_path, mission, limits)
    return "\n".join(p for p in refused.value.problems if "mirror" in p)


def test_a_timeout_that_memory_does_not_bridge_is_refused_with_the_depth_that_does(
    tmp_path: Path,
) -> None:
    output = refusal(tmp_path, 'mirror = "b"', "mirror_timeout_s = 1.5\nexposures_in_memory = 3")
    assert "bridges 1.5 s" in output and "limits.exposures_in_memory to 4" in output
    # Without a mirror nothing is waited for.
    assert refusal_free(tmp_path, "", "mirror_timeout_s = 1.5\nexposures_in_memory = 3")
    deep = "mirror_timeout_s = 1.5\nexposures_in_memory = 4"
    assert refusal_free(tmp_path, 'mirror = "b"', deep)


def refusal_free(tmp_path: Path, mission: str, limits: str) -> bool:
    try:
        loaded(tmp_path, mission, limits)
    except ConfigurationError as error:
        return not any("mirror" in problem for problem in error.problems)
    return True


@pytest.mark.parametrize("mirror", ["a", "a/b", "."])
def test_a_mirror_in_or_around_the_root_is_refused(tmp_path: Path, mirror: str) -> None:
    output = refusal(tmp_path, f'mirror = "{mirror}"', "exposures_in_memory = 8")
    assert "give a folder on another disk" in output


def mission_of(tmp_path: Path, mirror: Path | None) -> Configuration:
    section = {"root": tmp_path / "a", "mirror": mirror, "rig": "ultracam-d-mini"}
    return Configuration.model_construct(
        mission=type("Mission", (), section)  # the only section that is looked at
    )


def test_check_cautions_where_both_lie_on_one_file_system(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    # `storage` reads no rig here.
    found = list(storage(mission_of(tmp_path, tmp_path / "b"), None))  # type: ignore[arg-type]
    assert [result.outcome for result in found] == [CheckOutcome.PASS] * 3
    assert found[2].sentence.startswith("caution:") and "same file system" in found[2].sentence
    # `storage` reads no rig here.
    assert len(list(storage(mission_of(tmp_path, None), None))) == 1  # type: ignore[arg-type]


def test_one_disk_of_two_is_enough_for_a_flight_and_the_other_is_named(tmp_path: Path) -> None:
    # `storage` reads no rig here.
    found = list(storage(mission_of(tmp_path, tmp_path / "b"), None))  # type: ignore[arg-type]
    assert found[1].outcome is CheckOutcome.FAIL and not found[1].is_blocking
    assert "mission.mirror" in found[1].sentence and not (tmp_path / "b").exists()
    (tmp_path / "a").rmdir()
    (tmp_path / "a").write_text("no folder")
    # `storage` reads no rig here.
    found = list(storage(mission_of(tmp_path, tmp_path / "b"), None))  # type: ignore[arg-type]
    assert found[0].is_blocking and "mission.root" in found[0].sentence
