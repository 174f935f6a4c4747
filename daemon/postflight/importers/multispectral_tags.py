"""One image file of a multispectral camera: what its tags state about the band and its lens.

Tags are those that makers publish: Pix4D's namespace `Camera` (MicaSense, Parrot, Sentera, with a
perspective or a fisheye lens), and DJI's `drone-dji`. MicaSense's radiometric calibration is read,
others are not.

Source: Pix4D, "Specifications of XMP Camera Tags"; MicaSense, "RedEdge metadata" and "RedEdge
camera radiometric calibration model"; DJI, "P4 Multispectral Image Processing Guide" (2020) and
"Mavic 3M Image Processing Guide" (2023).
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.mission.store.level0 import tiff_errors
from daemon.postflight.importers.xmp import Xmp, XmpError, read_xmp
from drivers.cameras.tiff_layout import layout_problem
from processing.geometry.brown import Brown
from processing.geometry.fisheye import Fisheye
from processing.radiometry.radiance import POWER_MAX, RadianceCalibration

BANDS: Final[Mapping[str, tuple[str, str]]] = {
    "blue": ("B", "blue"),
    "green": ("G", "green"),
    "red": ("R", "red"),
    "nir": ("N", "nir"),
    "red edge": ("E", "red_edge"),
    "rededge": ("E", "red_edge"),
    "near infrared": ("N", "nir"),
    "blue-444": ("B", "blue"),
    "green-531": ("G", "green"),
    "red-650": ("R", "red"),
    "red edge-705": ("E", "red_edge"),
    "red edge-740": ("E2", "red_edge_2"),
}
"""Sensor and band by BandName, in lower case."""
LEFT_OUT: Final = frozenset({"panchro", "pan", "lwir", "thermal", "rgb"})
"""Bands of another size that are not processed: panchromatic, thermal and colour heads."""
_DEWARPED: Final = "1"
"""DewarpFlag of an image from which DJI removed the distortion."""
MICASENSE: Final = "MicaSense"
_MAX_FILE_BYTES: Final = 100_000_000
_XMP, _EXIF, _GPS, _BLACK_LEVEL, _MAKE, _MODEL = 700, 34665, 34853, 50714, 271, 272
_PER_MM: Final = {2: 1.0 / 25.4, 3: 0.1, 4: 1.0, 5: 1000.0}
"""Pixels per mm of a focal plane resolution of one, by its unit."""
_F_IN_MM_BELOW: Final = 100.0
"""A focal length without a unit is in mm, as Pix4D specifies; older RedEdge wrote pixels."""
_SAME_SCALE: Final = 0.01
_CAPTURE: Final = ("CaptureId", "CaptureUUID", "ImageUniqueID")
"""Names of a capture: of MicaSense, of DJI and Parrot, of Sentera."""
_COLONS_IN_DATE: Final = re.compile(r"^(\d{4}):(\d\d):(\d\d)")
_SUN: Final = (
    *("Irradiance", "IrradianceList", "DirectIrradiance", "HorizontalIrradiance"),
    *("SpectralIrradiance", "SunSensor", "SunSensorExposureTime"),
)
_RESPONSE: Final = (
    *("SensorModel", "SensorGain", "SensorGainAdjustment", "BandSensitivity"),
    *("VignettingData", "VignettingPolynomial", "VignettingPolynomial2D"),
)
"""Tags of the sun sensor, and of the response of cameras other than MicaSense's."""
_F_SHARE: Final = (0.2, 50.0)
"""Focal lengths that are possible, in longer sides of the image."""


class ImagesError(DaemonError):
    """Images that make no mission; `problems` holds one message for each mistake found."""

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(problems))


class BandLeftOutError(ImagesError):
    """An image of a band that is not processed; the only problem names it."""


@dataclass(frozen=True)
class BandImage:
    """One head's image file: what its tags state.

    `lens` and `calibration` are the head's; the rest is of this exposure. `black` is in words of
    16 bits, None where the file does not state it. `taken` is the camera's own clock, `utc` the
    same in UTC where this is known. `capture_id` is empty where the file has none. `ones` has each
    bit that is set in any word. `unused` are radiometric tags that the file has and nothing uses.
    """

    path: Path
    camera: str
    capture_id: str
    sensor: str
    band: str
    serial: str
    width_px: int
    height_px: int
    pitch_mm: float
    lens: Brown | Fisheye
    calibration: RadianceCalibration | None
    wavelength_nm: float
    f_number: float
    exposure_time_s: float
    gain: float
    black: float | None
    taken: datetime | None
    utc: datetime | None
    place: Mapping[str, float]
    ones: int
    unused: tuple[str, ...] = ()


