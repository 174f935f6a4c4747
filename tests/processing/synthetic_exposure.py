"""A synthetic exposure for the imaging tests: noise texture in the virtual image plane.

The ground is flat and all cones look from one place, so that one function of the virtual image
plane is the truth of every sensor. Where pixels look is taken from `processing.geometry.placement`,
which is checked elsewhere against an oracle of its own; what is tested here is everything after it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from processing.geometry.placement import nominal_placements, vip_mm_from_raw, vip_px_from_mm
from processing.rig import Rig

MARGIN_PX = 120
MEAN_DN = 1200.0
CONTRAST_DN = 300.0


@dataclass(frozen=True)
class Exposure:
    """Frames (h, w) uint16 by sensor, and what was true when they were taken."""

    frames: Mapping[str, NDArray[np.uint16]]
    temperatures_c: Mapping[str, float]
    tdi_shifts: Mapping[str, int]
    true_rig: Rig


def expose(
    rig: Rig,
    *,
    dc_k: float = 0.0,
    displaced: Mapping[str, tuple[float, float]] | None = None,
    tdi_shifts: int = 0,
    brightness: Mapping[str, float] | None = None,
    contrast: float = 1.0,
    seed: int = 5,
) -> Exposure:
    """Take one exposure.

    Args:
        rig: as calibrated.
        dc_k: all probes above calibration.
        displaced: shift (x right, y up) in px of a sensor against the rig.
        tdi_shifts: of the PAN cones; colour has its share by the ratio.
        brightness: factor on the light of a sensor; one where not named.
        contrast: one for a well textured scene; zero for open water.
        seed: of ground and noise.
    """
    true_rig = displace(rig, displaced or {})
    image = rig.virtual_image
    assert image is not None
    rng = np.random.default_rng(seed)
    shape = (image.height_px + 2 * MARGIN_PX, image.width_px + 2 * MARGIN_PX)
    ground = texture(shape, rng, cutoff=0.35)
    other = texture(shape, rng, cutoff=0.35)
    temperatures = dict.fromkeys(rig.probes, 20.0 + dc_k)
    shifts = {
        sensor.name: tdi_shifts if cone.role == "pan" else tdi_shifts // image.colour_ratio
        for cone in rig.cones
        for sensor in cone.sensors
    }
    placements = nominal_placements(true_rig, temperatures, shifts)
    frames = {}
    for cone in rig.cones:
        own = {"nir": 0.6, "blue": 0.2, "red": 0.15}.get(cone.bands[0], 0.0)
        light = ground * np.sqrt(1.0 - own**2) + other * own
        if cone.role == "colour":
            light = ndimage.gaussian_filter(light, 1.5, mode="wrap")
        spline = ndimage.spline_filter(light, order=3)
        for sensor in cone.sensors:
            column, row = np.meshgrid(
                np.arange(0, sensor.width_px + 16, 16.0), np.arange(0, sensor.height_px + 16, 16.0)
            )
            nodes = vip_mm_from_raw(
                placements[sensor.name], np.stack([column.ravel(), row.ravel()], axis=1)
            )
            px = vip_px_from_mm(image, nodes).reshape(*column.shape, 2)
            c, r = np.meshgrid(
                np.arange(sensor.width_px) / 16.0, np.arange(sensor.height_px) / 16.0
            )
            at = [ndimage.map_coordinates(px[..., k], [r, c], order=1) + MARGIN_PX for k in (1, 0)]
            signal = ndimage.map_coordinates(spline, at, order=3, prefilter=False)
            signal = MEAN_DN + CONTRAST_DN * contrast * signal
            signal *= (brightness or {}).get(sensor.name, 1.0)
            electrons = np.maximum(signal, 0.0) * sensor.electrons_per_dn
            noise = np.sqrt(electrons + sensor.read_noise_e**2) * rng.standard_normal(signal.shape)
            dn = sensor.black_dn + (electrons + noise) / sensor.electrons_per_dn
            frames[sensor.name] = np.clip(np.rint(dn), 0, sensor.full_scale_dn).astype(np.uint16)
    return Exposure(frames, temperatures, shifts, true_rig)


def displace(rig: Rig, shifts_px: Mapping[str, tuple[float, float]]) -> Rig:
    """The rig with sensors moved in their layers by so many pixels, x right, y up."""
    cones = []
    for cone in rig.cones:
        sensors = []
        for sensor in cone.sensors:
            dx, dy = shifts_px.get(sensor.name, (0.0, 0.0))
            sensors.append(
                replace(
                    sensor,
                    x_mm=sensor.x_mm + dx * sensor.pitch_mm,
                    y_mm=sensor.y_mm + dy * sensor.pitch_mm,
                )
            )
        cones.append(replace(cone, sensors=tuple(sensors)))
    return replace(rig, cones=tuple(cones))


def texture(
    shape: tuple[int, int], rng: np.random.Generator, *, cutoff: float
) -> NDArray[np.float64]:
    """Noise with the spectrum of landscapes, nothing above `cutoff` cycles per pixel.

    Mean zero, standard deviation one.
    """
    padded = (fft.next_fast_len(shape[0]), fft.next_fast_len(shape[1], real=True))
    spectrum = fft.rfft2(rng.standard_normal(padded), workers=2)
    f = np.hypot(fft.fftfreq(padded[0])[:, None], fft.rfftfreq(padded[1])[None, :])
    spectrum *= np.where(f < cutoff, 1.0 / np.maximum(f, 0.01) ** 0.8, 0.0)
    spectrum[0, 0] = 0.0
    field = fft.irfft2(spectrum, s=padded, workers=2)
    field /= field.std()
    result: NDArray[np.float64] = field[: shape[0], : shape[1]]
    return result
