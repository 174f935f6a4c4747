"""Radiometric calibration of heads from dark and flat series (`calibrate radiometric`).

Reads the frames set by set, composes `processing.calibration.radiometric`, and holds the result
against frames that took no part. Source: Heier et al. (2002), 5.2; EMVA Standard 1288.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, Strict

from daemon.mission.store.level0 import read_tiff
from daemon.postflight.calibration.laboratory.laboratory_series import (
    PathInFolder,
    SensorOfRig,
    SeriesError,
    SeriesFile,
)
from processing.calibration.radiometric.dark_signal import DarkSignal, fit_dark_signal
from processing.calibration.radiometric.defects import DefectMap, find_defects, smooth_field
from processing.calibration.radiometric.flat_residual import FlatResidual, flat_residual
from processing.calibration.radiometric.frame_series import (
    FrameAccumulator,
    FrameSet,
    Map,
    SeriesCondition,
    select_light,
)
from processing.calibration.radiometric.photon_transfer import (
    ExposureSeries,
    PhotonTransfer,
    exposure_series_of,
    photon_transfer,
)
from processing.calibration.radiometric.spatial_noise import SpatialNoise, spatial_noise
from processing.calibration.radiometric.vignetting import ApertureModel, fit_aperture
from processing.radiometry.calibration import GAIN_LIMITS, RadiometricCalibration
from processing.rig import Sensor
from processing.rig.value_types import Number, Positive, Text

Progress = Callable[[str], None]

_SET_SPREAD_K: Final = 3.0
_SAME_TEMPERATURE_K: Final = 2.0
_SIGNIFICANT_SIGMAS: Final = 4.0


@dataclass(frozen=True)
class CalibrationShot:
    """One image of the series."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    path: Annotated[PathInFolder, Field(alias="file")]
    sensor: SensorOfRig
    set_name: Annotated[Text, Field(alias="set")]
    light: Literal["dark", "flat"]
    exposure_time_us: Positive
    f_number: Positive
    temperature_c: Number
    use: Literal["fit", "check"] = "fit"
    monitor: Number = 1.0
    tdi_shifts: Annotated[int, Strict()] = 0

    @property
    def exposure_time_s(self) -> float:
        return self.exposure_time_us * 1e-6


class RadiometricSeries(SeriesFile):
    """The keys of a series for `calibrate radiometric`."""

    KIND = "radiometric"

    images: tuple[CalibrationShot, ...]
    temperature_sigma_c: Number = 0.1
    monitor_sigma: Number = 1e-3


@dataclass(frozen=True)
class HeadCalibration:
    """Result of one sensor.

    `signal_per_light` is the mean signal of the main flat set per monitored light and second.
    `gain`, at `gain_c`, has a relative standard deviation of `gain_noise` a pixel; `response_per_k`
    and its sigma, relative, None where flat sets have one temperature. `checks` by what they were.
    """

    sensor: Sensor
    dark: DarkSignal
    transfer: PhotonTransfer
    ladder: ExposureSeries
    prnu: SpatialNoise
    dsnu_dn: SpatialNoise
    defects: DefectMap
    signal_per_light: Map
    gain: Map
    gain_c: float
    gain_noise: float
    aperture: ApertureModel
    r2_mm2: NDArray[np.float64]
    response_per_k: tuple[float, float] | None
    dark_levels: tuple[tuple[float, float, float], ...]
    checks: tuple[tuple[str, FlatResidual], ...]
    frames: int

    def at_aperture(self, f_number: float) -> RadiometricCalibration:
        """The calibration at an aperture, by the functional model."""
        per_k = self.response_per_k[0] if self.response_per_k and self.follows_temperature else 0.0
        at_reference = 1.0 + per_k * (self.dark.reference_c - self.gain_c)
        gain = self.gain / self.aperture.ratio(self.r2_mm2, f_number) / at_reference
        return RadiometricCalibration(
            bias_dn=np.clip(self.dark.bias_dn, 0.0, None),
            dark_dn_per_s=self.dark.dark_dn_per_s,
            doubling_k=self.dark.doubling_k,
            reference_c=self.dark.reference_c,
            gain=np.clip(gain, *GAIN_LIMITS).astype(np.float32),
            defect=self.defects.mask,
            response_per_k=per_k / at_reference,
        )

    @property
    def follows_temperature(self) -> bool:
        """The response changes with temperature by more than its measurement could."""
        if self.response_per_k is None:
            return False
        value, sigma = self.response_per_k
        return abs(value) > _SIGNIFICANT_SIGMAS * sigma