def read_image(path: Path) -> tuple[BandImage, NDArray[np.uint16]]:
    """One image file: its tags and its words, (h, w).

    Raises:
        BandLeftOutError: of a band that is not processed.
        ImagesError: damaged, or without what is needed; every missing tag is named.
    """
    from tifffile import TiffFile

    try:
        if path.stat().st_size > _MAX_FILE_BYTES:
            raise ImagesError([f"{path.name}: larger than {_MAX_FILE_BYTES} bytes; no image"])
        with TiffFile(path) as tiff:
            if problem := layout_problem(tiff):
                raise ImagesError([f"{path.name}: {problem}"])
            page = tiff.pages[0]
            wanted = (_XMP, _EXIF, _GPS, _BLACK_LEVEL, _MAKE, _MODEL)
            tags = {code: page.tags[code].value for code in wanted if code in page.tags}
            xmp = _packet(path, tags)
            _refuse_left_out(xmp)
            if page.dtype != np.uint16 or len(page.shape) != 2:
                raise ImagesError([f"{path.name}: is no plane of 16-bit words"])
            shape = (int(page.shape[0]), int(page.shape[1]))
            # Uncompressed, as the camera writes: a file cannot ask for more memory than it has.
            if page.compression != 1 or 2 * shape[0] * shape[1] > path.stat().st_size:
                raise ImagesError([f"{path.name}: is compressed or ends early; give the original"])
            pixels: NDArray[np.uint16] = np.ascontiguousarray(page.asarray())
        if pixels.shape != shape:
            raise ImagesError([f"{path.name}: its pixels end early"])
        return _image(path, tags, xmp, pixels), pixels
    except (ImagesError, OSError):
        raise
    except XmpError as error:
        raise ImagesError([str(error)]) from error
    except tiff_errors() as error:
        sentence = f"{path.name}: not a usable image ({type(error).__name__}: {error})"
        raise ImagesError([sentence]) from error


def _packet(path: Path, tags: Mapping[int, Any]) -> Xmp:
    for code, name in ((_XMP, "XMP"), (_EXIF, "EXIF")):
        if code not in tags:
            raise ImagesError(
                [f"{path.name}: {_camera(tags)}: has no {name}; give images as the camera wrote"]
            )
    packet = tags[_XMP]
    if isinstance(packet, str):
        packet = packet.encode("utf-8")
    if not isinstance(packet, bytes) or not isinstance(tags[_EXIF], dict):
        raise ImagesError([f"{path.name}: XMP or EXIF is of an unknown kind"])
    return read_xmp(packet, path.name)


def _camera(tags: Mapping[int, Any]) -> str:
    made = [str(tags.get(code, "")).strip("\0 ") for code in (_MAKE, _MODEL)]
    return " ".join(made).strip()[:80] or "unknown camera"


def _refuse_left_out(xmp: Xmp) -> None:
    names = [name.strip() for name in xmp.texts("BandName")]
    if len(names) > 1 or (names and names[0].lower() in LEFT_OUT):
        raise BandLeftOutError([f"band {' '.join(names)[:40]} is not processed"])


