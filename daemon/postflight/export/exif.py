"""EXIF and XMP of an exported picture: when, where, which camera, how it looked.

Written by ourselves (a JPEG's two APP1 segments), because what would write them is not needed
otherwise. Source: CIPA DC-008 (EXIF 2.32); Adobe XMP specification, part 3.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from fractions import Fraction

from daemon.postflight.export.xmp_packet import xmp_bytes
from drivers.timescales.leap_seconds import leap_seconds_at

_GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
_ASCII, _SHORT, _LONG, _RATIONAL, _BYTE, _UNDEFINED = 2, 3, 4, 5, 1, 7
_SIZE = {_ASCII: 1, _SHORT: 2, _LONG: 4, _RATIONAL: 8, _BYTE: 1, _UNDEFINED: 1}
_MAX_SEGMENT_NBYTES = 65_533
EXIF_IFD, GPS_IFD = 0x8769, 0x8825
"""Tags of the pointers to the directories of EXIF and of the position."""

Value = bytes | int | tuple[Fraction, ...]
Entries = list[tuple[int, int, Value]]
"""Tag, type and value."""


FULL_FRAME_DIAGONAL_MM = 43.266615
"""Of 36 x 24 mm, which EXIF's equivalent focal length refers to."""


@dataclass(frozen=True)
class RigPlace:
    """Place of a picture's head in its rig: index, that of the reference head, and its rotation.

    `relatives_deg` are the angles about x, y, z of R = Rx Ry Rz, reference from head, in axes of
    computer vision (x right, y down, z forward); `capture` is the same for all heads of one
    exposure.
    """

    name: str
    index: int
    reference: int
    relatives_deg: tuple[float, float, float]
    capture: str


@dataclass(frozen=True)
class PictureMetadata:
    """Metadata of a picture.

    `height_m` is above the ellipsoid (EXIF 2.32 knows no such reference: `remark` states it);
    sigmas are None where they are not known, `serial` is the rig's, `lens_serial` of one lens,
    `wavelengths_nm` are those of `bands` or empty; `principal_point_px` is None where the image
    is perspective, and the point in its middle; angles are of the image's camera against the
    local level (yaw from true north) and omega, phi, kappa against the grid `crs`.
    """

    camera: str
    serial: str
    name: str
    gps_ns: int
    latitude_deg: float
    longitude_deg: float
    height_m: float
    position_sigma_m: float | None
    f_mm: float
    pixel_um: float
    exposure_time_s: float | None
    yaw_pitch_roll_deg: tuple[float, float, float]
    omega_phi_kappa_deg: tuple[float, float, float]
    centre_m: tuple[float, float, float]
    crs: str
    remark: str
    width_px: int = 0
    height_px: int = 0
    f_number: float | None = None
    height_sigma_m: float | None = None
    roll_pitch_yaw_sigma_deg: tuple[float, float, float] | None = None
    bands: tuple[str, ...] = ()
    wavelengths_nm: tuple[float, ...] = ()
    rig: RigPlace | None = None
    lens_serial: str = ""
    is_perspective: bool = True
    principal_point_px: tuple[float, float] | None = None

    @property
    def utc_text(self) -> str:
        """UTC to the second, as EXIF writes it."""
        return f"{utc_of(self.gps_ns)[0]:%Y:%m:%d %H:%M:%S}"


def utc_of(gps_ns: int) -> tuple[datetime, int]:
    """UTC of a GPS instant, whole seconds, and the nanoseconds beyond."""
    leap_s = leap_seconds_at(gps_ns)
    leap_s = leap_seconds_at(gps_ns - leap_s * 1_000_000_000)
    seconds, remainder = divmod(gps_ns, 1_000_000_000)
    return _GPS_EPOCH + timedelta(seconds=seconds - leap_s), remainder


def exif_bytes(shot: PictureMetadata) -> bytes:
    """The TIFF structure of an Exif segment, little-endian."""
    return _tiff(*exif_entries(shot))


