"""Reading `service.toml`: all errors of the file, its devices, rig and plan are reported together.

The keys are in `daemon.configuration.model`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from daemon.configuration.model import (
    RENAMED_KEYS,
    SIGNING_STATE,
    Configuration,
    ConfigurationError,
    TriggerSection,
    local_rig,
)
from daemon.configuration.problems import (
    device_problems,
    mirror_problems,
    nested_value,
    rig_problems,
)
from daemon.planning.plan_readers import PlanError, read_plan
from processing.rig import Rig, RigError, find_rig
from processing.rig.problem_sentences import (
    Finding,
    LineOf,
    findings_of,
    line_finder,
    sentences,
    shown,
)
from processing.rig.toml_text import TomlError, read_toml


def load(path: Path) -> tuple[Configuration, Rig]:
    """Read a service configuration and the rig it names.

    Relative paths are relative to the folder of the file.

    Raises:
        ConfigurationError: with one sentence per error: file, line, key, value, and the correction.
    """
    try:
        content, data = read_toml(path, "a service.toml")
    except TomlError as error:
        raise ConfigurationError([str(error)]) from error
    return from_mapping(content, path, line_finder(data))


def from_mapping(
    content: Mapping[str, Any], path: Path, line_of: LineOf | None = None
) -> tuple[Configuration, Rig]:
    """Validate parsed TOML; `path` names the file in messages and anchors relative paths."""
    folder = path.parent.resolve()
    findings = device_problems(content, frozenset(TriggerSection.model_fields))
    rig: Rig | None = None
    rig_name = nested_value(content, "mission", "rig")
    if isinstance(rig_name, str):
        try:
            rig = find_rig(local_rig(rig_name, path.parent))
        except RigError as error:
            findings += [(("mission", "rig"), f"cannot be used: {p}") for p in error.problems]
    configuration: Configuration | None = None
    try:
        configuration = Configuration.model_validate(content, context={"folder": folder})
    except ValidationError as error:
        findings += findings_of(error, RENAMED_KEYS)
    findings += _file_problems(content, path.parent)
    if rig is not None:
        findings += rig_problems(content, rig)
    if configuration is not None and rig is not None and configuration.mission.mirror is not None:
        findings += mirror_problems(
            configuration.mission.root,
            configuration.mission.mirror,
            configuration.limits.mirror_timeout_s,
            configuration.limits.exposures_in_memory,
            rig,
        )
    if findings or configuration is None or rig is None:
        raise ConfigurationError(sentences(findings, path.name, line_of))
    return _with_signing_state(configuration), rig


def _file_problems(content: Mapping[str, Any], folder: Path) -> list[Finding]:
    """Files and folders that the configuration names and that are not there, or not usable."""
    findings: list[Finding] = []
    radiometry = nested_value(content, "mission", "radiometry")
    if isinstance(radiometry, str) and not (folder / radiometry).is_dir():
        text = (
            f"is {shown(radiometry)}, and there is no such folder; give the folder with a "
            "calibration of each sensor, or leave the key out"
        )
        findings.append((("mission", "radiometry"), text))
    plan_file = nested_value(content, "plan", "file")
    if isinstance(plan_file, str):
        try:
            read_plan(folder / plan_file)
        except PlanError as error:
            findings.append((("plan", "file"), f"cannot be used: {error}"))
    model = nested_value(content, "plan", "elevation")
    if isinstance(model, str) and not (folder / model).is_file():
        findings.append((("plan", "elevation"), f"is {shown(model)}, and there is no such file"))
    points = nested_value(content, "triangulation", "control_points")
    if isinstance(points, str) and not (folder / points).is_file():
        text = f"is {shown(points)}, and there is no such file"
        findings.append((("triangulation", "control_points"), text))
    return findings


def _with_signing_state(configuration: Configuration) -> Configuration:
    """The configuration with a file for the timestamps of signed MAVLink messages."""
    watch = configuration.watch
    mavlink = watch.mavlink if watch else None
    if not watch or not mavlink or not mavlink.signing_key or mavlink.signing_state:
        return configuration
    state = configuration.mission.root / SIGNING_STATE
    with_state = mavlink.model_copy(update={"signing_state": state})
    return configuration.model_copy(
        update={"watch": watch.model_copy(update={"mavlink": with_state})}
    )
