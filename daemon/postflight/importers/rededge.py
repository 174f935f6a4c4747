"""A folder of MicaSense RedEdge images becomes a mission folder that `syntopic process` takes.

Pixels are copied word by word; lens, vignetting and absolute response come from EXIF and XMP of the
images, which are checked to be of one camera.

Source: MicaSense, "RedEdge metadata" and "RedEdge camera radiometric calibration model".
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.mission.canonical_json import canonical_bytes, sha256_hex
from daemon.mission.exposure import Exposure, FrameRecord, exposure_bytes
from daemon.mission.layout import Mission, exposure_name
from daemon.mission.store import durable
from daemon.mission.store.level0 import tiff_errors, tiff_parts
from daemon.postflight.calibration.rig_writer import rig_toml
from daemon.postflight.importers.xmp import Xmp, XmpError, read_xmp
from drivers.cameras.tiff_layout import layout_problem
from processing.geometry.brown import Brown, lens_from_brown
from processing.radiometry.radiance import RadianceCalibration, radiance_as_json
from processing.rig import Cone, Rig, find_rig

SENSOR_OF_BAND = {"blue": "B", "green": "G", "red": "R", "nir": "N", "red edge": "E"}
RADIOMETRY = "radiometry"
_MAX_FILE_BYTES = 100_000_000
_MAX_FILES = 1_000_000
_GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
_LEAP_SECONDS = (
    (datetime(2017, 1, 1, tzinfo=UTC), 18),
    (datetime(2015, 7, 1, tzinfo=UTC), 17),
    (datetime(2012, 7, 1, tzinfo=UTC), 16),
    (datetime(2009, 1, 1, tzinfo=UTC), 15),
)
"""GPS less UTC from each instant on; the camera was not built before the last of them."""

_XMP, _EXIF, _GPS, _BLACK_LEVEL = 700, 34665, 34853, 50714


class ImagesError(DaemonError):
    """Images that make no mission; `problems` holds one message for each mistake found."""

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(problems))


@dataclass(frozen=True)
class RedEdgeImage:
    """One head's image file: what its tags say.

    `brown` and `calibration` are the head's; the rest is of this exposure. `black` is in words of
    16 bits. `utc` is the camera's own clock, which its GNSS sets.
    """

    path: Path
    capture_id: str
    sensor: str
    serial: str
    width_px: int
    height_px: int
    pitch_mm: float
    brown: Brown
    calibration: RadianceCalibration
    f_number: float
    exposure_time_s: float
    gain: float
    black: float
    utc: datetime | None
    place: Mapping[str, float]


@dataclass(frozen=True)
class ImportedMission:
    """The written mission, its exposures, and the residuals of each converted lens."""

    mission: Mission
    exposures: int
    frames: int
    lens_fit_px: Mapping[str, float]
    missing: tuple[str, ...]


def import_rededge(
    folder: Path, out: Path, *, progress: Callable[[int, int], None] | None = None
) -> ImportedMission:
    """Write the mission folder `out` from all images below `folder`.

    Images of one capture become one exposure, in the order of their paths. `progress` gets
    exposures done and in all.

    Raises:
        ImagesError: no images, images that cannot be read or are of several cameras, or an `out`
            that is there already. Nothing is left behind.
        OSError: the disk refused.
    """
    if out.exists():
        raise ImagesError([f"{out}: is there already; give the path of a new mission folder"])
    captures = _captures(folder)
    first = {image.sensor: image for capture in reversed(captures) for image in capture}
    rig, fit = rig_of(first)
    rig_bytes = rig_toml(
        rig, remark="A MicaSense RedEdge with the calibration its images carry.\n"
        "Lenses: Brown's distortion of the XMP, fitted by Heier et al. (2002), eq. 5.1.",
        names_schema=False,
    )  # fmt: skip
    frames, missing = 0, []
    with durable.new_files(out, last="rig.toml") as part:
        for name in ("L0", "L2", RADIOMETRY):
            durable.make_directories(part / name)
        durable.create_file(part / "rig.toml", [rig_bytes], mode=0o644)
        for sensor, image in first.items():
            path = part / RADIOMETRY / f"{sensor}.json"
            content = canonical_bytes(radiance_as_json(image.calibration))
            durable.create_file(path, [content], mode=0o644)
        for number, capture in enumerate(captures, start=1):
            absent = [s.name for s in rig.sensors if s.name not in {i.sensor for i in capture}]
            missing += [f"exposure {number} has no frame of {name}" for name in absent]
            frames += _write_exposure(part, number, capture, rig, sha256_hex(rig_bytes))
            if progress is not None:
                progress(number, len(captures))
    return ImportedMission(Mission.open(out), len(captures), frames, fit, tuple(missing))


def rig_of(images: Mapping[str, RedEdgeImage]) -> tuple[Rig, dict[str, float]]:
    """The rig of one camera, from one image per sensor, and the error of each lens fit, px.

    Raises:
        ImagesError: a lens that cannot be carried over.
    """
    nominal = find_rig("rededge")
    fit: dict[str, float] = {}
    serials = {image.serial for image in images.values()}
    cones = [_cone_of(cone, images.get(cone.sensors[0].name), fit) for cone in nominal.cones]
    serial = "-".join(sorted(serials)) or "unknown"
    days = [image.utc.date().isoformat() for image in images.values() if image.utc is not None]
    rig = replace(
        nominal,
        title=f"{nominal.title}, unit {serial}",
        calibration_id=f"rededge-{serial}",
        calibration_date=min(days, default=nominal.calibration_date),
        cones=tuple(cones),
    )
    return rig, fit


def read_image(path: Path) -> tuple[RedEdgeImage, NDArray[np.uint16]]:
    """One image file: its tags and its words, (h, w).

    Raises:
        ImagesError: no RedEdge image, damaged, or without what the calibration needs.
    """
    from tifffile import TiffFile

    try:
        if path.stat().st_size > _MAX_FILE_BYTES:
            raise ImagesError([f"{path.name}: larger than {_MAX_FILE_BYTES} bytes; no image"])
        with TiffFile(path) as tiff:
            if problem := layout_problem(tiff):
                raise ImagesError([f"{path.name}: {problem}"])
            page = tiff.pages[0]
            tags = {code: page.tags[code].value for code in (_XMP, _EXIF) if code in page.tags}
            tags |= {c: page.tags[c].value for c in (_GPS, _BLACK_LEVEL) if c in page.tags}
            if page.dtype != np.uint16 or len(page.shape) != 2:
                raise ImagesError([f"{path.name}: is no plane of 16-bit words"])
            shape = (int(page.shape[0]), int(page.shape[1]))
            # Uncompressed, as the camera writes: a file cannot ask for more memory than it has.
            if page.compression != 1 or 2 * shape[0] * shape[1] > path.stat().st_size:
                raise ImagesError([f"{path.name}: is compressed or ends early; give the original"])
            image = _image(path, tags, shape)
            pixels: NDArray[np.uint16] = np.ascontiguousarray(page.asarray())
    except (ImagesError, OSError):
        raise
    except XmpError as error:
        raise ImagesError([str(error)]) from error
    except tiff_errors() as error:
        sentence = f"{path.name}: not a usable RedEdge image ({type(error).__name__}: {error})"
        raise ImagesError([sentence]) from error
    if pixels.shape != shape:
        raise ImagesError([f"{path.name}: its pixels end early"])
    return image, pixels


def _image(path: Path, tags: Mapping[int, Any], shape: tuple[int, int]) -> RedEdgeImage:
    for code, name in ((_XMP, "XMP"), (_EXIF, "EXIF"), (_BLACK_LEVEL, "BlackLevel")):
        if code not in tags:
            raise ImagesError([f"{path.name}: has no {name}; give images as the camera wrote"])
    packet, exif = tags[_XMP], tags[_EXIF]
    if isinstance(packet, str):
        packet = packet.encode("utf-8")
    if not isinstance(packet, bytes) or not isinstance(exif, dict):
        raise ImagesError([f"{path.name}: XMP or EXIF is of an unknown kind"])
    xmp = read_xmp(packet, path.name)
    band = xmp.text("BandName").strip().lower()
    if band not in SENSOR_OF_BAND:
        known = ", ".join(SENSOR_OF_BAND)
        raise ImagesError([f"{path.name}: band {band[:40]!r}; a RedEdge has {known}"])
    if xmp.text("ModelType") != "perspective":
        raise ImagesError([f"{path.name}: lens {xmp.text('ModelType')[:40]!r}; perspective only"])
    height_px, width_px = shape
    # FocalPlaneResolutionUnit 4 is millimetres.
    per_mm = _ratio(exif["FocalPlaneXResolution"])
    if exif.get("FocalPlaneResolutionUnit") != 4 or not 10.0 < per_mm < 10_000.0:
        raise ImagesError([f"{path.name}: focal plane resolution is not in pixels per mm"])
    black = np.atleast_1d(tags[_BLACK_LEVEL]).astype(np.float64)
    if not (black.size and black.min() >= 0.0 and black.max() < 65536.0):
        raise ImagesError([f"{path.name}: BlackLevel is no word of 16 bits"])
    a1, a2, a3 = xmp.numbers("RadiometricCalibration", 3)
    centre = xmp.numbers("VignettingCenter", 2)
    time_s, gain = _ratio(exif["ExposureTime"]), float(exif["ISOSpeed"]) / 100.0
    if not (0.0 < time_s < 10.0 and 0.0 < gain < 1000.0):
        raise ImagesError([f"{path.name}: exposure time {time_s:g} s at gain {gain:g}; no image"])
    return RedEdgeImage(
        path=path,
        capture_id=xmp.text("CaptureId"),
        sensor=SENSOR_OF_BAND[band],
        serial=str(exif.get("BodySerialNumber", "unknown")).strip("\0 ")[:40],
        width_px=width_px,
        height_px=height_px,
        pitch_mm=1.0 / per_mm,
        brown=_brown(xmp, per_mm),
        calibration=RadianceCalibration(
            a1=a1,
            a2=a2,
            a3=a3,
            vignetting_centre_px=(centre[0], centre[1]),
            vignetting=xmp.numbers("VignettingPolynomial", 6),
            wavelength_nm=xmp.number("CentralWavelength"),
            bandwidth_nm=xmp.number("WavelengthFWHM"),
        ),
        f_number=_ratio(exif["FNumber"]),
        exposure_time_s=time_s,
        gain=gain,
        black=float(black.mean()),
        utc=_utc(exif),
        place=_place(tags.get(_GPS, {})),
    )


def _brown(xmp: Xmp, per_mm: float) -> Brown:
    k1, k2, k3, p1, p2 = xmp.numbers("PerspectiveDistortion", 5)
    x_mm, y_mm = xmp.numbers("PrincipalPoint", 2)
    f = xmp.number("PerspectiveFocalLength")
    # Later firmware states the focal length in mm and its unit.
    units = "PerspectiveFocalLengthUnits"
    if units in xmp and xmp.text(units) == "mm":
        f *= per_mm
    if not 100.0 < f < 100_000.0:
        raise ValueError(f"focal length of {f:g} px")
    return Brown(f, (x_mm * per_mm, y_mm * per_mm), k1, k2, k3, p1, p2)


def _captures(folder: Path) -> list[list[RedEdgeImage]]:
    """All images below a folder, checked, by capture in the order of their paths."""
    if not folder.is_dir():
        raise ImagesError([f"{folder}: no such folder; give the one with the camera's images"])
    paths = sorted(p for p in folder.rglob("*") if p.suffix.lower() in (".tif", ".tiff"))
    if not paths or len(paths) > _MAX_FILES:
        raise ImagesError([f"{folder}: holds {len(paths)} TIFF images; IMG_0000_1.tif ..."])
    problems: list[str] = []
    by_capture: dict[str, list[RedEdgeImage]] = defaultdict(list)
    known: dict[str, RedEdgeImage] = {}
    for path in paths:
        try:
            image, _ = read_image(path)
        except ImagesError as error:
            problems += error.problems
            continue
        like = known.setdefault(image.sensor, image)
        if _head(like) != _head(image):
            problems.append(
                f"{path.name}: another camera or calibration than {like.path.name}; "
                f"import one camera at a time"
            )
        elif any(other.sensor == image.sensor for other in by_capture[image.capture_id]):
            problems.append(f"{path.name}: its capture has another image of that band")
        else:
            by_capture[image.capture_id].append(image)
    if problems:
        raise ImagesError(problems)
    return list(by_capture.values())


def _head(image: RedEdgeImage) -> tuple[Any, ...]:
    size = (image.width_px, image.height_px, image.pitch_mm)
    return (image.serial, *size, image.brown, image.calibration)


def _cone_of(cone: Cone, image: RedEdgeImage | None, fit: dict[str, float]) -> Cone:
    """A cone with the lens, the principal point and the serial number of an image."""
    if image is None:
        return cone
    try:
        lens, worst_px = lens_from_brown(
            image.brown,
            width_px=image.width_px,
            height_px=image.height_px,
            pitch_mm=image.pitch_mm,
            f_number=image.f_number,
            serial=image.serial,
        )
    except ValueError as error:
        raise ImagesError([f"{image.path.name}: {error}"]) from error
    fit[image.sensor] = worst_px
    column, row = image.brown.principal_point_px
    sensor = replace(
        cone.sensors[0],
        serial=image.serial,
        width_px=image.width_px,
        height_px=image.height_px,
        pitch_um=round(image.pitch_mm * 1e3, 6),
        x_mm=((image.width_px - 1) / 2.0 - column) * image.pitch_mm,
        y_mm=(row - (image.height_px - 1) / 2.0) * image.pitch_mm,
        black_dn=image.black / cone.sensors[0].raw_units_per_dn,
    )
    wavelength_nm = image.calibration.wavelength_nm
    known = (wavelength_nm,) if wavelength_nm > 0.0 and len(cone.bands) == 1 else ()
    return replace(cone, lens=lens, sensors=(sensor,), wavelengths_nm=known)


def _write_exposure(
    mission: Path, number: int, capture: Sequence[RedEdgeImage], rig: Rig, rig_sha256: str
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
        software="syntopic import rededge",
    )
    durable.create_file(folder / "exposure.json", [exposure_bytes(exposure)])
    durable.sync_directory(folder)
    return len(frames)


def _frame(image: RedEdgeImage, file: str, sha256: str) -> FrameRecord:
    settings: dict[str, float | int | str] = {
        "Gain": image.gain,
        "BlackLevel": image.black,
        "CaptureId": image.capture_id[:100],
        "Source": image.path.name,
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


def _utc(exif: Mapping[str, Any]) -> datetime | None:
    try:
        seconds_utc = datetime.strptime(
            str(exif["DateTimeOriginal"]).strip("\0 "), "%Y:%m:%d %H:%M:%S"
        )
        part = str(exif.get("SubsecTime", "0")).strip("\0 ")
        # The camera writes a sign where its clock ran before the second.
        microseconds = int(part.lstrip("-")[:6].ljust(6, "0"))
    except (KeyError, ValueError):
        return None
    sign = -1 if part.startswith("-") else 1
    return seconds_utc.replace(tzinfo=UTC) + timedelta(microseconds=sign * microseconds)


def _place(gps: Any) -> dict[str, float]:
    """Position from the camera's receiver, without a standard deviation: not navigation."""
    try:
        latitude = _degrees(gps["GPSLatitude"]) * (-1 if gps["GPSLatitudeRef"] == "S" else 1)
        longitude = _degrees(gps["GPSLongitude"]) * (-1 if gps["GPSLongitudeRef"] == "W" else 1)
        height = _ratio(gps["GPSAltitude"])
    except (KeyError, IndexError, TypeError, ValueError, ZeroDivisionError):
        return {}
    if not all(math.isfinite(value) for value in (latitude, longitude, height)):
        return {}
    return {"GpsLatitudeDeg": latitude, "GpsLongitudeDeg": longitude, "GpsAltitudeM": height}


def _degrees(parts: Sequence[int]) -> float:
    degrees, minutes, seconds = (_ratio(parts[i : i + 2]) for i in (0, 2, 4))
    return degrees + minutes / 60.0 + seconds / 3600.0


def _ratio(value: Sequence[int]) -> float:
    return float(value[0]) / float(value[1])
