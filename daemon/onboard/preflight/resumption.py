"""Resumption of an interrupted mission: its rig, and the differences from the configured rig.

The exposures of a mission are chained to its own copy of the rig; another rig needs a new mission.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from daemon.configuration.model import Configuration
from daemon.mission.layout import Mission
from daemon.mission.verification import recovery
from daemon.onboard.flight.recovery_match import seal_from_log
from daemon.onboard.preflight.check_results import CheckResult, failed, passed
from processing.rig import Rig, RigError, load_rig, shipped_rigs
from processing.rig.toml_text import parse_toml

DIFFERENCES_NAMED_MAX: Final = 6
"""Differences that the sentence names; the event lists all."""


@dataclass(frozen=True)
class Resumption:
    """How a mission is flown on.

    `refusal` is the reason and the action; empty if it can be resumed.
    """

    rig: Rig
    sentence: str = ""
    differences: tuple[str, ...] = ()
    refusal: str = ""


def resume(
    mission: Mission, configuration: Configuration, configured: Rig, config_path: Path
) -> Resumption:
    """The rig of an interrupted mission, and what differs in the one that is configured.

    Args:
        mission: what was being flown.
        configuration: the one in force.
        configured: the rig that it names.
        config_path: its path, for the command that begins a new mission.
    """
    new_mission_command = f"syntopic run {config_path} --new-mission"
    try:
        rig = load_rig(mission.rig_path)
    except RigError as error:
        problems = "; ".join(error.problems)
        return Resumption(
            configured,
            refusal=f"mission {mission.id} cannot be resumed, its rig.toml is damaged: {problems}. "
            f"Close it and begin a new one: {new_mission_command}",
        )
    known = {sensor.name for sensor in rig.sensors}
    unknown = [head.sensor for head in configuration.head if head.sensor not in known]
    differences = rig_differences(mission.rig_path, rig_file(configuration))
    sentence = f"resuming mission {mission.id} with the rig of {_calibration_label(rig)}"
    if differences:
        named = ", ".join(differences[:DIFFERENCES_NAMED_MAX])
        more = len(differences) - DIFFERENCES_NAMED_MAX
        named += f" and {more} more" if more > 0 else ""
        sentence += (
            f"; the configured rig differs in {named}. To fly with the configured rig, close this "
            f"mission and begin a new one: {new_mission_command}"
        )
    if unknown:
        return Resumption(
            rig,
            refusal=f"mission {mission.id} cannot be resumed: its rig has no sensor "
            f"{', '.join(unknown)}, which the configuration has heads for. Close it and begin a "
            f"new one: {new_mission_command}",
        )
    return Resumption(rig, sentence, tuple(differences))


def resumption_result(
    mission: Mission, configuration: Configuration, configured: Rig, config_path: Path
) -> tuple[CheckResult, Rig]:
    """Result of `check` for a mission that `run` would resume, and the rig in use."""
    resumption = resume(mission, configuration, configured, config_path)
    if resumption.refusal:
        return failed("mission", mission.id, resumption.refusal, is_blocking=True), configured
    if resumption.differences:
        return failed("mission", mission.id, resumption.sentence), resumption.rig
    return passed("mission", mission.id, resumption.sentence), resumption.rig


def close_interrupted(mission: Mission) -> Sequence[str]:
    """Seal what an interrupted mission stored, and close it; what was done, in sentences.

    Raises:
        MissionError: another process flies it.
    """
    with mission.held():
        try:
            rig = load_rig(mission.rig_path)
        except RigError as error:
            mission.close()
            return [
                f"mission {mission.id} is closed and nothing in it was sealed: "
                f"{'; '.join(error.problems)}. Put its rig.toml right, then: syntopic repair "
                f"{mission.path}"
            ]
        report = recovery.recover(mission, seal_from_log(rig))
        mission.close()
    return list(report.sentences)


def rig_file(configuration: Configuration) -> Path:
    """The rig file that a configuration names."""
    name = configuration.mission.rig
    return shipped_rigs().get(name, Path(name))


def rig_differences(flown: Path, configured: Path) -> list[str]:
    """Keys whose values differ between two rig files: `key (flown, configured)`.

    Comments, order and form do not count. A file that is not TOML differs completely.
    """
    try:
        old, new = (_leaves(parse_toml(path.read_bytes())) for path in (flown, configured))
    except (OSError, ValueError) as error:
        return [f"the complete file ({error})"]
    keys = sorted(key for key in old.keys() | new.keys() if old.get(key) != new.get(key))
    return [
        f"{key} ({_value_text(old, key)} in the mission, {_value_text(new, key)} now)"
        for key in keys
    ]


def _calibration_label(rig: Rig) -> str:
    if not rig.is_calibrated:
        return f"nominal values ({rig.calibration_id})"
    return f"calibration {rig.calibration_id} ({rig.calibration_date})"


def _leaves(value: Any, key: str = "") -> dict[str, Any]:
    """Every value that is neither table nor list of tables, by its key path."""
    if isinstance(value, Mapping):
        found: dict[str, Any] = {}
        for name, inner in value.items():
            found |= _leaves(inner, f"{key}.{name}" if key else name)
        return found
    if isinstance(value, list) and value and all(isinstance(one, Mapping) for one in value):
        found = {}
        for index, inner in enumerate(value):
            found |= _leaves(inner, f"{key}[{index}]")
        return found
    return {key: value}


def _value_text(leaves: Mapping[str, Any], key: str) -> str:
    if key not in leaves:
        return "absent"
    text = repr(leaves[key])
    return text if len(text) <= 40 else text[:37] + "..."