def refuse_mixed_sets(shots: Sequence[CalibrationShot]) -> None:
    """Refuse sets whose images were not taken under one condition.

    Raises:
        SeriesError: with every mistake.
    """
    problems = [p for members in sets_of(shots).values() for p in _differing_conditions(members)]
    if problems:
        raise SeriesError(problems)


def sets_of(shots: Sequence[CalibrationShot]) -> dict[str, list[CalibrationShot]]:
    """Images by the name of their set, in the order of the series."""
    sets: dict[str, list[CalibrationShot]] = {}
    for shot in shots:
        sets.setdefault(shot.set_name, []).append(shot)
    return sets


def _differing_conditions(members: Sequence[CalibrationShot]) -> list[str]:
    first = members[0]
    keys = ("sensor", "light", "use", "exposure_time_us", "f_number", "tdi_shifts")
    found = [
        f"series.json: set {first.set_name!r} holds images of unlike {key}; a set is one condition"
        for key in keys
        if len({getattr(m, key) for m in members}) > 1
    ]
    temperatures = [m.temperature_c for m in members]
    if max(temperatures) - min(temperatures) > _SET_SPREAD_K:
        found.append(
            f"series.json: set {first.set_name!r} runs from {min(temperatures):.1f} to "
            f"{max(temperatures):.1f} degC; frames of a set lie within {_SET_SPREAD_K:g} K"
        )
    if first.light == "flat" and not all(m.monitor > 0.0 for m in members):
        found.append(
            f"series.json: set {first.set_name!r} has a monitor that is not positive; a flat "
            "needs what the light's meter read"
        )
    return found


def calibrate_sensor(
    sensor: Sensor,
    shots: Sequence[CalibrationShot],
    *,
    temperature_sigma_c: float,
    monitor_sigma: float,
    progress: Progress,
) -> HeadCalibration:
    """Calibrate one sensor from its images.

    Raises:
        SeriesError: sets that are needed are missing; the message states which.
        daemon.mission.store.level0.RasterError: an image cannot be read.
    """
    fit: list[FrameSet] = []
    for name, members in sets_of(shots).items():
        if members[0].use == "fit":
            fit.append(_averaged(sensor, name, members))
        progress(f"{sensor.name}: {name}")
    dark_sets, flat_sets = select_light(fit, "dark"), select_light(fit, "flat")
    plain = [s for s in flat_sets if s.condition.tdi_shifts == 0]
    if not plain:
        raise SeriesError([f"{sensor.name}: no flat set without TDI; take some"])
    main = max(plain, key=lambda s: s.count)
    try:
        dark = fit_dark_signal(
            dark_sets,
            # A temperature that stays: so that the next calibration's dark signal compares.
            reference_c=sensor.calibration_c,
            temperature_sigma_c=temperature_sigma_c,
        )
        signal = _signal(main, dark)
        base = [s for s in plain if _same_conditions(s, main)]
        steps, transfer = _transferred(base, dark_sets, dark, ~main.clipped)
        predicted = transfer.variance_dn2(np.maximum(signal, 0.0), steps.dark_dn2)
        defects = find_defects(signal, dark.dark_dn_per_s, main.variance / predicted)
        good = (defects.mask == 0) & ~main.clipped
        steps, transfer = _transferred(base, dark_sets, dark, good)
    except ValueError as error:
        raise SeriesError([f"{sensor.name}: {error}"]) from error
    light = main.condition.monitor * main.condition.exposure_time_s
    per_light = np.asarray(signal / np.float32(light), np.float32)
    smooth = smooth_field(signal)
    level = float(np.mean(main.variance[good] / smooth[good] ** 2, dtype=np.float64)) / main.count
    r2 = _r2_mm2(sensor)
    return HeadCalibration(
        sensor=sensor,
        dark=dark,
        transfer=transfer,
        ladder=steps,
        prnu=spatial_noise(signal / smooth, good, temporal_variance=level),
        dsnu_dn=_dark_pattern(dark_sets, good),
        defects=defects,
        signal_per_light=per_light,
        gain=_gain(per_light, good, float(smooth.max()) / light),
        gain_c=main.condition.temperature_c,
        gain_noise=math.sqrt(level),
        aperture=_aperture(main, plain, dark, r2_mm2=r2, good=good),
        r2_mm2=r2,
        response_per_k=_response_per_k(main, plain, dark, good, monitor_sigma=monitor_sigma),
        dark_levels=tuple(
            (
                s.condition.exposure_time_s,
                s.condition.temperature_c,
                float(np.mean((s.mean - dark.bias_dn)[good], dtype=np.float64)),
            )
            for s in dark_sets
        ),
        checks=(),
        frames=len(shots),
    )