def _image(path: Path, tags: Mapping[int, Any], xmp: Xmp, pixels: NDArray[np.uint16]) -> BandImage:
    exif, camera = tags[_EXIF], _camera(tags)
    is_micasense = str(tags.get(_MAKE, "")).strip("\0 ") == MICASENSE
    if missing := _missing(tags, xmp, exif, is_micasense=is_micasense):
        raise ImagesError([f"{path.name}: {camera}: has no {', no '.join(missing)}"])
    label = xmp.text("BandName").strip().lower()
    if label not in BANDS:
        raise ImagesError([f"{path.name}: band {label[:40]!r}; known are {', '.join(BANDS)}"])
    sensor, band = BANDS[label]
    height_px, width_px = pixels.shape
    pitch_mm = _pitch_mm(path, xmp, exif)
    wavelength_nm = _leading_number(xmp, "CentralWavelength")
    taken = _taken(exif)
    lens = _lens(xmp, 1.0 / pitch_mm)
    _check_lens(path, lens, (width_px, height_px))
    time_s, gain = _ratio(exif["ExposureTime"]), _gain(exif)
    if not (0.0 < time_s < 10.0 and 0.0 < gain < 1000.0):
        raise ImagesError([f"{path.name}: exposure time {time_s:g} s at gain {gain:g}; no image"])
    return BandImage(
        path=path,
        camera=camera,
        capture_id=next((xmp.text(k) for k in _CAPTURE if k in xmp), ""),
        sensor=sensor,
        band=band,
        serial=_serial(xmp, exif),
        width_px=width_px,
        height_px=height_px,
        pitch_mm=pitch_mm,
        lens=lens,
        calibration=_calibration(xmp, wavelength_nm) if is_micasense else None,
        wavelength_nm=wavelength_nm,
        f_number=_ratio(exif["FNumber"]) if "FNumber" in exif else 5.6,
        exposure_time_s=time_s,
        gain=gain,
        black=_black(path, tags, xmp),
        taken=taken,
        utc=_utc(xmp, exif, taken, is_micasense=is_micasense),
        place=_place(tags.get(_GPS, {})),
        ones=int(np.bitwise_or.reduce(pixels, axis=None)),
        unused=tuple(key for key in (*_SUN, *(() if is_micasense else _RESPONSE)) if key in xmp),
    )


def _missing(
    tags: Mapping[int, Any], xmp: Xmp, exif: Mapping[str, Any], *, is_micasense: bool
) -> list[str]:
    """Names of the tags without which an image is not read."""
    missing = [] if "BandName" in xmp else ["BandName in XMP"]
    model = xmp.text("ModelType") if "ModelType" in xmp else ""
    needed: tuple[str, ...]
    if model == "fisheye":
        needed = ("PrincipalPoint", "FisheyePolynomial", "FisheyeAffineMatrix")
    elif model == "perspective":
        needed = ("PrincipalPoint", "PerspectiveFocalLength", "PerspectiveDistortion")
    elif model:
        needed = ()
        missing.append(f"lens that is known: ModelType is {model[:40]!r}, perspective or fisheye")
    elif "DewarpData" in xmp:
        needed = ("CalibratedOpticalCenterX", "CalibratedOpticalCenterY")
    else:
        needed = ()
        missing.append("lens: ModelType with its parameters, or DewarpData in XMP")
    if is_micasense:
        needed += ("RadiometricCalibration",)
        if "VignettingPolynomial" in xmp or "VignettingPolynomial2D" not in xmp:
            needed += ("VignettingCenter", "VignettingPolynomial")
        else:
            needed += ("VignettingPolynomial2DName",)
        needed += ("CentralWavelength", "WavelengthFWHM")
    missing += [f"{key} in XMP" for key in needed if key not in xmp]
    if "ExposureTime" not in exif:
        missing.append("ExposureTime in EXIF")
    if is_micasense and _BLACK_LEVEL not in tags:
        missing.append("BlackLevel")
    if "FocalPlaneXResolution" not in exif and not (
        "FocalLength" in exif and ("DewarpData" in xmp or model == "fisheye")
    ):
        missing.append("FocalPlaneXResolution in EXIF")
    return missing


def _pitch_mm(path: Path, xmp: Xmp, exif: Mapping[str, Any]) -> float:
    """From the focal plane's resolution, else from focal lengths in mm and in pixels."""
    if "FocalPlaneXResolution" in exif:
        unit = _PER_MM.get(int(exif.get("FocalPlaneResolutionUnit", 2)), 0.0)
        per_mm = _ratio(exif["FocalPlaneXResolution"]) * unit
    elif "DewarpData" in xmp:
        per_mm = _dewarp(xmp)[0] / _ratio(exif["FocalLength"])
    else:
        polynomial, affine = xmp.numbers("FisheyePolynomial"), xmp.numbers("FisheyeAffineMatrix", 4)
        lens = Fisheye((0.0, 0.0), polynomial, (affine[0], affine[1], affine[2], affine[3]))
        per_mm = lens.f_px / _ratio(exif["FocalLength"])
    if not 10.0 < per_mm < 10_000.0:
        raise ImagesError([f"{path.name}: focal plane resolution is not in pixels per mm"])
    return 1.0 / per_mm