def exif_entries(shot: PictureMetadata) -> tuple[Entries, Entries, Entries]:
    """Entries of the main directory, of that of EXIF, and of that of the position."""
    instant, beyond_ns = utc_of(shot.gps_ns)
    stamp = _text(shot.utc_text)
    decimals = _text(f"{beyond_ns // 1000:06d}")
    per_cm = _rational(10.0 / (shot.pixel_um * 1e-3))
    main: Entries = [
        (0x010E, _ASCII, _text(shot.remark)),
        (0x010F, _ASCII, _text("Syntopic")),
        (0x0110, _ASCII, _text(shot.camera)),
        (0x0131, _ASCII, _text("Syntopic")),
        (0x0132, _ASCII, stamp),
    ]
    detail: Entries = [
        (0x9000, _UNDEFINED, b"0232"),
        (0x9101, _UNDEFINED, bytes([1, 2, 3, 0])),
        (0x9003, _ASCII, stamp),
        (0x9011, _ASCII, _text("+00:00")),
        (0x920A, _RATIONAL, (_rational(shot.f_mm),)),
        (0x9291, _ASCII, decimals),
        (0xA20E, _RATIONAL, (per_cm,)),
        (0xA20F, _RATIONAL, (per_cm,)),
        (0xA210, _SHORT, 3),
        (0xA420, _ASCII, _text(shot.name)),
    ]
    if shot.exposure_time_s:
        detail.append(
            (0x829A, _RATIONAL, (_rational(shot.exposure_time_s, max_denominator=1_000_000),))
        )
    if shot.f_number is not None:
        detail.append((0x829D, _RATIONAL, (_rational(shot.f_number),)))
    if shot.width_px and shot.height_px:
        diagonal_mm = math.hypot(shot.width_px, shot.height_px) * shot.pixel_um * 1e-3
        equivalent_mm = round(shot.f_mm * FULL_FRAME_DIAGONAL_MM / diagonal_mm)
        # A tag of 16 bits, and 0 means that it is not known.
        if 0 < equivalent_mm < 65_536:
            detail.append((0xA405, _SHORT, equivalent_mm))
    if shot.lens_serial:
        detail.append((0xA435, _ASCII, _text(shot.lens_serial)))
    if shot.serial:
        detail.append((0xA431, _ASCII, _text(shot.serial)))
    second = Fraction(instant.second * 1_000_000 + beyond_ns // 1000, 1_000_000)
    gps: Entries = [
        (0x0000, _BYTE, bytes([2, 3, 0, 0])),
        (0x0001, _ASCII, _text("N" if shot.latitude_deg >= 0 else "S")),
        (0x0002, _RATIONAL, _sexagesimal(shot.latitude_deg)),
        (0x0003, _ASCII, _text("E" if shot.longitude_deg >= 0 else "W")),
        (0x0004, _RATIONAL, _sexagesimal(shot.longitude_deg)),
        (0x0005, _BYTE, bytes([0 if shot.height_m >= 0 else 1])),
        (0x0006, _RATIONAL, (_rational(abs(shot.height_m)),)),
        (0x0007, _RATIONAL, (Fraction(instant.hour), Fraction(instant.minute), second)),
        (0x0010, _ASCII, _text("T")),
        (0x0011, _RATIONAL, (_rational(shot.yaw_pitch_roll_deg[0] % 360.0),)),
        (0x0012, _ASCII, _text("WGS-84")),
        (0x001D, _ASCII, _text(instant.strftime("%Y:%m:%d"))),
    ]
    if shot.position_sigma_m is not None:
        gps.append((0x001F, _RATIONAL, (_rational(shot.position_sigma_m),)))
    return main, detail, gps


def with_metadata(jpeg: bytes, shot: PictureMetadata) -> bytes:
    """A JPEG with Exif and XMP behind its first marker.

    Raises:
        ValueError: no JPEG, or a text too long for a segment.
    """
    if jpeg[:2] != b"\xff\xd8":
        raise ValueError("not a JPEG: it begins with FF D8")
    segments = b""
    for head, body in (
        (b"Exif\0\0", exif_bytes(shot)),
        (b"http://ns.adobe.com/xap/1.0/\0", xmp_bytes(shot)),
    ):
        if len(head) + len(body) > _MAX_SEGMENT_NBYTES:
            raise ValueError(f"{len(body)} bytes of metadata; a JPEG segment holds 64 KiB")
        segments += b"\xff\xe1" + struct.pack(">H", len(head) + len(body) + 2) + head + body
    return jpeg[:2] + segments + jpeg[2:]


def _tiff(
    main: Sequence[tuple[int, int, Value]],
    detail: Sequence[tuple[int, int, Value]],
    gps: Sequence[tuple[int, int, Value]],
) -> bytes:
    """Header and three directories, one behind the other."""
    at = 8 + _length([*main, (EXIF_IFD, _LONG, 0), (GPS_IFD, _LONG, 0)])
    second = at + _length(detail)
    first = directory_bytes([*main, (EXIF_IFD, _LONG, at), (GPS_IFD, _LONG, second)], 8)
    return (
        struct.pack("<2sHI", b"II", 42, 8)
        + first
        + directory_bytes(detail, at)
        + directory_bytes(gps, second)
    )


def directory_bytes(entries: Sequence[tuple[int, int, Value]], offset: int) -> bytes:
    """One IFD at an offset with its values behind it, by tag as the standard requires."""
    ordered = sorted(entries, key=lambda entry: entry[0])
    beyond = offset + 2 + 12 * len(ordered) + 4
    table, data = struct.pack("<H", len(ordered)), b""
    for tag, kind, value in ordered:
        raw = _raw(kind, value)
        count = len(raw) // _SIZE[kind]
        if len(raw) <= 4:
            place = raw.ljust(4, b"\0")
        else:
            place = struct.pack("<I", beyond + len(data))
            data += raw + b"\0" * (len(raw) % 2)
        table += struct.pack("<HHI", tag, kind, count) + place
    return table + struct.pack("<I", 0) + data


def _length(entries: Sequence[tuple[int, int, Value]]) -> int:
    return len(directory_bytes(entries, 0))


def _raw(kind: int, value: Value) -> bytes:
    if isinstance(value, bytes):
        return value
    if isinstance(value, int):
        return struct.pack("<H" if kind == _SHORT else "<I", value)
    return b"".join(struct.pack("<II", v.numerator, v.denominator) for v in value)


def _text(value: str) -> bytes:
    return value.encode("ascii", "replace") + b"\0"


def _rational(value: float, *, max_denominator: int = 100_000) -> Fraction:
    return Fraction(value).limit_denominator(max_denominator)


def _sexagesimal(degrees: float) -> tuple[Fraction, ...]:
    """Degrees, minutes, seconds to 1e-6 of a second (30 um)."""
    total = round(abs(degrees) * 3600 * 1_000_000)
    whole_degrees, remainder = divmod(total, 3600 * 1_000_000)
    minutes, seconds = divmod(remainder, 60 * 1_000_000)
    return Fraction(whole_degrees), Fraction(minutes), Fraction(seconds, 1_000_000)


def metadata_texts(shot: PictureMetadata) -> Mapping[str, str]:
    """The same as plain texts, for formats that have neither."""
    instant, beyond_ns = utc_of(shot.gps_ns)
    omega, phi, kappa = shot.omega_phi_kappa_deg
    return {
        "CAMERA": shot.camera,
        "IMAGE": shot.name,
        "UTC": f"{instant:%Y-%m-%dT%H:%M:%S}.{beyond_ns // 1000:06d}Z",
        "GPS_NS": str(shot.gps_ns),
        "CRS": shot.crs,
        "PROJECTION_CENTRE_M": " ".join(f"{v:.4f}" for v in shot.centre_m),
        "OMEGA_PHI_KAPPA_DEG": f"{omega:.7f} {phi:.7f} {kappa:.7f}",
        "PRINCIPAL_DISTANCE_MM": f"{shot.f_mm:.6f}",
        "PIXEL_UM": f"{shot.pixel_um:.6f}",
        "REMARK": shot.remark,
    }
