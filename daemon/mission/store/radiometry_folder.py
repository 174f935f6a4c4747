"""Radiometric calibrations of a folder: `<sensor>.npz`, read on demand.

As floating-point maps they are four times what a pipeline keeps of them; nothing is kept here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from processing.radiometry.calibration import RadiometricCalibration, load_radiometry
from processing.rig import Rig


class RadiometryFolder(Mapping[str, RadiometricCalibration]):
    """By sensor name; a sensor without a file is not in it.

    Raises:
        CalibrationError: when a requested file cannot be read.
    """

    def __init__(self, folder: Path, rig: Rig) -> None:
        paths = {sensor.name: folder / f"{sensor.name}.npz" for sensor in rig.sensors}
        self._paths = {name: path for name, path in paths.items() if path.exists()}

    def __getitem__(self, name: str) -> RadiometricCalibration:
        return load_radiometry(self._paths[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._paths)

    def __len__(self) -> int:
        return len(self._paths)