def _lens(xmp: Xmp, per_mm: float) -> Brown | Fisheye:
    if "ModelType" not in xmp:
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = _dewarp(xmp)
        if abs(fx / fy - 1.0) > _SAME_SCALE:
            raise ValueError(f"focal lengths of {fx:g} and {fy:g} px")
        if "DewarpFlag" in xmp and xmp.text("DewarpFlag").strip() == _DEWARPED:
            k1 = k2 = k3 = p1 = p2 = 0.0
        middle = (xmp.number("CalibratedOpticalCenterX"), xmp.number("CalibratedOpticalCenterY"))
        return Brown(math.sqrt(fx * fy), (middle[0] + cx, middle[1] + cy), k1, k2, k3, p1, p2)
    x_mm, y_mm = xmp.numbers("PrincipalPoint", 2)
    place = (x_mm * per_mm, y_mm * per_mm)
    if xmp.text("ModelType") == "fisheye":
        c, d, e, f = xmp.numbers("FisheyeAffineMatrix", 4)
        return Fisheye(place, xmp.numbers("FisheyePolynomial"), (c, d, e, f))
    k1, k2, k3, p1, p2 = xmp.numbers("PerspectiveDistortion", 5)
    focal = xmp.number("PerspectiveFocalLength")
    units = "PerspectiveFocalLengthUnits"
    if focal < _F_IN_MM_BELOW or (units in xmp and xmp.text(units) == "mm"):
        focal *= per_mm
    if not 100.0 < focal < 100_000.0:
        raise ValueError(f"focal length of {focal:g} px")
    return Brown(focal, place, k1, k2, k3, p1, p2)


def _check_lens(path: Path, lens: Brown | Fisheye, size_px: tuple[int, int]) -> None:
    """Refuse a lens in other units: of no image, or with its axis outside of the image."""
    share = lens.f_px / max(size_px)
    inside = all(0.0 < at < side for at, side in zip(lens.principal_point_px, size_px, strict=True))
    if not (_F_SHARE[0] < share < _F_SHARE[1] and inside):
        column, row = lens.principal_point_px
        raise ImagesError(
            [
                f"{path.name}: focal length of {lens.f_px:.0f} px and principal point at "
                f"({column:.0f}, {row:.0f}) px for {size_px[0]} x {size_px[1]} px; its tags are in "
                "units that are not known"
            ]
        )


def _dewarp(xmp: Xmp) -> tuple[float, ...]:
    """fx, fy, cx, cy, k1, k2, p1, p2, k3 in pixels, behind the date of the calibration."""
    text = xmp.text("DewarpData")
    values = [float(word) for word in text.rpartition(";")[2].split(",")]
    if len(values) != 9 or not all(map(math.isfinite, values)) or min(values[:2]) <= 0.0:
        raise ValueError(f"DewarpData of {len(values)} numbers; 9 are right")
    return tuple(values)


def _calibration(xmp: Xmp, wavelength_nm: float) -> RadianceCalibration:
    a1, a2, a3 = xmp.numbers("RadiometricCalibration", 3)
    centre: tuple[float, ...] = (0.0, 0.0)
    powers: tuple[tuple[int, int], ...] = ()
    if "VignettingPolynomial" in xmp:
        centre, vignetting = (
            xmp.numbers("VignettingCenter", 2),
            xmp.numbers("VignettingPolynomial", 6),
        )
    else:
        # RedEdge-P and Altum-PT: pairs of powers of column and row, then their coefficients.
        name = "VignettingPolynomial2DName"
        values = xmp.numbers(name, len(xmp.texts(name, split=True)))
        if len(values) % 2 or any(v % 1.0 or not 0.0 <= v <= POWER_MAX for v in values):
            raise ValueError(f"{name}: pairs of powers from 0 to {POWER_MAX} are right")
        powers = tuple((int(p), int(q)) for p, q in zip(values[::2], values[1::2], strict=True))
        vignetting = xmp.numbers("VignettingPolynomial2D", len(powers))
    return RadianceCalibration(
        a1=a1,
        a2=a2,
        a3=a3,
        vignetting_centre_px=(centre[0], centre[1]),
        vignetting=vignetting,
        vignetting_powers=powers,
        wavelength_nm=wavelength_nm,
        bandwidth_nm=_leading_number(xmp, "WavelengthFWHM"),
    )


