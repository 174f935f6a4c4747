"""Observations of the camera's drift in flown missions, gathered from their records and products.

The mathematics is in `processing.calibration.thermal_learning`; a proposal is written as a rig file
of its own, in place of nothing.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from daemon import DaemonError
from daemon.configuration.schemas import SCHEMA_FILES, schema_file_name
from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission
from daemon.mission.store.durable import new_file, replace_file
from daemon.mission.store.store import read_sealed
from daemon.postflight.calibration.rig_writer import rig_toml
from processing.calibration.thermal_learning import ThermalState, add_exposure, empty_state
from processing.mosaic.estimated_dc import EstimatedDc
from processing.mosaic.stitch_record import (
    StitchRecord,
    StitchRecordError,
    stitch_record_from_json,
)
from processing.quality.probe_health import (
    ProbeSample,
    ProbeState,
    calibration_temperatures,
    evaluate_probes,
)
from processing.rig import Rig, load_rig, rig_from_mapping

MOSAIC_MAX_BYTES = 4_000_000


class ThermalCalibrationError(DaemonError, ValueError):
    """Missions that cannot be learned from together, or a file that already exists there."""


@dataclass(frozen=True)
class ThermalRecords:
    """Data of the missions. `skipped` are messages; `estimates` by mission and number
    of the exposure."""

    rig: Rig
    state: ThermalState
    exposures: int
    skipped: tuple[str, ...]
    estimates: Mapping[tuple[str, int], tuple[EstimatedDc, ...]]


def read_thermal_records(missions: Sequence[Path]) -> ThermalRecords:
    """Read the stitching records of missions flown with one calibration.

    A sensor whose probe was stuck, jumping, open or silent at an exposure does not count there.

    Raises:
        ThermalCalibrationError: different calibrations, a mission given twice, or no mission with
            products.
        processing.rig.RigError: a mission's rig file cannot be used.
    """
    rig: Rig | None = None
    state: ThermalState | None = None
    used = 0
    seen: set[Path] = set()
    skipped: list[str] = []
    estimates: dict[tuple[str, int], tuple[EstimatedDc, ...]] = {}
    for path in missions:
        mission = Mission.open(path)
        if mission.path.resolve() in seen:
            raise ThermalCalibrationError(
                f"{mission.id} is given twice; its records count once: leave one out"
            )
        seen.add(mission.path.resolve())
        own = load_rig(mission.rig_path)
        if rig is None or state is None:
            if not own.is_calibrated:
                raise ThermalCalibrationError(
                    f"{mission.id} was flown with the uncalibrated rig {own.name}; drift is "
                    "learned against a calibration: calibrate the camera, and process the mission "
                    "again"
                )
            rig, state = own, empty_state(own)
        elif own != rig:
            raise ThermalCalibrationError(
                f"{mission.id} was flown with {own.name} {own.calibration_id!r}, the missions "
                f"before it with {rig.name} {rig.calibration_id!r}; give missions of one rig file"
            )
        sealed = {n: read_sealed(mission.level0(n)) for n in mission.numbers()}
        exposures = {n: s.exposure for n, s in sealed.items() if s is not None}
        faults = faulty_probes(rig, exposures.values())
        for number in mission.numbers():
            record = stitching_of(mission, number)
            if isinstance(record, str):
                skipped.append(record)
                continue
            bad = faults.get(number, {})
            if bad:
                states = ", ".join(f"{probe} {s.value}" for probe, s in bad.items())
                skipped.append(f"{mission.id} {number}: implausible probes: {states}")
                record = _without(rig, record, set(bad))
            try:
                state = add_exposure(rig, state, record)
            except ValueError as error:
                skipped.append(f"{mission.id} {number}: {error}")
                continue
            estimates[(mission.id, number)] = record.estimated_dc
            used += 1
    if rig is None or state is None:
        raise ThermalCalibrationError("no mission given; give at least one mission folder")
    if not used:
        raise ThermalCalibrationError(
            "no exposure to learn from; process the missions with this version first: "
            "syntopic process MISSION"
        )
    return ThermalRecords(rig, state, used, tuple(skipped), estimates)


def faulty_probes(rig: Rig, exposures: Iterable[Exposure]) -> dict[int, dict[str, ProbeState]]:
    """By exposure, the probes that were not plausible then, from the flight's own history."""
    reference = calibration_temperatures(rig)
    result: dict[int, dict[str, ProbeState]] = {}
    histories: dict[tuple[str, str], list[ProbeSample]] = {}
    for exposure in sorted(exposures, key=lambda e: (e.boot_id, e.trigger_mono_ns)):
        for t in exposure.temperatures:
            if t.probe in reference:
                history = histories.setdefault((exposure.boot_id, t.probe), [])
                time_s = (exposure.trigger_mono_ns - t.age_ns) * 1e-9
                if not history or time_s > history[-1].time_s:
                    history.append(ProbeSample(time_s, t.value_c))
        own = {p: h for (boot, p), h in histories.items() if boot == exposure.boot_id}
        readings = evaluate_probes(own, exposure.trigger_mono_ns * 1e-9, reference)
        bad: dict[str, ProbeState] = {
            probe: r.state for probe, r in readings.items() if r.state is not ProbeState.GOOD
        }
        if bad:
            result[exposure.number] = bad
    return result


def write_rig(rig: Rig, path: Path, *, remark: str) -> None:
    """Write a proposed rig as a file of its own; an existing file stays.

    Raises:
        ThermalCalibrationError: the file exists, or does not read back as the same rig.
        OSError: the disk refused.
    """
    text = rig_toml(rig, remark=remark)
    back = rig_from_mapping(tomllib.loads(text.decode("utf-8")), path.name)
    if back != rig:
        raise ThermalCalibrationError(
            f"{path.name} would not read back as it was meant; not written"
        )
    try:
        with new_file(path, replaces=False) as part:
            part.write_bytes(text)
        replace_file(path.parent / schema_file_name("rig"), SCHEMA_FILES["rig"].read_bytes())
    except FileExistsError as error:
        raise ThermalCalibrationError(
            f"{path} exists; a calibration is never overwritten: give another name with --out"
        ) from error


def stitching_of(mission: Mission, number: int) -> StitchRecord | str:
    """The record of an exposure, or why there is none."""
    path = mission.level2(number) / "mosaic.json"
    try:
        if path.stat().st_size > MOSAIC_MAX_BYTES:
            return f"{mission.id} {number}: mosaic.json is too large to be one"
        return stitch_record_from_json(json.loads(path.read_bytes()))
    except FileNotFoundError:
        return f"{mission.id} {number}: no mosaic.json; process it with --method free"
    except (OSError, ValueError, StitchRecordError) as error:
        return f"{mission.id} {number}: {error}"


def _without(rig: Rig, record: StitchRecord, probes: set[str]) -> StitchRecord:
    measured = tuple(name for name in record.measured if rig.sensor(name).probe not in probes)
    return replace(record, measured=measured)
