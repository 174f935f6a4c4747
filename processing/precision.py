"""The stated accuracy of a stitched image: tie points, and the calibration its datum rests on.

How the covariance comes about is in `processing.mosaic`; whether the calibration holds is judged in
`processing.validity`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from processing.drift import sensor_dc
from processing.mosaic import Mosaic, vip_precision_px
from processing.placement import vip_mm_from_raw
from processing.quality import Figure
from processing.rig import Rig

Array = NDArray[np.float64]

PROBE_SIGMA_K = 0.1
UNKNOWN_SIGMA_K = 2.0
"""A probe that was read, and one that others stand in for."""


def precision_figures(
    rig: Rig, mosaic: Mosaic, present: Collection[str], measured_c: Mapping[str, float]
) -> dict[str, Figure]:
    """How well centre and corners of the PAN sensors that are there are placed, in figures.

    Args:
        rig: the camera.
        mosaic: what the image was made with.
        present: sensors with a frame.
        measured_c: temperatures that were read, by probe name.
    """
    by_sensor: dict[str, float] = {}
    for cone in rig.pan_cones:
        for sensor in cone.sensors:
            if sensor.name in present:
                right, low = sensor.width_px - 1.0, sensor.height_px - 1.0
                points = [(right / 2, low / 2), (0, 0), (right, 0), (0, low), (right, low)]
                sigma = placed_sigma_px(
                    rig, mosaic, sensor.name, np.array(points, np.float64), measured_c
                )
                by_sensor[sensor.name] = float(np.sqrt(np.mean(sigma**2)))
    if not by_sensor:
        return {}
    worst = max(by_sensor, key=lambda name: by_sensor[name])
    return {
        "stitched_sigma_px": float(np.sqrt(np.mean(np.square(list(by_sensor.values()))))),
        "stitched_sigma_worst_px": by_sensor[worst],
        "stitched_sigma_worst_sensor": worst,
    }


def placed_sigma_px(
    rig: Rig, mosaic: Mosaic, sensor: str, colrow: Array, measured_c: Mapping[str, float]
) -> Array:
    """Standard deviation (n, 2), px, of where raw pixels (n, 2) lie in the virtual image.

    Three parts: the adjustment's covariance; calibration and drift coefficients of the master
    sensors the datum rests on; and the temperature of the master cone, which a common expansion
    hides in. What tie points do not determine counts with the a-priori accuracy it is held with.
    """
    tie_points = vip_precision_px(mosaic, sensor, colrow)
    held = {name.split(".")[0] for name in mosaic.undetermined}
    if held & {sensor, rig.cone_of(sensor).name}:
        tie_points = tie_points * max(1.0, 1.0 / max(mosaic.sigma0, 1e-6))
    master = rig.cone(rig.master_cone)
    datum = [s for s in master.sensors if s.name in mosaic.datum_sensors] or list(master.sensors)
    place_mm = np.array([[s.x_mm, s.y_mm] for s in datum])
    middle_mm = place_mm.mean(axis=0)
    arms_mm = place_mm - middle_mm
    half_mm = datum[0].height_px / 2.0 * datum[0].pitch_mm
    spread = max(float(np.sum(arms_mm**2)), half_mm**2)
    variance_um = float(
        np.mean(
            [
                s.position_sigma_um**2 + (s.drift.sigma_um_per_k * sensor_dc(s, measured_c)) ** 2
                for s in datum
            ]
        )
    )
    from_middle_mm = vip_mm_from_raw(mosaic.placements[sensor], colrow) - middle_mm
    distance = np.sum(from_middle_mm**2, axis=1, keepdims=True)
    calibration_um = np.sqrt(variance_um * (1.0 / len(datum) + distance / spread))
    moved = np.array([[s.drift.x_um_per_k, s.drift.y_um_per_k] for s in datum])
    # um per mm of distance and kelvin, less what the principal distance takes back.
    expansion = float(np.sum(arms_mm * moved)) / spread - master.lens.f_ppm_per_k * 1e-3
    read = all(s.probe in measured_c for s in datum)
    thermal_um = from_middle_mm * expansion * (PROBE_SIGMA_K if read else UNKNOWN_SIGMA_K)
    pitch_um = mosaic.model.pitch_mm * 1e3
    return np.asarray(
        np.sqrt(tie_points**2 + (calibration_um / pitch_um) ** 2 + (thermal_um / pitch_um) ** 2)
    )
