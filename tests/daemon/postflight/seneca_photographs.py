"""Photographs of the block seneca, reduced, with the EXIF of their originals.

EXIF is copied, so that its pixel size is that of the larger original.
"""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

SENECA = Path(__file__).parents[4] / "shared" / "data" / "aerial" / "seneca"
USED = (491, 492, 493, 495, 504, 505, 507)
WIDTH = 900
needs_seneca = pytest.mark.skipif(
    not SENECA.is_dir(), reason="needs the photographs in ../shared/data/aerial"
)


def exif_segment(path: Path) -> bytes:
    data = path.read_bytes()
    at = data.index(b"Exif\0\0") - 4
    (length,) = struct.unpack_from(">H", data, at + 2)
    return data[at : at + 2 + length]


def reduced(number: int, folder: Path, *, name: str = "", pixels: np.ndarray | None = None) -> Path:
    original = SENECA / f"IMG_{number:04d}.jpg"
    if pixels is None:
        whole = cv2.imread(str(original))
        pixels = cv2.resize(whole, (WIDTH, WIDTH * 3 // 4), interpolation=cv2.INTER_AREA)
    jpeg = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    path = folder / (name or original.name)
    path.write_bytes(jpeg[:2] + exif_segment(original) + jpeg[2:])
    return path