def _leading_number(xmp: Xmp, key: str) -> float:
    """The number that a text begins with, such as 560 of `560(+/-16)nm`; 0 where it has none."""
    found = re.match(r"\s*(\d+(?:\.\d*)?)", xmp.text(key)) if key in xmp else None
    return float(found[1]) if found else 0.0


def _gain(exif: Mapping[str, Any]) -> float:
    for key in ("ISOSpeed", "ISOSpeedRatings", "PhotographicSensitivity"):
        if key in exif:
            value = exif[key]
            return float(value[0] if isinstance(value, Sequence) else value) / 100.0
    return 1.0


def _serial(xmp: Xmp, exif: Mapping[str, Any]) -> str:
    if "BodySerialNumber" in exif:
        return str(exif["BodySerialNumber"]).strip("\0 ")[:40]
    for key in ("SerialNumber", "CameraSerialNumber", "DroneSerialNumber"):
        if key in xmp:
            return xmp.text(key)[:40]
    return "unknown"


def _black(path: Path, tags: Mapping[int, Any], xmp: Xmp) -> float | None:
    """BlackLevel of the image, else BlackCurrent of DJI's XMP."""
    if _BLACK_LEVEL not in tags:
        if "BlackCurrent" not in xmp:
            return None
        tags = {_BLACK_LEVEL: xmp.number("BlackCurrent")}
    black = np.atleast_1d(tags[_BLACK_LEVEL]).astype(np.float64)
    if not (black.size and black.min() >= 0.0 and black.max() < 65536.0):
        raise ImagesError([f"{path.name}: BlackLevel or BlackCurrent is no word of 16 bits"])
    return float(black.mean())


def _utc(
    xmp: Xmp, exif: Mapping[str, Any], taken: datetime | None, *, is_micasense: bool
) -> datetime | None:
    """UTC of the exposure: of DJI's tag, by EXIF's offset, or the clock that MicaSense keeps in it.

    Other makers write local time: without an offset, UTC is not known.
    """
    try:
        if "UTCAtExposure" in xmp:
            text = xmp.text("UTCAtExposure").strip()
            stated = datetime.fromisoformat(_COLONS_IN_DATE.sub(r"\1-\2-\3", text))
            return stated.replace(tzinfo=UTC) if stated.tzinfo is None else stated.astimezone(UTC)
        offset = str(exif.get("OffsetTimeOriginal", exif.get("OffsetTime", ""))).strip("\0 ")
        if taken is not None and offset:
            zone = datetime.strptime(offset.replace("Z", "+00:00"), "%z").tzinfo
            return taken.replace(tzinfo=zone).astimezone(UTC)
    except (ValueError, OverflowError):
        return None
    return taken if is_micasense else None


def _taken(exif: Mapping[str, Any]) -> datetime | None:
    """The camera's clock, whichever zone it is in."""
    try:
        seconds_utc = datetime.strptime(
            str(exif["DateTimeOriginal"]).strip("\0 "), "%Y:%m:%d %H:%M:%S"
        )
        part = exif.get("SubsecTimeOriginal", exif.get("SubsecTime", "0"))
        part = str(part).strip("\0 ")
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
        below = np.atleast_1d(gps.get("GPSAltitudeRef", 0))[0]
        height = -height if below in (1, 3, b"\x01", b"\x03") else height
    except (KeyError, IndexError, TypeError, ValueError, ZeroDivisionError):
        return {}
    if not all(math.isfinite(value) for value in (latitude, longitude, height)):
        return {}
    return {"GpsLatitudeDeg": latitude, "GpsLongitudeDeg": longitude, "GpsAltitudeM": height}


def _degrees(parts: Sequence[int]) -> float:
    degrees, minutes, seconds = (_ratio(parts[i : i + 2]) for i in (0, 2, 4))
    return degrees + minutes / 60.0 + seconds / 3600.0


def _ratio(value: Any) -> float:
    if isinstance(value, Sequence):
        return float(value[0]) / float(value[1])
    return float(value)
