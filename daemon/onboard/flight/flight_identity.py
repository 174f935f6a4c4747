"""The identity of a flight: what every record of it contains."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from daemon.configuration.model import Configuration
from daemon.mission.layout import Mission
from processing.rig import Rig


@dataclass(frozen=True)
class FlightIdentity:
    """Values that every record of a flight contains."""

    boot_id: str
    line_id: str
    calibration_id: str
    calibration_sha256: str
    configuration_sha256: str
    software: str
    simulated: bool


def identity(configuration: Configuration, rig: Rig, mission: Mission) -> FlightIdentity:
    """Values that every record of this flight contains."""
    return FlightIdentity(
        boot_id=Path("/proc/sys/kernel/random/boot_id").read_text().strip(),
        line_id=configuration.plan.line,
        calibration_id=rig.calibration_id,
        calibration_sha256=_sha256(mission.rig_path),
        configuration_sha256=_sha256(mission.service_path),
        software=f"syntopic {version('syntopic')}",
        simulated=configuration.mission.simulated,
    )


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
