"""Maps of a radiometric calibration as files, and against those of the one before.

A folder for every aperture, `f<N>/<sensor>.npz`, as `processing.radiometry.calibration` reads
one of them.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from daemon.postflight.calibration.calibration_report import ReportTable
from daemon.postflight.calibration.laboratory.radiometric import HeadCalibration
from processing.radiometry.calibration import (
    GAIN_LIMITS,
    CalibrationError,
    RadiometricCalibration,
    load_radiometry,
)

_CHANGED_SIGMAS: Final = 5.0


def aperture_folder(f_number: float) -> str:
    """Name of the folder that holds the maps of an aperture."""
    return f"f{f_number:g}"


def files_of(
    heads: Sequence[HeadCalibration], scales: Mapping[str, float], apertures: Sequence[float]
) -> dict[str, bytes]:
    """`f<N>/<sensor>.npz` for every aperture and sensor."""
    files = {}
    for head in heads:
        for f_number in apertures:
            found = head.at_aperture(f_number)
            gain = np.clip(found.gain * np.float32(scales[head.sensor.name]), *GAIN_LIMITS)
            name = f"{aperture_folder(f_number)}/{head.sensor.name}.npz"
            files[name] = calibration_bytes(replace(found, gain=gain))
    return files


def calibration_bytes(calibration: RadiometricCalibration) -> bytes:
    """`<sensor>.npz` as `processing.radiometry.calibration` reads it."""
    stream = io.BytesIO()
    np.savez_compressed(
        stream,
        bias_dn=calibration.bias_dn.astype(np.float32),
        dark_dn_per_s=calibration.dark_dn_per_s.astype(np.float32),
        doubling_k=np.array(calibration.doubling_k),
        reference_c=np.array(calibration.reference_c),
        gain=calibration.gain.astype(np.float32),
        defect=calibration.defect.astype(np.uint8),
        response_per_k=np.array(calibration.response_per_k),
    )
    return stream.getvalue()


def maps_against(
    folder: Path, heads: Sequence[HeadCalibration], f_number: float
) -> ReportTable | None:
    """Pixel by pixel against the maps of the previous calibration, where they are there."""
    rows: list[tuple[str | float | int | None, ...]] = []
    for head in heads:
        path = folder / aperture_folder(f_number) / f"{head.sensor.name}.npz"
        if not path.exists():
            continue
        try:
            old = load_radiometry(path)
        except CalibrationError:
            continue
        new = head.at_aperture(f_number)
        if old.gain.shape != new.gain.shape:
            continue
        good = (old.defect == 0) & (new.defect == 0)
        change = np.log(new.gain[good] / old.gain[good])
        common = float(np.median(change))
        # Both maps are taken to hold the noise of this one.
        expected = head.gain_noise * math.sqrt(2.0)
        changed = np.abs(change - common) > _CHANGED_SIGMAS * expected
        bias = head.dark.bias_sigma_dn * math.sqrt(2.0)
        rows.append(
            (
                head.sensor.name,
                100.0 * common,
                100.0 * float(np.std(change)),
                100.0 * expected,
                int(changed.sum()),
                float(np.std((new.bias_dn - old.bias_dn)[good])),
                bias,
                int(((new.defect != 0) & (old.defect == 0)).sum()),
                int(((new.defect == 0) & (old.defect != 0)).sum()),
            )
        )
    if not rows:
        return None
    return ReportTable(
        "Maps against the previous calibration",
        (
            "sensor",
            "gain, median change %",
            "spread %",
            "of noise %",
            f"pixels beyond {_CHANGED_SIGMAS:g} sigmas",
            "bias, spread DN",
            "of noise DN",
            "defects new",
            "defects gone",
        ),
        rows,
        "Spread beyond its noise, or pixels beyond five sigmas (none of them by chance), is a "
        "change of the sensor.",
    )