def checks_of(
    head: HeadCalibration, shots: Sequence[CalibrationShot]
) -> tuple[tuple[str, FlatResidual], ...]:
    """Correct the frames set apart as the pipeline will, and hold what is left of even light
    against photon transfer. One entry a set, of its frames' mean."""
    found = []
    for members in sets_of([s for s in shots if s.use == "check"]).values():
        first = members[0]
        calibration = head.at_aperture(first.f_number)
        single = [
            flat_residual(
                head.sensor,
                calibration,
                _frame(head.sensor, m),
                exposure_time_s=m.exposure_time_s,
                temperature_c=m.temperature_c,
                tdi_shifts=m.tdi_shifts,
                gain_dn_per_e=head.transfer.gain_dn_per_e,
                dark_dn2=head.ladder.dark_dn2,
            )
            for m in members
        ]
        title = f"f/{first.f_number:g}, {first.exposure_time_s * 1e3:.3g} ms"
        title += f", {first.tdi_shifts} TDI shifts" if first.tdi_shifts else ""
        mean = FlatResidual(
            *(float(np.mean([getattr(r, key) for r in single])) for key in FlatResidual.FIGURES)
        )
        found.append((title, mean))
    return tuple(found)


def common_level(heads: Sequence[HeadCalibration], pan: set[str]) -> dict[str, float]:
    """Factor of each head's gain with which PAN heads agree before one light.

    The most sensitive PAN head keeps the gain of one where it sees most; colour heads, whose bands
    the monitor does not distinguish, each have their own.
    """
    peak = {h.sensor.name: _peak(h) for h in heads}
    best = max((v for name, v in peak.items() if name in pan), default=1.0)
    return {name: best / v if name in pan else 1.0 for name, v in peak.items()}


def _peak(head: HeadCalibration) -> float:
    return float(smooth_field(head.signal_per_light).max())


def _averaged(sensor: Sensor, name: str, members: Sequence[CalibrationShot]) -> FrameSet:
    first = members[0]
    condition = SeriesCondition(
        name=name,
        light=first.light,
        exposure_time_s=first.exposure_time_s,
        f_number=first.f_number,
        tdi_shifts=first.tdi_shifts,
        temperature_c=float(np.mean([m.temperature_c for m in members])),
        monitor=float(np.mean([m.monitor for m in members])) if first.light == "flat" else 0.0,
    )
    averaging = FrameAccumulator(condition, sensor.black_dn, sensor.full_scale_dn)
    for member in members:
        averaging.add(_frame(sensor, member), temperature_c=member.temperature_c)
    try:
        return averaging.result()
    except ValueError as error:
        raise SeriesError([f"{sensor.name}: {error}"]) from error


def _frame(sensor: Sensor, shot: CalibrationShot) -> NDArray[np.uint16]:
    return read_tiff(shot.path, width_px=sensor.width_px, height_px=sensor.height_px)


def _signal(frames: FrameSet, dark: DarkSignal) -> Map:
    c = frames.condition
    return np.asarray(frames.mean - dark.offset(c.exposure_time_s, c.temperature_c), np.float32)


def _same_conditions(frames: FrameSet, main: FrameSet) -> bool:
    a, b = frames.condition, main.condition
    near = abs(a.temperature_c - b.temperature_c) < _SAME_TEMPERATURE_K
    return near and a.f_number == b.f_number


