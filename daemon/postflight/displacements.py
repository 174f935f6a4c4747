"""Since when a sensor has been displaced: the stitching records of a landed mission, together.

Read from `mosaic.json` of every exposure and written to `export/displacements.json`; the
mathematics is in `processing.mosaic.flight_validity`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from daemon.mission.canonical_json import (
    RECORD_MAX_BYTES,
    RecordError,
    canonical_bytes,
    parse_record,
)
from daemon.mission.foreign_files import ForeignFileError, read_regular_file
from daemon.mission.store.durable import replace_file
from processing.mosaic.flight_validity import (
    FlightDisplacement,
    FlightSettings,
    FlightValidity,
    evaluate_flight,
)
from processing.mosaic.stitch_record import StitchRecord, StitchRecordError, stitch_record_from_json
from processing.rig import load_rig

DISPLACEMENTS_FILE = "export/displacements.json"
"""File of a mission with its flight's verdict on displaced sensors."""


def write_displacements(mission: Path) -> Mapping[str, Any]:
    """Evaluate the flight and write `export/displacements.json`.

    Returns:
        The content of the file: `sentences`, one for each step; `steps`, see
        `processing.mosaic.flight_validity.Step`; `exposures` used and `left_out`, by cone;
        `unreadable`, sentences about records that could not be read.
    """
    content = flight_displacements(mission)
    path = mission / DISPLACEMENTS_FILE
    path.parent.mkdir(exist_ok=True)
    replace_file(path, canonical_bytes(content))
    return content


def flight_displacements(mission: Path) -> dict[str, Any]:
    """What `write_displacements` writes; nothing is written."""
    records, unreadable = _records(mission)
    return _content(evaluate_flight(load_rig(mission / "rig.toml"), records), unreadable)


def without_steps(exposures: Mapping[str, int]) -> str:
    """Message for a flight without steps, by evaluated exposures of each cone."""
    if not exposures:
        return (
            "Not evaluated: it takes three sensors in the master cone, or two in another PAN cone."
        )
    minimum = 2 * FlightSettings().min_exposures
    too_few = [cone for cone, count in exposures.items() if count < minimum]
    if len(too_few) == len(exposures):
        return (
            f"Not evaluated: whether a sensor moved shows in {minimum} exposures of a cone or more."
        )
    if too_few:
        cones = ", ".join(too_few)
        return f"No sensor is seen to move; not evaluated: cone {cones} (too few exposures)."
    return "No sensor is seen to move."


def _records(mission: Path) -> tuple[dict[int, StitchRecord], list[str]]:
    records, unreadable = {}, []
    for path in sorted(mission.glob("L2/[0-9]*/mosaic.json")):
        if not path.parent.name.isdigit():
            continue  # being written
        try:
            content = parse_record(read_regular_file(path, RECORD_MAX_BYTES), path.name)
            records[int(path.parent.name)] = stitch_record_from_json(content)
        except (ForeignFileError, RecordError, StitchRecordError) as error:
            unreadable.append(f"{path.parent.name}: {error}")
    return records, unreadable


def _step_content(step: FlightDisplacement) -> dict[str, Any]:
    content = asdict(step)
    content["misread"] = bias = content.pop("probe_bias")
    if bias is not None:
        bias["off_k"] = bias.pop("bias_k")
    length_and_alternatives = {"length_px": step.length_px, "alternatives": list(step.alternatives)}
    return content | length_and_alternatives


def _content(found: FlightValidity, unreadable: list[str]) -> dict[str, Any]:
    return {
        "sentences": [step.sentence for step in found.steps],
        "steps": [_step_content(step) for step in found.steps],
        "exposures": dict(found.exposures),
        "left_out": {cone: list(numbers) for cone, numbers in found.left_out.items()},
        "unreadable": unreadable,
    }
