"""Wrong inputs: what is planted for each kind, of a given size, in a head and region by chance."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import cv2
import numpy as np

from benchmarks.silent_errors.exposure_faults import EXPOSURE_FAULTS
from benchmarks.silent_errors.exposures import EmulatedExposure
from benchmarks.silent_errors.frame_faults import FRAME_FAULTS
from benchmarks.silent_errors.planting import (
    Array,
    Fault,
    FaultInjector,
    Random,
    any_of,
    any_part,
    any_sign,
    colour_sensors,
    of_cone,
    of_frame,
    of_sensor,
    pan_sensors,
    scaled,
    sensors_of_several,
)
from benchmarks.silent_errors.slip_faults import slip
from processing.rig import Cone, Sensor


def _principal_distance(emulated: EmulatedExposure, ppm: float, random: Random) -> Fault:
    cone, off = any_of(random, emulated.rig.pan_cones), any_sign(random) * ppm
    return of_cone(emulated, cone, _with_f(off), f"principal distance {off:+.0f} ppm")


def _with_f(ppm: float) -> Callable[[Cone], Cone]:
    return lambda c: replace(c, lens=replace(c.lens, f_mm=c.lens.f_mm * (1.0 + ppm * 1e-6)))


def _rotated(rotation_rad: Sequence[float]) -> Callable[[Cone], Cone]:
    def change(cone: Cone) -> Cone:
        x, y, z = (a + b for a, b in zip(cone.rotation_rad, rotation_rad, strict=True))
        return replace(cone, rotation_rad=(x, y, z))

    return change


def _cone_rotated(emulated: EmulatedExposure, urad: float, random: Random) -> Fault:
    rig = emulated.rig
    cone = any_of(random, [c for c in rig.cones if c.name != rig.master_cone])
    axis, off = int(random.integers(0, 3)), any_sign(random) * urad
    rotation = np.eye(3)[axis] * off * 1e-6
    return of_cone(
        emulated, cone, _rotated(rotation), f"turned {off:+.0f} urad about {'xyz'[axis]}"
    )


def _moved(x_px: float, y_px: float) -> Callable[[Sensor], Sensor]:
    return lambda s: replace(s, x_mm=s.x_mm + x_px * s.pitch_mm, y_mm=s.y_mm + y_px * s.pitch_mm)


def _sensor_displaced(emulated: EmulatedExposure, px: float, random: Random) -> Fault:
    name, angle = (
        any_of(random, sensors_of_several(emulated.rig)),
        float(random.uniform(0.0, 2.0 * np.pi)),
    )
    x, y = px * np.cos(angle), px * np.sin(angle)
    return of_sensor(emulated, name, _moved(x, y), f"displaced {x:+.2f}, {y:+.2f} px")


def _sensor_rotated(emulated: EmulatedExposure, urad: float, random: Random) -> Fault:
    name, off = any_of(random, sensors_of_several(emulated.rig)), any_sign(random) * urad
    return of_sensor(
        emulated,
        name,
        lambda s: replace(s, rotation_rad=s.rotation_rad + off * 1e-6),
        f"rotated {off:+.0f} urad",
    )


def _blurred(sigma: float) -> Callable[[Array], Array]:
    return lambda frame: np.asarray(cv2.GaussianBlur(frame, (0, 0), sigma))


def _blur(emulated: EmulatedExposure, sigma: float, random: Random) -> Fault:
    name = any_of(random, pan_sensors(emulated.rig))
    return of_frame(emulated, name, _blurred(sigma), f"blurred by {sigma:.2f} px")


def _blur_region(emulated: EmulatedExposure, sigma: float, random: Random) -> Fault:
    name = any_of(random, pan_sensors(emulated.rig))
    part, where = any_part(emulated.rig.sensor(name), 2, random)

    def change(frame: Array) -> Array:
        frame[part] = cv2.GaussianBlur(frame, (0, 0), sigma)[part]
        return frame

    return of_frame(emulated, name, change, f"blurred by {sigma:.2f} px in {where}")


def _blur_band(emulated: EmulatedExposure, sigma: float, random: Random) -> Fault:
    name = any_of(random, colour_sensors(emulated.rig))
    bayer = emulated.rig.sensor(name).colour_filter_array != "none"

    def change(frame: Array) -> Array:
        if not bayer:
            return _blurred(sigma)(frame)
        for row in (0, 1):
            for column in (0, 1):
                plane = np.ascontiguousarray(frame[row::2, column::2])
                frame[row::2, column::2] = cv2.GaussianBlur(plane, (0, 0), sigma / 2.0)
        return frame

    return of_frame(emulated, name, change, f"blurred by {sigma:.2f} px")


def _smear(emulated: EmulatedExposure, px: float, random: Random) -> Fault:
    name, along = any_of(random, pan_sensors(emulated.rig)), bool(random.integers(0, 2))
    # Of an even length the content would shift by half a pixel, too.
    length = 1 + 2 * max(1, round((px - 1.0) / 2.0))
    size = (1, length) if along else (length, 1)
    way = "along" if along else "across"
    return of_frame(
        emulated, name, lambda f: np.asarray(cv2.blur(f, size)), f"smeared by {length} px {way}"
    )


def _gain_step(emulated: EmulatedExposure, percent: float, random: Random) -> Fault:
    return _stepped(emulated, any_of(random, pan_sensors(emulated.rig)), percent, random)


def _gain_step_colour(emulated: EmulatedExposure, percent: float, random: Random) -> Fault:
    return _stepped(emulated, any_of(random, colour_sensors(emulated.rig)), percent, random)


def _stepped(emulated: EmulatedExposure, name: str, percent: float, random: Random) -> Fault:
    axis = int(random.integers(0, 2))
    sensor = emulated.rig.sensor(name)
    size = (sensor.height_px, sensor.width_px)[axis]
    line, off = int(random.integers(size // 8, size - size // 8)), any_sign(random) * percent
    factors = np.where(np.arange(size) < line, 1.0, 1.0 + off / 100.0)
    factor = factors[:, None] if axis == 0 else factors[None, :]
    description = f"signal {off:+.1f} % from {('row', 'column')[axis]} {line} on"
    return of_frame(emulated, name, lambda f: scaled(sensor, f, factor), description)


def _banding(emulated: EmulatedExposure, percent: float, random: Random) -> Fault:
    return _banded(emulated, any_of(random, pan_sensors(emulated.rig)), percent, random)


def _banding_colour(emulated: EmulatedExposure, percent: float, random: Random) -> Fault:
    return _banded(emulated, any_of(random, colour_sensors(emulated.rig)), percent, random)


def _banded(emulated: EmulatedExposure, name: str, percent: float, random: Random) -> Fault:
    axis = int(random.integers(0, 2))
    sensor = emulated.rig.sensor(name)
    size, period = (sensor.height_px, sensor.width_px)[axis], int(random.integers(8, 41))
    signal = float(np.median(emulated.frames[name])) - sensor.black_dn
    dn = np.rint(percent / 100.0 * signal) * ((np.arange(size) // period) % 2)
    lines = dn[:, None] if axis == 0 else dn[None, :]
    description = f"{('rows', 'columns')[axis]} in turn of {period} {dn.max():.0f} DN brighter"
    return of_frame(emulated, name, lambda f: _added(sensor, f, lines), description)


def _added(sensor: Sensor, frame: Array, dn: Any) -> Array:
    return np.asarray(np.clip(frame + dn, 0, sensor.full_scale_dn), np.uint16)


def _block_offset(emulated: EmulatedExposure, dn: float, random: Random) -> Fault:
    return _block(emulated, any_of(random, pan_sensors(emulated.rig)), dn, random)


def _block_offset_colour(emulated: EmulatedExposure, dn: float, random: Random) -> Fault:
    return _block(emulated, any_of(random, colour_sensors(emulated.rig)), dn, random)


def _block(emulated: EmulatedExposure, name: str, dn: float, random: Random) -> Fault:
    sensor = emulated.rig.sensor(name)
    part, where = any_part(sensor, 4, random)
    added = np.zeros((sensor.height_px, sensor.width_px))
    added[part] = round(dn)
    description = f"{dn:.0f} DN brighter in {where}"
    return of_frame(emulated, name, lambda f: _added(sensor, f, added), description)


def _clipping(emulated: EmulatedExposure, percent: float, random: Random) -> Fault:
    name = any_of(random, pan_sensors(emulated.rig))
    level = float(np.percentile(emulated.frames[name], 100.0 - percent))
    description = f"clipped at {level:.0f} DN, {percent:.1f} % of its pixels"
    return of_frame(emulated, name, lambda f: np.minimum(f, np.uint16(level)), description)


def _exposure_of(emulated: EmulatedExposure, name: str, percent: float, random: Random) -> Fault:
    factor = 1.0 + percent / 100.0
    factor = factor if random.integers(0, 2) else 1.0 / factor
    sensor = emulated.rig.sensor(name)
    return of_frame(
        emulated, name, lambda f: scaled(sensor, f, factor), f"exposed {factor:.2f} times as long"
    )


def _exposure_pan(emulated: EmulatedExposure, percent: float, random: Random) -> Fault:
    return _exposure_of(emulated, any_of(random, pan_sensors(emulated.rig)), percent, random)


def _exposure_colour(emulated: EmulatedExposure, percent: float, random: Random) -> Fault:
    return _exposure_of(emulated, any_of(random, colour_sensors(emulated.rig)), percent, random)


def _exposure_unknown(emulated: EmulatedExposure, _: float, random: Random) -> Fault:
    name = any_of(random, colour_sensors(emulated.rig))
    times = {n: t for n, t in emulated.conditions.exposure_time_s.items() if n != name}
    conditions = replace(emulated.conditions, exposure_time_s=times)
    sensor = emulated.rig.sensor(name)
    changed = emulated.with_frame(name, lambda f: scaled(sensor, f, 0.5))
    true_causes = frozenset({name, emulated.rig.cone_of(name).name})
    description = f"{name}: exposed half as long, not stated"
    return Fault(replace(changed, conditions=conditions), true_causes, description)


def _exposure_stated(emulated: EmulatedExposure, percent: float, random: Random) -> Fault:
    name = any_of(random, sensors_of_several(emulated.rig))
    factor = 1.0 + percent / 100.0
    factor = factor if random.integers(0, 2) else 1.0 / factor
    times = dict(emulated.conditions.exposure_time_s)
    times[name] *= factor
    conditions = replace(emulated.conditions, exposure_time_s=times)
    true_causes = frozenset({name, emulated.rig.cone_of(name).name})
    description = f"{name}: stated to be exposed {factor:.2f} times as long"
    return Fault(replace(emulated, conditions=conditions), true_causes, description)


def _with_probes(emulated: EmulatedExposure, off_k: Mapping[str, float]) -> EmulatedExposure:
    read = {
        p: None if c is None else c + off_k.get(p, 0.0)
        for p, c in emulated.conditions.temperatures_c.items()
    }
    return replace(emulated, conditions=replace(emulated.conditions, temperatures_c=read))


def _probes_all(emulated: EmulatedExposure, kelvin: float, random: Random) -> Fault:
    off = any_sign(random) * kelvin
    changed = _with_probes(emulated, dict.fromkeys(emulated.rig.probes, off))
    names = frozenset(emulated.rig.probes) | {c.name for c in emulated.rig.cones}
    return Fault(changed, names, f"all probes {off:+.1f} K")


def _probe_one(emulated: EmulatedExposure, kelvin: float, random: Random) -> Fault:
    cone, off = any_of(random, emulated.rig.pan_cones), any_sign(random) * kelvin
    read = {cone.probe, *(s.probe for s in cone.sensors)}
    names = frozenset(read | {cone.name})
    return Fault(
        _with_probes(emulated, dict.fromkeys(read, off)), names, f"probe {read} {off:+.1f}"
    )


def _stale(emulated: EmulatedExposure, seconds: float, random: Random) -> Fault:
    fault = _probes_all(emulated, 0.02 * seconds, random)
    ages = dict.fromkeys(emulated.rig.probes, seconds)
    conditions = replace(fault.emulated.conditions, temperature_age_s=ages)
    return replace(fault, emulated=replace(fault.emulated, conditions=conditions))


def _tdi(emulated: EmulatedExposure, shifts: float, random: Random) -> Fault:
    cone = any_of(random, emulated.rig.pan_cones)
    off = int(any_sign(random)) * max(1, round(shifts))
    counts = dict(emulated.conditions.tdi_shifts)
    for sensor in cone.sensors:
        counts[sensor.name] = max(0, counts[sensor.name] + off)
    conditions = replace(emulated.conditions, tdi_shifts=counts)
    names = frozenset({cone.name, *(s.name for s in cone.sensors)})
    return Fault(
        replace(emulated, conditions=conditions), names, f"cone {cone.name}: TDI count {off:+d}"
    )


def _half_frame(emulated: EmulatedExposure, percent: float, random: Random) -> Fault:
    name = any_of(random, [s.name for s in emulated.rig.sensors])
    lines = round(emulated.rig.sensor(name).height_px * min(percent, 90.0) / 100.0)

    def change(frame: Array) -> Array:
        frame[-lines:] = 0
        return frame

    fault = of_frame(emulated, name, change, f"last {lines} rows not read out")
    return replace(fault, emulated=replace(fault.emulated, elsewhere=frozenset({name})))


def _wrong_unit(emulated: EmulatedExposure, times: float, random: Random) -> Fault:
    rig, changed = emulated.rig, emulated
    for cone in rig.cones:
        rotation = random.normal(0.0, 300e-6 * times, 3) * float(cone.name != rig.master_cone)
        changed = changed.with_cone(cone.name, _rotated([float(a) for a in rotation]))
        changed = changed.with_cone(cone.name, _with_f(float(random.normal(0.0, 500.0 * times))))
        for sensor in cone.sensors:
            x, y = random.normal(0.0, 2.0 * times, 2)
            changed = changed.with_sensor(sensor.name, _moved(float(x), float(y)))
    names = frozenset({s.name for s in rig.sensors} | {c.name for c in rig.cones} | {*rig.probes})
    return Fault(changed, names, f"rig file of another unit, {times:.1f} times its differences")


def _exchanged(emulated: EmulatedExposure, a: str, b: str) -> Fault:
    frames = {**emulated.frames, a: emulated.frames[b], b: emulated.frames[a]}
    names = frozenset({a, b, emulated.rig.cone_of(a).name, emulated.rig.cone_of(b).name})
    changed = replace(emulated, frames=frames, elsewhere=frozenset({a, b}))
    return Fault(changed, names, f"frames of {a} and {b} swapped")


def _bands_swapped(emulated: EmulatedExposure, _: float, random: Random) -> Fault:
    a, b = random.choice(colour_sensors(emulated.rig), 2, replace=False)
    fault = _exchanged(emulated, str(a), str(b))
    # The same ground, in another colour.
    return replace(fault, emulated=replace(fault.emulated, elsewhere=frozenset()))


def _frames_swapped(emulated: EmulatedExposure, _: float, random: Random) -> Fault:
    a, b = random.choice(pan_sensors(emulated.rig), 2, replace=False)
    return _exchanged(emulated, str(a), str(b))


def _other_ground(
    change: Callable[[EmulatedExposure, str], Array], description: str
) -> FaultInjector:
    def inject(emulated: EmulatedExposure, _: float, random: Random) -> Fault:
        name = any_of(random, [s.name for s in emulated.rig.sensors])
        fault = of_frame(emulated, name, lambda _: change(emulated, name), description)
        return replace(fault, emulated=replace(fault.emulated, elsewhere=frozenset({name})))

    return inject


def _frame_part(emulated: EmulatedExposure, _: float, random: Random) -> Fault:
    rig = emulated.rig
    compared = [c for c in rig.cones if c.role == "pan" or "nir" not in c.bands]
    name = any_of(random, [s.name for c in compared for s in c.sensors])
    part, where = any_part(rig.sensor(name), 4, random)
    other = emulated.other()[name]

    def change(frame: Array) -> Array:
        frame[part] = other[part]
        return frame

    fault = of_frame(emulated, name, change, f"of the next exposure in {where}")
    return replace(fault, emulated=replace(fault.emulated, elsewhere=frozenset({name})))


def _words(emulated: EmulatedExposure, _: float, random: Random) -> Fault:
    name = any_of(random, [s.name for s in emulated.rig.sensors])
    shift = 16 - emulated.rig.sensor(name).bits
    if random.integers(0, 2):
        return of_frame(emulated, name, lambda f: f.byteswap(), "words byte-swapped")
    return of_frame(emulated, name, lambda f: f << shift, "words left-justified")


def _frame_lost(emulated: EmulatedExposure, _: float, random: Random) -> Fault:
    name = any_of(random, [s.name for s in emulated.rig.sensors])
    frames = {n: f for n, f in emulated.frames.items() if n != name}
    changed = replace(emulated, frames=frames, elsewhere=frozenset({name}))
    return Fault(changed, frozenset({name, emulated.rig.cone_of(name).name}), f"{name} lost")


FAULTS: Final[Mapping[str, FaultInjector]] = {
    "principal-distance": _principal_distance,
    "cone-turned": _cone_rotated,
    "sensor-displaced": _sensor_displaced,
    "sensor-rotated": _sensor_rotated,
    "slip": slip,
    "blur": _blur,
    "blur-region": _blur_region,
    "blur-band": _blur_band,
    "smear": _smear,
    "gain-step": _gain_step,
    "gain-step-colour": _gain_step_colour,
    "banding": _banding,
    "banding-colour": _banding_colour,
    "block-offset": _block_offset,
    "block-offset-colour": _block_offset_colour,
    "clipping": _clipping,
    "exposure-pan": _exposure_pan,
    "exposure-stated": _exposure_stated,
    "exposure-colour": _exposure_colour,
    "exposure-unknown": _exposure_unknown,
    "probes-all": _probes_all,
    "probe-one": _probe_one,
    "stale": _stale,
    "tdi": _tdi,
    "half-frame": _half_frame,
    "wrong-unit": _wrong_unit,
    "bands-swapped": _bands_swapped,
    "frames-swapped": _frames_swapped,
    "frame-other": _other_ground(lambda p, name: p.other()[name], "of the next exposure"),
    "frame-turned": _other_ground(lambda p, name: p.frames[name][::-1, ::-1].copy(), "turned"),
    "frame-mirrored": _other_ground(lambda p, name: p.frames[name][:, ::-1].copy(), "mirrored"),
    "frame-part": _frame_part,
    "words": _words,
    "frame-lost": _frame_lost,
    **FRAME_FAULTS,
    **EXPOSURE_FAULTS,
}
"""How each kind of `benchmarks.silent_errors.limits` is planted."""
