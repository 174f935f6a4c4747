"""A folder of images of multispectral cameras becomes mission folders for `syntopic process`.

Pixels are copied word by word; lens, black level and, of MicaSense, the absolute response come from
the tags (`multispectral_tags`). Images are grouped by serial number and capture: each camera
becomes a mission of its own.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

from daemon.mission.canonical_json import canonical_bytes, sha256_hex
from daemon.mission.exposure import Exposure, FrameRecord, exposure_bytes
from daemon.mission.layout import Mission, exposure_name
from daemon.mission.store import durable
from daemon.mission.store.level0 import tiff_parts
from daemon.postflight.calibration.rig_writer import rig_toml
from daemon.postflight.importers.multispectral_tags import (
    BANDS,
    MICASENSE,
    BandImage,
    BandLeftOutError,
    ImagesError,
    read_image,
)
from processing.geometry.brown import Brown, lens_from_brown
from processing.geometry.fisheye import lens_from_fisheye
from processing.radiometry.radiance import radiance_as_json
from processing.rig import Cone, Lens, Rig, Sensor, find_rig

RADIOMETRY = "radiometry"
_MAX_FILES = 1_000_000
_GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
_LEAP_SECONDS = (
    (datetime(2017, 1, 1, tzinfo=UTC), 18),
    (datetime(2015, 7, 1, tzinfo=UTC), 17),
    (datetime(2012, 7, 1, tzinfo=UTC), 16),
    (datetime(2009, 1, 1, tzinfo=UTC), 15),
)
"""GPS less UTC from each instant on; the camera was not built before the last of them."""
_REDEDGE: Final = ("B", "G", "R", "N", "E")
_KNOWN: Final[tuple[tuple[str, tuple[str, ...]], ...]] = (
    (r"Parrot Sequoia", ("G", "R", "E", "N")),
    (r"DJI (FC6360|P4)", ("B", "G", "R", "E", "N")),
    (r"DJI M3M", ("G", "R", "E", "N")),
    (r"Sentera .*6X", ("B", "G", "R", "E", "N")),
)
"""Sensors of cameras by what EXIF calls them; those of MicaSense follow from their labels."""
_DUAL_BLUE: Final = ("B", "G", "R", "E", "E2")
_ORDER: Final = ("B", "G", "R", "N", "E", "E2")
_ONE_INSTANT_S: Final = 1.0
"""Files without a capture's name belong together within this time."""
_ONE_NAME_S: Final = 2.0
"""Files whose names make them a capture are not farther apart: clocks are of whole seconds."""
_BAND_IN_NAME: Final = re.compile(
    r"(.*[0-9].*?)(?:_MS)?_(?:[0-9]|GRE|RED|REG|NIR|BLU|B|G|R|RE|N)", re.IGNORECASE
)
_TIME_IN_NAME: Final = re.compile(r"(?<![0-9])[0-9]{14}_")
"""DJI's, which may differ by a second between bands; a number follows it."""
_BAND_OF: Final = dict(BANDS.values())


