"""Images of multispectral cameras, written here after the tags that their makers publish."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

KINDS = {"byte": 1, "ascii": 2, "short": 3, "long": 4, "rational": 5}


def entry(code: int, kind: str, value) -> tuple[int, int, int, bytes]:
    if kind == "ascii":
        raw = value.encode() + b"\0"
        return code, 2, len(raw), raw
    if kind == "byte":
        return code, 1, len(value), bytes(value)
    if kind == "rational":
        return code, 5, 1, struct.pack("<II", round(value * 1_000_000), 1_000_000)
    values = value if isinstance(value, tuple) else (value,)
    letter = {"short": "H", "long": "I"}[kind]
    return code, KINDS[kind], len(values), struct.pack(f"<{len(values)}{letter}", *values)


def directory(entries, at: int) -> bytes:
    """An image file directory that lies at `at`, its long values behind it (TIFF 6.0)."""
    entries = sorted(entries)
    head, tail = struct.pack("<H", len(entries)), b""
    behind = at + 2 + 12 * len(entries) + 4
    for code, kind, count, raw in entries:
        head += struct.pack("<HHI", code, kind, count)
        if len(raw) <= 4:
            head += raw.ljust(4, b"\0")
        else:
            head += struct.pack("<I", behind + len(tail))
            tail += raw + b"\0" * (len(raw) % 2)
    return head + struct.pack("<I", 0) + tail


def xmp(values: dict[str, str], *, as_attributes: bool = False) -> bytes:
    """A packet; DJI writes attributes, the others elements."""
    attributes = "".join(f' c:{k}="{v}"' for k, v in values.items()) if as_attributes else ""
    elements = "" if as_attributes else "".join(f"<c:{k}>{v}</c:{k}>" for k, v in values.items())
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><r:RDF '
        'xmlns:r="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<r:Description xmlns:c="http://pix4d.com/camera/1.0"{attributes}>{elements}'
        "</r:Description></r:RDF></x:xmpmeta>"
    ).encode()


def write_image(
    path: Path,
    pixels: np.ndarray,
    packet: bytes,
    *,
    make: str,
    model: str,
    serial: str | None = None,
    black: int | None = None,
    taken: str = "2024:05:06 07:08:09",
    subsec: str | None = "25",
    focal_mm: float | None = 5.5,
    per_mm: float | None = None,
    iso: int = 100,
    time_s: float | None = 0.002,
    gps: tuple[float, float, float] | None = None,
    offset: str | None = None,
) -> None:
    height, width = pixels.shape[:2]
    planes = 1 if pixels.ndim == 2 else pixels.shape[2]
    exif = [entry(36867, "ascii", taken)] if taken else []
    for code, kind, value in (
        (33434, "rational", time_s), (33437, "rational", 2.2), (34855, "short", iso),
        (37386, "rational", focal_mm), (41486, "rational", per_mm),
        (41488, "short", 4 if per_mm else None), (37520, "ascii", subsec),
        (42033, "ascii", serial), (36881, "ascii", offset),
    ):  # fmt: skip
        if value is not None:
            exif.append(entry(code, kind, value))
    image = [
        entry(256, "long", width), entry(257, "long", height), entry(258, "short", (16,) * planes),
        entry(259, "short", 1), entry(262, "short", 1 if planes == 1 else 2),
        entry(271, "ascii", make),
        entry(272, "ascii", model), entry(277, "short", planes), entry(278, "long", height),
        entry(279, "long", pixels.nbytes),
    ]  # fmt: skip
    if packet:
        image.append(entry(700, "byte", packet))
    if black is not None:
        image.append(entry(50714, "short", black))
    start = 8 + pixels.nbytes
    links = [entry(34665, "long", 0), *([entry(34853, "long", 0)] if gps else [])]
    exif_at = even(start + len(directory([*image, entry(273, "long", 8), *links], 0)))
    gps_at = even(exif_at + len(directory(exif, exif_at)))
    links = [entry(34665, "long", exif_at), *([entry(34853, "long", gps_at)] if gps else [])]
    first = directory([*image, entry(273, "long", 8), *links], start)
    body = struct.pack("<2sHI", b"II", 42, start) + pixels.astype("<u2").tobytes() + first
    body = body.ljust(exif_at, b"\0") + directory(exif, exif_at)
    if gps:
        body = body.ljust(gps_at, b"\0") + directory(position(*gps), gps_at)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(body)


def even(place: int) -> int:
    return place + place % 2


def position(latitude_deg: float, longitude_deg: float, height_m: float) -> list:
    """Entries of GPS north and east: degrees, minutes, seconds (EXIF 2.32, 4.6.6)."""
    found = [entry(1, "ascii", "N"), entry(3, "ascii", "E"), entry(5, "byte", b"\0")]
    for code, value in ((2, latitude_deg), (4, longitude_deg)):
        whole, minutes = int(value), int((value % 1) * 60.0)
        seconds = round((value - whole - minutes / 60.0) * 3600.0 * 1e6)
        raw = struct.pack("<6I", whole, 1, minutes, 1, seconds, 1_000_000)
        found.append((code, 5, 3, raw))
    found.append(entry(6, "rational", height_m))
    return found
