"""Wrong inputs: what is planted for each kind, of a given size, in a head and region by chance."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.silent_errors.exposures import Planted
from processing.rig import Cone, Rig, Sensor

Array = NDArray[Any]
Random = np.random.Generator
T = TypeVar("T")


@dataclass(frozen=True)
class Fault:
    """What was planted: the exposure, what may rightly be named as the cause, and a description."""

    planted: Planted
    culprits: frozenset[str]
    says: str


Plant = Callable[[Planted, float, Random], Fault]


def _of_cone(planted: Planted, cone: Cone, change: Callable[[Cone], Cone], says: str) -> Fault:
    names = frozenset({cone.name, *(s.name for s in cone.sensors)})
    return Fault(planted.with_cone(cone.name, change), names, f"cone {cone.name}: {says}")


def _of_sensor(planted: Planted, name: str, change: Callable[[Sensor], Sensor], says: str) -> Fault:
    names = frozenset({name, planted.rig.cone_of(name).name})
    return Fault(planted.with_sensor(name, change), names, f"{name}: {says}")


def _of_frame(planted: Planted, name: str, change: Callable[[Array], Array], says: str) -> Fault:
    names = frozenset({name, planted.rig.cone_of(name).name})
    return Fault(planted.with_frame(name, change), names, f"{name}: {says}")


def _any(random: Random, some: Sequence[T]) -> T:
    return some[int(random.integers(0, len(some)))]


def _sign(random: Random) -> float:
    return float(_any(random, (-1.0, 1.0)))


def _pan(rig: Rig) -> list[str]:
    """PAN sensors; all where there is no PAN."""
    pan = [s.name for cone in rig.pan_cones for s in cone.sensors]
    return pan or [s.name for s in rig.sensors]


def _colour(rig: Rig) -> list[str]:
    return [s.name for cone in rig.cones if cone.role == "colour" for s in cone.sensors]


def _several(rig: Rig) -> list[str]:
    """Sensors of cones of several."""
    return [s.name for cone in rig.pan_cones if len(cone.sensors) > 1 for s in cone.sensors]


def _principal_distance(planted: Planted, ppm: float, random: Random) -> Fault:
    cone, off = _any(random, planted.rig.pan_cones), _sign(random) * ppm
    return _of_cone(planted, cone, _with_f(off), f"principal distance {off:+.0f} ppm")


def _with_f(ppm: float) -> Callable[[Cone], Cone]:
    return lambda c: replace(c, lens=replace(c.lens, f_mm=c.lens.f_mm * (1.0 + ppm * 1e-6)))


def _turned(turn_rad: Sequence[float]) -> Callable[[Cone], Cone]:
    def change(cone: Cone) -> Cone:
        x, y, z = (a + b for a, b in zip(cone.rotation_rad, turn_rad, strict=True))
        return replace(cone, rotation_rad=(x, y, z))

    return change


def _cone_turned(planted: Planted, urad: float, random: Random) -> Fault:
    rig = planted.rig
    cone = _any(random, [c for c in rig.cones if c.name != rig.master_cone])
    axis, off = int(random.integers(0, 3)), _sign(random) * urad
    turn = np.eye(3)[axis] * off * 1e-6
    return _of_cone(planted, cone, _turned(turn), f"turned {off:+.0f} urad about {'xyz'[axis]}")


def _moved(x_px: float, y_px: float) -> Callable[[Sensor], Sensor]:
    return lambda s: replace(s, x_mm=s.x_mm + x_px * s.pitch_mm, y_mm=s.y_mm + y_px * s.pitch_mm)


def _sensor_displaced(planted: Planted, px: float, random: Random) -> Fault:
    name, angle = _any(random, _several(planted.rig)), float(random.uniform(0.0, 2.0 * np.pi))
    x, y = px * np.cos(angle), px * np.sin(angle)
    return _of_sensor(planted, name, _moved(x, y), f"displaced {x:+.2f}, {y:+.2f} px")


def _sensor_rotated(planted: Planted, urad: float, random: Random) -> Fault:
    name, off = _any(random, _several(planted.rig)), _sign(random) * urad
    return _of_sensor(
        planted,
        name,
        lambda s: replace(s, rotation_rad=s.rotation_rad + off * 1e-6),
        f"rotated {off:+.0f} urad",
    )


def _slip(planted: Planted, lines: float, random: Random) -> Fault:
    name = _any(random, [*_pan(planted.rig), *_leading(planted.rig)])
    axis = int(random.integers(0, 2))
    sensor = planted.rig.sensor(name)
    size = (sensor.height_px, sensor.width_px)[axis]
    count = min(round(lines), size // 2)
    first, by = int(random.integers(8, size - count - 8)), int(random.integers(1, 5))
    last = first + count

    def change(frame: Array) -> Array:
        rows = frame if axis == 0 else frame.T
        rows[first:last] = rows.copy()[np.clip(np.arange(first, last) + by, 0, size - 1)]
        return frame

    def content(raw: Array) -> Array:
        at = raw[:, 1 - axis]
        inside = (at >= first - 0.5) & (at < last - 0.5)
        moved = raw.copy()
        moved[inside, 1 - axis] += by
        return moved

    says = f"{count} {('rows', 'columns')[axis]} from {first} on are those {by} further on"
    fault = _of_frame(planted, name, change, says)
    return replace(fault, planted=replace(fault.planted, content={name: content}))


def _leading(rig: Rig) -> list[str]:
    """The colour head that is stitched."""
    name = rig.colour_master_cone
    return [] if name is None else [rig.cone(name).sensors[0].name]


def _blurred(sigma: float) -> Callable[[Array], Array]:
    return lambda frame: np.asarray(cv2.GaussianBlur(frame, (0, 0), sigma))


def _blur(planted: Planted, sigma: float, random: Random) -> Fault:
    name = _any(random, _pan(planted.rig))
    return _of_frame(planted, name, _blurred(sigma), f"blurred by {sigma:.2f} px")


def _blur_region(planted: Planted, sigma: float, random: Random) -> Fault:
    name = _any(random, _pan(planted.rig))
    part, where = _part(planted.rig.sensor(name), 2, random)

    def change(frame: Array) -> Array:
        frame[part] = cv2.GaussianBlur(frame, (0, 0), sigma)[part]
        return frame

    return _of_frame(planted, name, change, f"blurred by {sigma:.2f} px in {where}")


def _part(sensor: Sensor, parts: int, random: Random) -> tuple[tuple[slice, slice], str]:
    """One of `parts` x `parts` regions of a frame."""
    height, width = sensor.height_px // parts, sensor.width_px // parts
    top = int(random.integers(0, sensor.height_px - height + 1))
    left = int(random.integers(0, sensor.width_px - width + 1))
    where = f"rows {top} to {top + height - 1}, columns {left} to {left + width - 1}"
    return (slice(top, top + height), slice(left, left + width)), where


def _blur_band(planted: Planted, sigma: float, random: Random) -> Fault:
    name = _any(random, _colour(planted.rig))
    bayer = planted.rig.sensor(name).colour_filter_array != "none"

    def change(frame: Array) -> Array:
        if not bayer:
            return _blurred(sigma)(frame)
        for row in (0, 1):
            for column in (0, 1):
                plane = np.ascontiguousarray(frame[row::2, column::2])
                frame[row::2, column::2] = cv2.GaussianBlur(plane, (0, 0), sigma / 2.0)
        return frame

    return _of_frame(planted, name, change, f"blurred by {sigma:.2f} px")


def _smear(planted: Planted, px: float, random: Random) -> Fault:
    name, along = _any(random, _pan(planted.rig)), bool(random.integers(0, 2))
    # Of an even length the content would shift by half a pixel, too.
    length = 1 + 2 * max(1, round((px - 1.0) / 2.0))
    size = (1, length) if along else (length, 1)
    way = "along" if along else "across"
    return _of_frame(
        planted, name, lambda f: np.asarray(cv2.blur(f, size)), f"smeared by {length} px {way}"
    )


def _scaled(sensor: Sensor, frame: Array, factor: Any) -> Array:
    signal = (frame.astype(np.float64) - sensor.black_dn) * factor + sensor.black_dn
    return np.asarray(np.clip(np.rint(signal), 0, sensor.full_scale_dn), np.uint16)


def _gain_step(planted: Planted, percent: float, random: Random) -> Fault:
    name, axis = _any(random, [s.name for s in planted.rig.sensors]), int(random.integers(0, 2))
    sensor = planted.rig.sensor(name)
    size = (sensor.height_px, sensor.width_px)[axis]
    line, off = int(random.integers(size // 8, size - size // 8)), _sign(random) * percent
    factors = np.where(np.arange(size) < line, 1.0, 1.0 + off / 100.0)
    factor = factors[:, None] if axis == 0 else factors[None, :]
    says = f"signal {off:+.1f} % from {('row', 'column')[axis]} {line} on"
    return _of_frame(planted, name, lambda f: _scaled(sensor, f, factor), says)


def _banding(planted: Planted, percent: float, random: Random) -> Fault:
    name, axis = _any(random, [s.name for s in planted.rig.sensors]), int(random.integers(0, 2))
    sensor = planted.rig.sensor(name)
    size, period = (sensor.height_px, sensor.width_px)[axis], int(random.integers(8, 41))
    signal = float(np.median(planted.frames[name])) - sensor.black_dn
    dn = np.rint(percent / 100.0 * signal) * ((np.arange(size) // period) % 2)
    lines = dn[:, None] if axis == 0 else dn[None, :]
    says = f"{('rows', 'columns')[axis]} in turn of {period} {dn.max():.0f} DN brighter"
    return _of_frame(planted, name, lambda f: _added(sensor, f, lines), says)


def _added(sensor: Sensor, frame: Array, dn: Any) -> Array:
    return np.asarray(np.clip(frame + dn, 0, sensor.full_scale_dn), np.uint16)


def _block_offset(planted: Planted, dn: float, random: Random) -> Fault:
    name = _any(random, _pan(planted.rig))
    sensor = planted.rig.sensor(name)
    part, where = _part(sensor, 4, random)
    added = np.zeros((sensor.height_px, sensor.width_px))
    added[part] = round(dn)
    says = f"{dn:.0f} DN brighter in {where}"
    return _of_frame(planted, name, lambda f: _added(sensor, f, added), says)


def _clipping(planted: Planted, percent: float, random: Random) -> Fault:
    name = _any(random, _pan(planted.rig))
    level = float(np.percentile(planted.frames[name], 100.0 - percent))
    says = f"clipped at {level:.0f} DN, {percent:.1f} % of its pixels"
    return _of_frame(planted, name, lambda f: np.minimum(f, np.uint16(level)), says)


def _exposure_of(planted: Planted, name: str, percent: float, random: Random) -> Fault:
    factor = 1.0 + percent / 100.0
    factor = factor if random.integers(0, 2) else 1.0 / factor
    sensor = planted.rig.sensor(name)
    return _of_frame(
        planted, name, lambda f: _scaled(sensor, f, factor), f"exposed {factor:.2f} times as long"
    )


def _exposure_pan(planted: Planted, percent: float, random: Random) -> Fault:
    return _exposure_of(planted, _any(random, _pan(planted.rig)), percent, random)


def _exposure_colour(planted: Planted, percent: float, random: Random) -> Fault:
    return _exposure_of(planted, _any(random, _colour(planted.rig)), percent, random)


def _exposure_stated(planted: Planted, percent: float, random: Random) -> Fault:
    name = _any(random, _several(planted.rig))
    factor = 1.0 + percent / 100.0
    factor = factor if random.integers(0, 2) else 1.0 / factor
    times = dict(planted.conditions.exposure_time_s)
    times[name] *= factor
    conditions = replace(planted.conditions, exposure_time_s=times)
    culprits = frozenset({name, planted.rig.cone_of(name).name})
    says = f"{name}: stated to be exposed {factor:.2f} times as long"
    return Fault(replace(planted, conditions=conditions), culprits, says)


def _with_probes(planted: Planted, off_k: Mapping[str, float]) -> Planted:
    read = {
        p: None if c is None else c + off_k.get(p, 0.0)
        for p, c in planted.conditions.temperatures_c.items()
    }
    return replace(planted, conditions=replace(planted.conditions, temperatures_c=read))


def _probes_all(planted: Planted, kelvin: float, random: Random) -> Fault:
    off = _sign(random) * kelvin
    changed = _with_probes(planted, dict.fromkeys(planted.rig.probes, off))
    names = frozenset(planted.rig.probes) | {c.name for c in planted.rig.cones}
    return Fault(changed, names, f"all probes {off:+.1f} K")


def _probe_one(planted: Planted, kelvin: float, random: Random) -> Fault:
    cone, off = _any(random, planted.rig.pan_cones), _sign(random) * kelvin
    read = {cone.probe, *(s.probe for s in cone.sensors)}
    names = frozenset(read | {cone.name})
    return Fault(_with_probes(planted, dict.fromkeys(read, off)), names, f"probe {read} {off:+.1f}")


def _stale(planted: Planted, seconds: float, random: Random) -> Fault:
    fault = _probes_all(planted, 0.02 * seconds, random)
    ages = dict.fromkeys(planted.rig.probes, seconds)
    conditions = replace(fault.planted.conditions, temperature_age_s=ages)
    return replace(fault, planted=replace(fault.planted, conditions=conditions))


def _tdi(planted: Planted, shifts: float, random: Random) -> Fault:
    cone = _any(random, planted.rig.pan_cones)
    off = int(_sign(random)) * max(1, round(shifts))
    counts = dict(planted.conditions.tdi_shifts)
    for sensor in cone.sensors:
        counts[sensor.name] = max(0, counts[sensor.name] + off)
    conditions = replace(planted.conditions, tdi_shifts=counts)
    names = frozenset({cone.name, *(s.name for s in cone.sensors)})
    return Fault(
        replace(planted, conditions=conditions), names, f"cone {cone.name}: TDI count {off:+d}"
    )


def _half_frame(planted: Planted, percent: float, random: Random) -> Fault:
    name = _any(random, [s.name for s in planted.rig.sensors])
    lines = round(planted.rig.sensor(name).height_px * min(percent, 90.0) / 100.0)

    def change(frame: Array) -> Array:
        frame[-lines:] = 0
        return frame

    fault = _of_frame(planted, name, change, f"last {lines} rows not read out")
    return replace(fault, planted=replace(fault.planted, elsewhere=frozenset({name})))


def _wrong_unit(planted: Planted, times: float, random: Random) -> Fault:
    rig, changed = planted.rig, planted
    for cone in rig.cones:
        turn = random.normal(0.0, 300e-6 * times, 3) * float(cone.name != rig.master_cone)
        changed = changed.with_cone(cone.name, _turned([float(a) for a in turn]))
        changed = changed.with_cone(cone.name, _with_f(float(random.normal(0.0, 500.0 * times))))
        for sensor in cone.sensors:
            x, y = random.normal(0.0, 2.0 * times, 2)
            changed = changed.with_sensor(sensor.name, _moved(float(x), float(y)))
    names = frozenset({s.name for s in rig.sensors} | {c.name for c in rig.cones} | {*rig.probes})
    return Fault(changed, names, f"rig file of another unit, {times:.1f} times its differences")


def _exchanged(planted: Planted, a: str, b: str) -> Fault:
    frames = {**planted.frames, a: planted.frames[b], b: planted.frames[a]}
    names = frozenset({a, b, planted.rig.cone_of(a).name, planted.rig.cone_of(b).name})
    changed = replace(planted, frames=frames, elsewhere=frozenset({a, b}))
    return Fault(changed, names, f"frames of {a} and {b} swapped")


def _bands_swapped(planted: Planted, _: float, random: Random) -> Fault:
    a, b = random.choice(_colour(planted.rig), 2, replace=False)
    fault = _exchanged(planted, str(a), str(b))
    # The same ground, in another colour.
    return replace(fault, planted=replace(fault.planted, elsewhere=frozenset()))


def _frames_swapped(planted: Planted, _: float, random: Random) -> Fault:
    a, b = random.choice(_pan(planted.rig), 2, replace=False)
    return _exchanged(planted, str(a), str(b))


def _other_ground(change: Callable[[Planted, str], Array], says: str) -> Plant:
    def plant(planted: Planted, _: float, random: Random) -> Fault:
        name = _any(random, [s.name for s in planted.rig.sensors])
        fault = _of_frame(planted, name, lambda _: change(planted, name), says)
        return replace(fault, planted=replace(fault.planted, elsewhere=frozenset({name})))

    return plant


def _words(planted: Planted, _: float, random: Random) -> Fault:
    name = _any(random, [s.name for s in planted.rig.sensors])
    shift = 16 - planted.rig.sensor(name).bits
    if random.integers(0, 2):
        return _of_frame(planted, name, lambda f: f.byteswap(), "words byte-swapped")
    return _of_frame(planted, name, lambda f: f << shift, "words left-justified")


def _frame_lost(planted: Planted, _: float, random: Random) -> Fault:
    name = _any(random, [s.name for s in planted.rig.sensors])
    frames = {n: f for n, f in planted.frames.items() if n != name}
    changed = replace(planted, frames=frames, elsewhere=frozenset({name}))
    return Fault(changed, frozenset({name, planted.rig.cone_of(name).name}), f"{name} lost")


FAULTS: Final[Mapping[str, Plant]] = {
    "principal-distance": _principal_distance,
    "cone-turned": _cone_turned,
    "sensor-displaced": _sensor_displaced,
    "sensor-rotated": _sensor_rotated,
    "slip": _slip,
    "blur": _blur,
    "blur-region": _blur_region,
    "blur-band": _blur_band,
    "smear": _smear,
    "gain-step": _gain_step,
    "banding": _banding,
    "block-offset": _block_offset,
    "clipping": _clipping,
    "exposure-pan": _exposure_pan,
    "exposure-stated": _exposure_stated,
    "exposure-colour": _exposure_colour,
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
    "words": _words,
    "frame-lost": _frame_lost,
}
"""How each kind of `benchmarks.silent_errors.limits` is planted."""