def _transferred(
    base: Sequence[FrameSet], dark_sets: Sequence[FrameSet], dark: DarkSignal, good: Any
) -> tuple[ExposureSeries, PhotonTransfer]:
    steps = []
    for s in base:
        noise = float(np.mean(s.variance[good], dtype=np.float64))
        steps.append(
            (
                s.condition.monitor * s.condition.exposure_time_s,
                float(np.mean(_signal(s, dark)[good], dtype=np.float64)),
                noise,
                noise * math.sqrt(2.0 / (s.count - 1) / int(good.sum())),
                float(np.mean(s.clipped[good])),
            )
        )
    shortest = min(s.condition.exposure_time_s for s in dark_sets)
    short = [s for s in dark_sets if s.condition.exposure_time_s == shortest]
    noise = float(np.mean([np.mean(s.variance[good], dtype=np.float64) for s in short]))
    freedom = sum(s.count - 1 for s in short) * int(good.sum())
    ladder = exposure_series_of(steps, (noise, noise * math.sqrt(2.0 / freedom)))
    return ladder, photon_transfer(ladder)


def _dark_pattern(dark_sets: Sequence[FrameSet], good: Any) -> SpatialNoise:
    """Of the shortest exposure: the pattern an image taken in flight has."""
    shortest = min(dark_sets, key=lambda s: s.condition.exposure_time_s)
    noise = float(np.mean(shortest.variance[good], dtype=np.float64)) / shortest.count
    return spatial_noise(shortest.mean, good, temporal_variance=noise)


def _gain(per_light: Map, good: Any, peak: float) -> Map:
    """Peak over each pixel's own response; a defect has that of its surroundings."""
    smooth = smooth_field(per_light)
    response = np.where(good, per_light, smooth)
    return np.asarray(np.clip(peak / np.maximum(response, 1e-6 * peak), *GAIN_LIMITS), np.float32)


def _r2_mm2(sensor: Sensor) -> NDArray[np.float64]:
    x = sensor.x_mm + (np.arange(sensor.width_px) - (sensor.width_px - 1) / 2) * sensor.pitch_mm
    y = sensor.y_mm + ((sensor.height_px - 1) / 2 - np.arange(sensor.height_px)) * sensor.pitch_mm
    return np.asarray(x[None, :] ** 2 + y[:, None] ** 2)


def _aperture(
    main: FrameSet,
    plain: Sequence[FrameSet],
    dark: DarkSignal,
    *,
    r2_mm2: NDArray[np.float64],
    good: Any,
) -> ApertureModel:
    def field(frames: FrameSet) -> Map:
        c = frames.condition
        return np.asarray(_signal(frames, dark) / (c.monitor * c.exposure_time_s), np.float32)

    others: Mapping[float, FrameSet] = {
        s.condition.f_number: s for s in plain if s.condition.f_number != main.condition.f_number
    }
    return fit_aperture(
        (main.condition.f_number, field(main)),
        [(f, field(s)) for f, s in others.items()],
        r2_mm2=r2_mm2,
        good=good,
    )


def _response_per_k(
    main: FrameSet,
    plain: Sequence[FrameSet],
    dark: DarkSignal,
    good: Any,
    *,
    monitor_sigma: float,
) -> tuple[float, float] | None:
    """Relative change of the response with temperature, and its sigma, from unclipped flats of the
    main aperture and exposure time."""
    c = main.condition
    same = [
        s
        for s in plain
        if s.condition.f_number == c.f_number and s.condition.exposure_time_s == c.exposure_time_s
    ]
    temperature = np.array([s.condition.temperature_c for s in same])
    if len(same) < 2 or float(np.ptp(temperature)) < 2.0 * _SAME_TEMPERATURE_K:
        return None
    level = [
        float(np.mean(_signal(s, dark)[good], dtype=np.float64)) / s.condition.monitor for s in same
    ]
    weight = np.array([s.count for s in same], float)
    centred = temperature - float(np.average(temperature, weights=weight))
    spread = float(np.sum(weight * centred**2))
    values = np.array(level) / level[same.index(main)]
    return float(np.sum(weight * centred * values)) / spread, monitor_sigma / math.sqrt(spread)
