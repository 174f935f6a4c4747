"""Grounds that are difficult to stitch, each defined by the reflection of its surface.

Radiances are relative to the white of an ordinary landscape (a bright roof, reflectance about one
half), in the four bands of a scene. Ordinary landscapes are quilted in `scene`; cars are in
`traffic`, clouds in `cloud`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint16]
"""(rows, columns, 4): red, green, blue, near infrared; 48000 is white."""
Field = NDArray[np.float32]
Painter = Callable[[Picture, float, np.random.Generator], Picture]
"""From a landscape of the wanted size, metres per sample and random numbers to the ground."""

UNIT = 48000
TILE_PX = 4096
"""Random fields repeat after so many samples: more than any overlap, less than any memory."""
HEADROOM = 4.0
"""Samples hold 1.3 times white: brighter ground is painted so much darker, and lit more."""


@dataclass(frozen=True)
class GroundType:
    """A kind of ground.

    `light` is the illumination against what the exposure was planned for; `moves` that there is
    traffic; `over_land` that the painter changes a landscape and does not make all of the picture;
    `arranged` that the patches of the photographs are arranged to look like land.
    """

    description: str
    paint: Painter
    light: float = 1.0
    moves: bool = False
    over_land: bool = False
    arranged: bool = False


def _landscape(picture: Picture, sample_m: float, random: np.random.Generator) -> Picture:
    return picture


def _open_water(picture: Picture, sample_m: float, random: np.random.Generator) -> Picture:
    """Two per cent reflectance; wind waves from half a metre to sixty tilt and so tone it."""
    waves = rough(picture.shape[:2], random, exponent=1.0, waves_px=(0.5 / sample_m, 60 / sample_m))
    return _tinted(1.0 + 0.06 * waves, (0.030, 0.045, 0.055, 0.012))


def _calm_water(picture: Picture, sample_m: float, random: np.random.Generator) -> Picture:
    """A lake without wind: swell of tens of metres alone, half a per cent of tone."""
    swell = rough(picture.shape[:2], random, exponent=2.0, waves_px=(15 / sample_m, 90 / sample_m))
    return _tinted(1.0 + 0.005 * swell, (0.030, 0.045, 0.055, 0.012))


def _coast(picture: Picture, sample_m: float, random: np.random.Generator) -> Picture:
    """Land on one side of a winding shore, a calm lake on the other."""
    height, width = picture.shape[:2]
    lake = _calm_water(picture, sample_m, random)
    shore = width * 0.5 + 0.06 * width * rough(
        (height, width), random, exponent=1.5, waves_px=(200, 2000)
    )
    is_water = np.arange(width)[None, :] > shore
    return np.where(is_water[..., None], lake, picture)


def _desert(picture: Picture, sample_m: float, random: np.random.Generator) -> Picture:
    """Dunes tens of metres apart shade each other smoothly; grain of sand is far below a pixel."""
    shape = picture.shape[:2]
    dunes = rough(shape, random, exponent=2.5, waves_px=(2 / sample_m, 80 / sample_m), stretch=3.0)
    return _tinted(0.75 + 0.08 * dunes, (1.10, 0.95, 0.70, 1.20))


def _snow(picture: Picture, sample_m: float, random: np.random.Generator) -> Picture:
    """Fresh snow, exposed for: soft hollows, and wind ripples of a few tenths of a per cent."""
    shape = picture.shape[:2]
    hollows = rough(shape, random, exponent=2.5, waves_px=(8 / sample_m, 90 / sample_m))
    ripples = rough(
        shape, random, exponent=1.0, waves_px=(0.5 / sample_m, 4 / sample_m), stretch=4.0
    )
    return _tinted(0.85 + 0.02 * hollows + 0.003 * ripples, (1.0, 1.0, 1.0, 0.9))


def _night(picture: Picture, sample_m: float, random: np.random.Generator) -> Picture:
    """A full moon gives a few millionths of daylight: black, but for street lamps 40 m apart."""
    night = np.zeros_like(picture)
    height, width = picture.shape[:2]
    spacing = 40 / sample_m
    columns, rows = np.meshgrid(np.arange(spacing, width, spacing), np.arange(3.0, height, spacing))
    for column, row in zip(columns.ravel(), rows.ravel(), strict=True):
        # Lamps stand along one street in three.
        if random.uniform() < 1 / 3:
            c, r = int(column + random.normal(0, 2)), int(row + random.normal(0, 2))
            night[max(r, 0) : r + 2, max(c, 0) : c + 2] = 60000
    return night


def _haze(picture: Picture, sample_m: float, random: np.random.Generator) -> Picture:
    """3 km of visibility: a quarter of the ground's light comes through, the air adds its own."""
    through = np.array([0.25, 0.20, 0.14, 0.40], np.float32)
    air = np.array([0.22, 0.26, 0.32, 0.14], np.float32) * UNIT
    return np.asarray(picture * through + air, np.uint16)


def _roofs(picture: Picture, sample_m: float, random: np.random.Generator) -> Picture:
    """Industrial roofs and glasshouses that mirror the sun: four times white over a fifth."""
    bright = (picture / HEADROOM).astype(np.uint16)
    height, width = picture.shape[:2]
    area, wanted = 0, 0.2 * height * width
    while area < wanted:
        h, w = (int(v) for v in random.uniform(20, 90, 2) / sample_m)
        r, c = int(random.uniform(0, height)), int(random.uniform(0, width))
        # Ridges and gutters every few metres stay as they are.
        roof = bright[r : r + h, c : c + w]
        pitch = max(4, round(4 / sample_m))
        mirrored = (np.arange(roof.shape[0]) % pitch) >= 2
        roof[mirrored] = np.uint16(1.25 * UNIT)
        area += roof.shape[0] * roof.shape[1]
    return bright