@dataclass(frozen=True)
class ImportedMission:
    """The written mission of one camera, its exposures, and the residuals of converted lenses.

    `missing` names frames that are not there, `notes` what is not read or not known.
    """

    mission: Mission
    camera: str
    serial: str
    exposures: int
    frames: int
    lens_fit_px: Mapping[str, float]
    missing: tuple[str, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Camera:
    """One camera of the folder: its captures in the order of their paths."""

    name: str
    serial: str
    captures: list[list[BandImage]]
    first: Mapping[str, BandImage]
    bits: Mapping[str, int]
    notes: tuple[str, ...]


def import_multispectral(
    folder: Path, out: Path, *, progress: Callable[[int, int], None] | None = None
) -> tuple[ImportedMission, ...]:
    """Write a mission from all images below `folder`: `out`, or `out/<serial>` of each camera.

    Images of one capture become one exposure, in the order of their paths. `progress` gets
    exposures done and in all.

    Raises:
        ImagesError: no images, images that cannot be read or that contradict each other, or an
            `out` that is there already. Nothing is left behind.
        OSError: the disk refused.
    """
    if out.exists():
        raise ImagesError([f"{out}: is there already; give the path of a new mission folder"])
    cameras = _cameras(folder)
    rigs = [_rig_and_fit(camera) for camera in cameras]
    total, done = sum(len(camera.captures) for camera in cameras), 0
    imported = []
    for camera, (rig, fit) in zip(cameras, rigs, strict=True):
        if len(cameras) > 1:
            durable.make_directories(out)
        place = out if len(cameras) == 1 else out / _folder_name(camera)
        before = done

        def count(number: int, before: int = before) -> None:
            if progress is not None:
                progress(before + number, total)

        imported.append(_write(camera, rig, fit, place, count))
        done += len(camera.captures)
    return tuple(imported)


def _folder_name(camera: _Camera) -> str:
    return re.sub(r"[^A-Za-z0-9-]+", "-", f"{camera.name}-{camera.serial}").strip("-")


def _write(
    camera: _Camera, rig: Rig, fit: Mapping[str, float], out: Path, count: Callable[[int], None]
) -> ImportedMission:
    rig_bytes = rig_toml(
        rig, remark=f"{camera.name} with the calibration its images carry.\n"
        "Lenses: the distortion of the XMP, fitted by Heier et al. (2002), eq. 5.1.",
        names_schema=False,
    )  # fmt: skip
    frames, missing = 0, []
    with durable.new_files(out, last="rig.toml") as part:
        for name in ("L0", "L2", RADIOMETRY):
            durable.make_directories(part / name)
        durable.create_file(part / "rig.toml", [rig_bytes], mode=0o644)
        for sensor, image in camera.first.items():
            if image.calibration is not None:
                path = part / RADIOMETRY / f"{sensor}.json"
                content = canonical_bytes(radiance_as_json(image.calibration))
                durable.create_file(path, [content], mode=0o644)
        for number, capture in enumerate(camera.captures, start=1):
            absent = [s.name for s in rig.sensors if s.name not in {i.sensor for i in capture}]
            missing += [f"exposure {number} has no frame of {name}" for name in absent]
            frames += _write_exposure(part, number, capture, rig, sha256_hex(rig_bytes))
            count(number)
    return ImportedMission(
        Mission.open(out), camera.name, camera.serial, len(camera.captures), frames, fit,
        tuple(missing), camera.notes,
    )  # fmt: skip


def _rig_and_fit(camera: _Camera) -> tuple[Rig, dict[str, float]]:
    """The rig of a camera, and the error of each lens fit, px.

    Raises:
        ImagesError: a lens that cannot be carried over.
    """
    first = camera.first
    fit: dict[str, float] = {}
    is_micasense = camera.name.startswith(MICASENSE)
    nominal = find_rig("rededge")
    names = _sensors_of(camera)
    pattern = nominal.cones[0]
    cones = []
    for name in names:
        # A head without images takes the size and lens of another, and has no wavelength.
        image = first.get(name) or replace(
            next(iter(first.values())), sensor=name, band=_BAND_OF[name], wavelength_nm=0.0
        )
        cone = next((c for c in nominal.cones if c.name == name), None) or replace(
            pattern, name=name, bands=(_BAND_OF[name],), lens=pattern.lens,
            sensors=(replace(pattern.sensors[0], name=name),),
        )  # fmt: skip
        bits = 12 if is_micasense else camera.bits.get(name, 16)
        is_own = name in first
        cones.append(_cone_of(cone, image, bits, fit if is_own else {}))
    reference = "G" if "G" in names else names[0]
    days = [image.taken.date().isoformat() for image in first.values() if image.taken is not None]
    rig = replace(
        nominal,
        name="rededge" if is_micasense and set(names) == set(_REDEDGE) else "multispectral",
        title=f"{nominal.title}, unit {camera.serial}"
        if is_micasense and set(names) == set(_REDEDGE)
        else f"{camera.name}, {len(names)} bands, unit {camera.serial}",
        master_cone=reference,
        colour_master_cone=reference,
        reference_cone=reference,
        calibration_id=f"rededge-{camera.serial}"
        if is_micasense
        else f"{_folder_name(camera).lower()}",
        calibration_date=min(days, default=nominal.calibration_date),
        cones=tuple(cones),
    )
    return rig, fit


def _sensors_of(camera: _Camera) -> tuple[str, ...]:
    """The sensors that a camera has, also those without an image in the folder."""
    found = set(camera.first)
    known: tuple[str, ...]
    if camera.name.startswith(MICASENSE):
        known = _DUAL_BLUE if "E2" in found else _REDEDGE
    else:
        known = next((s for name, s in _KNOWN if re.match(name, camera.name)), ())
    names = set(known) | found
    return tuple(name for name in _ORDER if name in names)


def _cameras(folder: Path) -> list[_Camera]:
    """All images below a folder, checked, by camera and capture in the order of their paths."""
    if not folder.is_dir():
        raise ImagesError([f"{folder}: no such folder; give the one with the camera's images"])
    paths = sorted(p for p in folder.rglob("*") if p.suffix.lower() in (".tif", ".tiff"))
    if not paths or len(paths) > _MAX_FILES:
        raise ImagesError([f"{folder}: holds {len(paths)} TIFF images; IMG_0000_1.tif ..."])
    problems: list[str] = []
    left_out: Counter[str] = Counter()
    by_camera: dict[tuple[str, str], list[BandImage]] = defaultdict(list)
    for path in paths:
        try:
            image, _ = read_image(path)
            by_camera[image.camera, image.serial].append(image)
        except BandLeftOutError as error:
            left_out[error.problems[0]] += 1
        except ImagesError as error:
            problems += error.problems
    notes = [f"{sentence}: {count} images are left out" for sentence, count in left_out.items()]
    cameras = [
        _camera_of(name, serial, images, notes, problems)
        for (name, serial), images in _joined(by_camera).items()
    ]
    if not problems and not cameras:
        problems = [f"{folder}: holds no image of a band that is processed; {'; '.join(notes)}"]
    if problems:
        raise ImagesError(problems)
    return cameras


def _joined(
    by_camera: Mapping[tuple[str, str], list[BandImage]],
) -> dict[tuple[str, str], list[BandImage]]:
    """Cameras with all their heads: heads of one band that each have a serial number are one."""
    found = dict(by_camera)
    for name in {name for name, _ in by_camera}:
        own = sorted(key for key in by_camera if key[0] == name)
        bands = [{image.sensor for image in by_camera[key]} for key in own]
        if len(own) < 2 or any(len(band) > 1 for band in bands):
            continue
        if len(set.union(*bands)) == len(own):
            found[own[0]] = [image for key in own for image in found.pop(key)]
    return found


def _camera_of(
    name: str, serial: str, images: Sequence[BandImage], notes: Sequence[str], problems: list[str]
) -> _Camera:
    """One camera; mistakes found are appended to `problems`."""
    first: dict[str, BandImage] = {}
    ones: dict[str, int] = defaultdict(int)
    usable = []
    for image in images:
        ones[image.sensor] |= image.ones
        like = first.setdefault(image.sensor, image)
        if _head(like) != _head(image):
            problems.append(
                f"{image.path.name}: another camera or calibration than {like.path.name}, which "
                f"has the same serial number {serial}; import one camera at a time"
            )
        else:
            usable.append(image)
    own = [*notes]
    if not any(image.calibration for image in first.values()):
        own.append(
            f"{name}: its radiometric tags are not read; products are DN above black, not divided "
            "by exposure time and gain"
        )
    if any(image.black is None for image in first.values()):
        own.append(f"{name}: no BlackLevel is stated; it is taken as 0")
    if unused := dict.fromkeys(tag for image in images for tag in image.unused):
        own.append(f"{name}: tags that the files have and nothing uses: {', '.join(unused)}")
    if all(image.utc is None for image in images):
        own.append(
            f"{name}: its clock is not stated to be UTC (UTCAtExposure, OffsetTimeOriginal); "
            "exposures have no time"
        )
    if not name.startswith(MICASENSE) and not any(re.match(key, name) for key, _ in _KNOWN):
        own.append(
            f"{name} is not a known camera: bands that are not in the folder cannot be noticed. "
            f"Found: {', '.join(_BAND_OF[sensor] for sensor in _ORDER if sensor in first)}"
        )
    bits = {sensor: 16 - (_trailing_zeros(found)) for sensor, found in ones.items()}
    return _Camera(name, serial, _captures(usable, problems), first, bits, tuple(own))


def _trailing_zeros(ones: int) -> int:
    """How many low bits are zero in every word: those of a left-justified signal."""
    return (ones & -ones).bit_length() - 1 if ones else 0


def _captures(images: Sequence[BandImage], problems: list[str]) -> list[list[BandImage]]:
    """Images by capture: by its name, else by time."""
    named: dict[str, list[BandImage]] = {}
    timed: list[BandImage] = []
    for image in images:
        if not image.capture_id:
            timed.append(image)
            continue
        capture = named.setdefault(image.capture_id, [])
        if any(other.sensor == image.sensor for other in capture):
            problems.append(f"{image.path.name}: its capture has another image of that band")
        capture.append(image)
    without = [image.path.name for image in timed if image.taken is None]
    if without:
        problems.append(
            f"{', '.join(without[:5])}: neither CaptureId, CaptureUUID, ImageUniqueID nor "
            "DateTimeOriginal; which bands belong together is not known"
        )
        timed = []
    groups: list[list[BandImage]] = list(_by_file_name(timed))
    for image in sorted(timed if not groups else (), key=_instant):
        if not groups or not _belongs(image, groups[-1]):
            groups.append([])
        groups[-1].append(image)
    found = [*named.values(), *groups]
    return sorted(found, key=lambda capture: min(str(image.path) for image in capture))


def _by_file_name(images: Sequence[BandImage]) -> Iterable[list[BandImage]]:
    """Captures by names such as IMG_0012_3 or IMG_0012_NIR, where all files have such ones.

    A capture without a band and the next one a second later would otherwise exchange bands. None
    where names contradict bands or times.
    """
    found: dict[tuple[Path, str], list[BandImage]] = defaultdict(list)
    for image in images:
        parts = _BAND_IN_NAME.fullmatch(_TIME_IN_NAME.sub("", image.path.stem))
        if parts is None:
            return []
        found[image.path.parent, parts[1]].append(image)
    for group in found.values():
        times = sorted(map(_instant, group))
        is_doubled = len({image.sensor for image in group}) < len(group)
        if is_doubled or (times[-1] - times[0]).total_seconds() > _ONE_NAME_S:
            return []
    return found.values()


def _instant(image: BandImage) -> datetime:
    return image.taken or _GPS_EPOCH


def _belongs(image: BandImage, group: Sequence[BandImage]) -> bool:
    since_s = (_instant(image) - _instant(group[0])).total_seconds()
    return since_s <= _ONE_INSTANT_S and all(other.sensor != image.sensor for other in group)


def _head(image: BandImage) -> tuple[Any, ...]:
    size = (image.width_px, image.height_px, image.pitch_mm)
    return (image.serial, *size, image.lens, image.calibration)


def _cone_of(cone: Cone, image: BandImage, bits: int, fit: dict[str, float]) -> Cone:
    """A cone with the lens, the principal point and the serial number of an image."""
    lens, worst_px = _lens_of(image)
    fit[image.sensor] = worst_px
    column, row = image.lens.principal_point_px
    sensor: Sensor = replace(
        cone.sensors[0],
        serial=image.serial,
        width_px=image.width_px,
        height_px=image.height_px,
        pitch_um=round(image.pitch_mm * 1e3, 6),
        x_mm=((image.width_px - 1) / 2.0 - column) * image.pitch_mm,
        y_mm=(row - (image.height_px - 1) / 2.0) * image.pitch_mm,
        bits=bits,
        black_dn=0.0,
    )
    sensor = replace(sensor, black_dn=(image.black or 0.0) / sensor.raw_units_per_dn)
    known = (image.wavelength_nm,) if image.wavelength_nm > 0.0 and len(cone.bands) == 1 else ()
    return replace(cone, lens=lens, sensors=(sensor,), wavelengths_nm=known)


def _lens_of(image: BandImage) -> tuple[Lens, float]:
    """The lens of an image's tags, and the error of its fit, px."""
    common: dict[str, Any] = {
        "width_px": image.width_px,
        "height_px": image.height_px,
        "pitch_mm": image.pitch_mm,
        "f_number": image.f_number,
        "serial": image.serial,
    }
    try:
        if isinstance(image.lens, Brown):
            return lens_from_brown(image.lens, **common)
        return lens_from_fisheye(image.lens, **common)
    except ValueError as error:
        raise ImagesError([f"{image.path.name}: {error}"]) from error


def _write_exposure(
    mission: Path, number: int, capture: Sequence[BandImage], rig: Rig, rig_sha256: str
) -> int:
    folder = mission / "L0" / exposure_name(number)
    folder.mkdir()
    frames = []
    for image in sorted(capture, key=lambda image: image.sensor):
        again, pixels = read_image(image.path)
        description = {"sensor": image.sensor, "exposure": number, "source": image.path.name}
        parts = tiff_parts([pixels], {"syntopic": 1, "head_serial": image.serial, **description})
        name = f"{image.sensor}.tif"
        durable.create_file(folder / name, parts)
        frames.append(_frame(again, name, sha256_hex(b"".join(parts))))
    utc = min((image.utc for image in capture if image.utc is not None), default=None)
    exposure = Exposure(
        number=number,
        frames=tuple(frames),
        missing=tuple(
            (sensor.name, "no image of this capture")
            for sensor in rig.sensors
            if sensor.name not in {image.sensor for image in capture}
        ),
        state="complete" if len(frames) == len(rig.sensors) else "degraded",
        calibration_id=rig.calibration_id,
        calibration_sha256=rig_sha256,
        mark_gps_ns=None if utc is None else gps_ns_from_utc(utc),
        mark_source="none" if utc is None else "host",
        software="syntopic import multispectral",
    )
    durable.create_file(folder / "exposure.json", [exposure_bytes(exposure)])
    durable.sync_directory(folder)
    return len(frames)


def _frame(image: BandImage, file: str, sha256: str) -> FrameRecord:
    settings: dict[str, float | int | str] = {
        "Gain": image.gain,
        "Source": image.path.name,
        **({} if image.black is None else {"BlackLevel": image.black}),
        **({"CaptureId": image.capture_id[:100]} if image.capture_id else {}),
        **image.place,
    }
    return FrameRecord(
        sensor=image.sensor,
        head_serial=image.serial,
        file=file,
        sha256=sha256,
        width_px=image.width_px,
        height_px=image.height_px,
        pixel_format="Mono16",
        device_ns=None,
        counter=None,
        exposure_time_us=image.exposure_time_s * 1e6,
        temperature_c=None,
        mono_ns=0,
        settings=settings,
    )


def gps_ns_from_utc(utc: datetime) -> int:
    """GPS time of an instant in UTC, ns since the GPS epoch, to the microsecond."""
    leap = next((seconds for since, seconds in _LEAP_SECONDS if utc >= since), 14)
    microseconds = (utc - _GPS_EPOCH + timedelta(seconds=leap)) // timedelta(microseconds=1)
    return microseconds * 1000
