"""Level-2 of a rig without a virtual image: one raster per band, its mask, and the report.

What the bands are is made by `processing.pipelines.bands`; here they get their files.
"""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.mission.canonical_json import canonical_bytes
from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission
from daemon.mission.store.level2 import pictures, product_marks
from daemon.products.product_files import Contents, FramesRead, ProductFiles, report_json
from processing.geometry.conditions import Conditions
from processing.image.band_registration import RegisteredBand
from processing.pipelines.bands import BandPipeline
from processing.radiometry.calibration import CalibrationError
from processing.radiometry.radiance import RadianceCalibration, load_radiance
from processing.rig import Rig

RADIOMETRY = "radiometry"
_QUICKLOOK_BANDS = ("red", "green", "blue")


def radiance_folder(mission: Mission) -> Path | None:
    """A mission's own radiance calibrations; None where it has none."""
    own = mission.path / RADIOMETRY
    return own if own.is_dir() else None


def radiance_of(rig: Rig, folder: Path | None) -> dict[str, RadianceCalibration]:
    """The radiance calibrations of a folder by sensor name.

    Raises:
        CalibrationError: a file that cannot be used, or a folder that does not exist.
    """
    if folder is None:
        return {}
    if not folder.is_dir():
        raise CalibrationError(f"{folder}: no such folder; give one with <sensor>.json")
    return {
        sensor.name: load_radiance(folder / f"{sensor.name}.json")
        for sensor in rig.sensors
        if (folder / f"{sensor.name}.json").exists()
    }


def build_bands(
    radiance: Mapping[str, RadianceCalibration],
    pipeline: BandPipeline,
    exposure: Exposure,
    frames: Mapping[str, NDArray[np.uint16]],
    conditions: Conditions,
    frames_read: FramesRead,
) -> ProductFiles:
    """One raster a band (`daemon.products.processor`).

    Args:
        radiance: by sensor name, those the pipeline has: wavelengths go into the files.
    """
    product = pipeline.process(frames, conditions, frames_read=frames_read)
    report = report_json(product.report, exposure.number, product.timings_s, product.valid_area)
    report["reference"] = product.reference
    report["units"] = dict(product.units)
    report["bands"] = [_registration(band) for band in product.registrations]
    contents: Contents = {}
    mark = product_marks(report)
    for cone in pipeline.rig.cones:
        name = cone.bands[0]
        if name not in product.bands:
            continue
        about = {
            "band": name,
            "exposure": exposure.number,
            "reference": product.reference,
            "unit": product.units[name],
            "f_mm": product.image.f_mm,
            "pitch_um": product.image.pitch_um,
            **mark,
        }
        if (calibration := radiance.get(cone.sensors[0].name)) is not None:
            about["wavelength_nm"] = calibration.wavelength_nm
            about["bandwidth_nm"] = calibration.bandwidth_nm
        contents[f"{name}.tif"] = [_tiff(product.bands[name], about)]
        about = {"band": name, "exposure": exposure.number, "bits": ["valid", "saturated"], **mark}
        contents[f"{name}-mask.tif"] = [_tiff(product.masks[name], about)]
    if product.bands:
        contents |= pictures(_quicklook(product.bands), report)
    contents["quality.json"] = [canonical_bytes(report)]
    return report, contents


def _registration(band: RegisteredBand) -> dict[str, Any]:
    return {
        "band": band.band,
        "registered": band.registered,
        "points": band.points,
        "sought": band.attempted,
        "rms_px": band.rms_px,
        "rms_x_px": band.rms_x_px,
        "rms_y_px": band.rms_y_px,
        "shift_px": list(band.shift_px),
        "band_from_reference": band.band_from_reference.tolist(),
    }


def _tiff(raster: NDArray[Any], about: Mapping[str, Any]) -> bytes:
    """A plain TIFF of one plane, uncompressed."""
    from tifffile import imwrite

    buffer = BytesIO()
    description = canonical_bytes(about).decode("utf-8").strip()
    imwrite(
        buffer, raster, photometric="minisblack", description=description, metadata=None,
        software="Syntopic", byteorder="<",
    )  # fmt: skip
    return buffer.getvalue()


def _quicklook(bands: Mapping[str, NDArray[np.float32]]) -> NDArray[np.uint8]:
    """Red, green and blue where all are there, else the first band; each in its own stretch."""
    named = [bands[name] for name in _QUICKLOOK_BANDS if name in bands]
    chosen = named if len(named) == 3 else [next(iter(bands.values()))] * 3
    planes = []
    for band in chosen:
        low, high = np.nanpercentile(band[::4, ::4], (1.0, 98.0))
        unit = np.clip((np.nan_to_num(band) - low) / max(high - low, 1e-12), 0.0, 1.0)
        planes.append((255.0 * unit**0.6).astype(np.uint8))
    return np.stack(planes, axis=-1)