def _rows(picture: Picture, sample_m: float, random: np.random.Generator) -> Picture:
    """Vineyards in rows 2 m apart and solar parks, each the same over and over, one per cent true.

    Fields of about 90 m, without anything between them but a change of direction.
    """
    height, width = picture.shape[:2]
    out = np.empty_like(picture)
    own = rough((height, width), random, exponent=0.5, waves_px=(2, 200))
    size = round(90 / sample_m)
    r, c = np.mgrid[0:height, 0:width].astype(np.float32)
    vines = 2.0 / sample_m
    table, module = 5.5 / sample_m, 1.05 / sample_m
    for top in range(0, height, size):
        for left in range(0, width, size):
            part = np.s_[top : top + size, left : left + size]
            kind = random.integers(0, 3)
            if kind < 2:
                along = r[part] if kind else c[part]
                field = 0.35 + 0.2 * np.cos(2 * np.pi * along / vines)
                tint = (0.7, 1.0, 0.5, 1.6)
            else:
                panel = 0.5 + 0.5 * np.sign(np.cos(2 * np.pi * r[part] / table) + 0.2)
                frame = 0.10 * np.cos(2 * np.pi * c[part] / module)
                field = 0.5 - 0.35 * panel + frame * panel
                tint = (0.9, 0.95, 1.1, 0.9)
            out[part] = _tinted(field * (1.0 + 0.01 * own[part]), tint)
    return out


def _motorways(picture: Picture, sample_m: float, random: np.random.Generator) -> Picture:
    """Two motorways of eight lanes along the flight, where the upper and lower sensors overlap."""
    height, width = picture.shape[:2]
    grain = rough((height, width), random, exponent=0.5, waves_px=(2, 60))
    asphalt = _tinted(0.10 + 0.002 * grain, (1.0, 1.0, 1.0, 1.1))
    for middle in motorways_px(width):
        first, last = round(middle - 15 / sample_m), round(middle + 15 / sample_m)
        picture[:, first:last] = asphalt[:, first:last]
        for lane in range(1, 8):
            column = round(middle + (lane - 4) * 3.75 / sample_m)
            dash = (np.arange(height) * sample_m) % 18.0 < 6.0
            picture[dash, column] = (UNIT * np.array([0.6, 0.6, 0.6, 0.6])).astype(np.uint16)
    return picture


def motorways_px(width_px: int) -> tuple[float, float]:
    """Columns of a scene where the motorways' middles are: where left and right sensors meet."""
    sixth = width_px / 1.22 / 6
    return (width_px - 1) / 2 - sixth, (width_px - 1) / 2 + sixth


GROUNDS: Mapping[str, GroundType] = {
    "land": GroundType(
        "open ground and woods from photographs", _landscape, over_land=True, arranged=True
    ),
    "landscape": GroundType(
        "fields, villages and woods from photographs", _landscape, over_land=True
    ),
    "open-water": GroundType("the sea in a breeze", _open_water),
    "calm-water": GroundType("a lake without wind", _calm_water),
    "coast": GroundType("half land, half a lake without wind", _coast, over_land=True),
    "desert": GroundType("dunes", _desert),
    "snow": GroundType("fresh snow, exposed for", _snow),
    "snow-saturated": GroundType("fresh snow, exposed as for fields", _snow, light=2.2),
    "night": GroundType("night, street lamps", _night, light=HEADROOM),
    "dusk": GroundType(
        "a landscape with a hundredth of the light", _landscape, light=0.01, over_land=True
    ),
    "haze": GroundType("a landscape through 3 km visibility", _haze, over_land=True),
    "roofs": GroundType(
        "mirroring roofs over a fifth of the ground", _roofs, light=HEADROOM, over_land=True
    ),
    "rows": GroundType("vineyards and solar parks", _rows),
    "traffic": GroundType(
        "dense traffic along two overlaps", _motorways, moves=True, over_land=True
    ),
}
"""Every kind of ground by name."""


def rough(
    shape: tuple[int, ...],
    random: np.random.Generator,
    *,
    exponent: float,
    waves_px: tuple[float, float],
    stretch: float = 1.0,
) -> Field:
    """A random field of mean zero and standard deviation one, (rows, columns).

    Its amplitudes fall with the frequency to the power of `exponent` between the shortest and the
    longest wave; `stretch` makes features so many times longer along the columns.
    """
    side = (min(TILE_PX, _even(shape[0])), min(TILE_PX, _even(shape[1])))
    spectrum = np.fft.rfft2(random.standard_normal(side, dtype=np.float32))
    f_row, f_column = np.fft.fftfreq(side[0])[:, None], np.fft.rfftfreq(side[1])[None, :]
    f = np.hypot(f_row * stretch, f_column)
    inside = (f >= 1 / waves_px[1]) & (f <= 1 / waves_px[0])
    spectrum *= np.where(inside, 1 / np.maximum(f, 1e-9) ** exponent, 0.0)
    field = np.fft.irfft2(spectrum, s=side).astype(np.float32)
    field /= max(float(field.std()), 1e-12)
    times = (-(-shape[0] // side[0]), -(-shape[1] // side[1]))
    return np.asarray(np.tile(field, times)[: shape[0], : shape[1]])


def _even(length: int) -> int:
    return int(cv2.getOptimalDFTSize(length + length % 2))


def _tinted(field: NDArray[Any], tint: tuple[float, float, float, float]) -> Picture:
    """A picture of one tone in four bands, (rows, columns, 4)."""
    colour = np.array(tint, np.float32) * UNIT
    return np.clip(field[..., None] * colour, 0, 65535).astype(np.uint16)
