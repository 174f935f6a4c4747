"""Level-3 after landing: pansharpened images in 16 and 8 bits, one tone curve for the mission.

Reads Level-2, writes `L3/`. The mathematics is in `processing.image.pansharpening` and
`processing.radiometry.tone_curve`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.mission.canonical_json import canonical_bytes, sha256_hex
from daemon.mission.exposure import Exposure
from daemon.mission.exposure_batch import ExposureFailure, for_each_exposure
from daemon.mission.layout import Mission, exposure_name
from daemon.mission.store import durable
from daemon.mission.store.level0 import read_description, refuse_decompression_bomb, tiff_errors
from daemon.mission.store.level0_folder import read_capture, read_sealed, unsealed_exposure
from daemon.mission.store.level2 import BAND_ORDER
from daemon.mission.store.publication import published
from processing.geometry.exposure_times import reference_exposure_times
from processing.image.pansharpening import pansharpened
from processing.radiometry.tone_curve import (
    VALUE_COUNT,
    ToneCurve,
    curve_as_json,
    histogram,
    lookup_table,
    mission_curve,
)
from processing.rig import Rig

IMAGES: Final[Mapping[str, tuple[str, str, str]]] = {
    "rgb": ("red", "green", "blue"),
    "cir": ("nir", "red", "green"),
}
"""Images by name: the bands shown as red, green and blue."""

DEPTHS: Final = (16, 8)
CURVE_FILE: Final = "tone-curve.json"
TILE_PX: Final = 256

Progress = Callable[[str, int, int], None]


class Level3Error(DaemonError):
    """Level-2 that cannot be pansharpened; the message states which exposure and what to do."""


@dataclass(frozen=True)
class PansharpenedExposure:
    """Files written for one exposure: name to size in bytes, and those that failed."""

    number: int
    files: Mapping[str, int]
    left_out: tuple[str, ...]


@dataclass(frozen=True)
class MissionTones:
    """The mission's curve, the hash of its file, and the scale of each exposure by band.

    A scale is the mission's median exposure time over the exposure's own: an exposure that was
    exposed for half as long is made twice as bright before the curve is applied.
    """

    curve: ToneCurve
    sha256: str
    scales: Mapping[int, Mapping[str, float]]


def level3_root(mission: Mission) -> Path:
    """Folder of Level-3."""
    return mission.path / "L3"


def mission_tones(
    mission: Mission, rig: Rig, progress: Progress | None = None
) -> tuple[MissionTones, tuple[ExposureFailure, ...]]:
    """The tone curve of all exposures that have Level-2, written to `L3/tone-curve.json`.

    Returns:
        The tones, and the exposures that could not be read: these are in no curve.

    Raises:
        Level3Error: no exposure has colour at Level-2 that can be read.
        OSError: the disk refused.
    """
    numbers = _processed(mission)
    sums = {band: np.zeros(VALUE_COUNT, np.int64) for band in BAND_ORDER}
    timed = for_each_exposure(numbers, lambda number: _exposure_times_us(mission, rig, number))
    scales = _scales(timed.results)

    def count(number: int) -> None:
        rasters = _colour(mission, number)
        counts = {b: histogram(r, scales[number].get(b, 1.0)) for b, r in rasters.items()}
        for band, counted in counts.items():
            sums[band] += counted

    def show(done: int) -> None:
        if progress is not None:
            progress("histograms", done, len(scales))

    counted = for_each_exposure(scales, count, show)
    scales = {number: scales[number] for number in counted.results}
    failures = (*timed.failures, *counted.failures)
    try:
        curve = mission_curve(sums)
    except ValueError as error:
        causes = "; ".join(f"exposure {one.exposure}: {one.cause}" for one in failures)
        raise Level3Error(f"{mission.path}: {causes or error}") from error
    content = canonical_bytes(
        {
            "format": 1,
            "curve": curve_as_json(curve),
            "exposures": [{"number": number, "scale": dict(scales[number])} for number in scales],
        }
    )
    durable.make_directories(level3_root(mission))
    durable.replace_file(level3_root(mission) / CURVE_FILE, content)
    return MissionTones(curve, sha256_hex(content), scales), failures


def pansharpen(
    mission: Mission,
    rig: Rig,
    number: int,
    tones: MissionTones,
    *,
    images: Sequence[str] = tuple(IMAGES),
    depths: Sequence[int] = DEPTHS,
    threads: int = 1,
) -> PansharpenedExposure:
    """Write the Level-3 folder of one exposure, whole, in place of an earlier one.

    Args:
        images: of `IMAGES`. One whose bands are not all there is left out and named.
        depths: 16 (linear signal, as Level-2) and 8 (through the curve).
        threads: that compress tiles.

    Raises:
        Level3Error: Level-2 is missing or does not fit the rig.
        OSError: the disk refused; an earlier folder is still there.
    """
    if rig.virtual_image is None:
        raise Level3Error(f"rig {rig.name} has no virtual image; there is no PAN to sharpen with")
    pan = _pan(mission, number)
    colour = _colour(mission, number)
    described = read_description(mission.level2(number) / "pan.tif")
    marks = {key: True for key in ("simulated", "uncalibrated") if described.get(key) is True}
    try:
        sharp = pansharpened(pan, colour, rig.virtual_image.colour_ratio)
    except ValueError as error:
        raise Level3Error(f"exposure {number}: {error}; process it again") from error
    final = level3_root(mission) / exposure_name(number)
    files, left_out = {}, []
    with published(final) as part:
        for image in images:
            bands = IMAGES[image]
            if absent := [band for band in bands if band not in sharp]:
                left_out.append(f"{image}: no {', '.join(absent)} at Level-2")
                continue
            for depth in depths:
                name = f"{image}-{depth}.tif"
                tables = _tables(tones, number, bands) if depth == 8 else None
                about = {
                    "bands": list(bands),
                    "exposure": number,
                    "level": 3,
                    **marks,
                    "tone_curve_sha256": tones.sha256 if depth == 8 else "",
                    "scale": [tones.scales[number].get(band, 1.0) for band in bands],
                }
                planes = [sharp[band] for band in bands]
                files[name] = _write(part / name, planes, tables, about, threads)
    return PansharpenedExposure(number, files, tuple(left_out))


def _tables(tones: MissionTones, number: int, bands: Sequence[str]) -> list[NDArray[np.uint8]]:
    scales = tones.scales[number]
    return [lookup_table(tones.curve, band, scales.get(band, 1.0)) for band in bands]


def _write(
    path: Path,
    planes: Sequence[NDArray[np.uint16]],
    tables: Sequence[NDArray[np.uint8]] | None,
    about: Mapping[str, Any],
    threads: int,
) -> int:
    """A tiled, deflated TIFF, pixel-interleaved; durable on return. Returns its size in bytes."""
    from tifffile import imwrite

    height, width = planes[0].shape
    imwrite(
        path,
        _tiles(planes, tables),
        shape=(height, width, len(planes)),
        dtype=np.uint16 if tables is None else np.uint8,
        tile=(TILE_PX, TILE_PX),
        photometric="rgb",
        compression="adobe_deflate",
        # The default level is 1 % smaller and takes two and a half times as long.
        compressionargs={"level": 1},
        predictor=True,
        maxworkers=threads,
        description=canonical_bytes(about).decode("utf-8").strip(),
        metadata=None,
        software="Syntopic",
    )
    with path.open("rb") as file:
        os.fsync(file.fileno())
        return os.fstat(file.fileno()).st_size


def _tiles(
    planes: Sequence[NDArray[np.uint16]], tables: Sequence[NDArray[np.uint8]] | None
) -> Iterator[NDArray[Any]]:
    height, width = planes[0].shape
    for row in range(0, height, TILE_PX):
        for column in range(0, width, TILE_PX):
            window = np.s_[row : row + TILE_PX, column : column + TILE_PX]
            shown: list[NDArray[Any]] = [plane[window] for plane in planes]
            if tables is not None:
                shown = [table[plane] for table, plane in zip(tables, shown, strict=True)]
            tile = np.zeros((TILE_PX, TILE_PX, len(planes)), shown[0].dtype)
            tile[: shown[0].shape[0], : shown[0].shape[1]] = np.stack(shown, axis=-1)
            yield tile


def _processed(mission: Mission) -> list[int]:
    numbers = [n for n in mission.numbers() if (mission.level2(n) / "rgbn.tif").exists()]
    if not numbers:
        raise Level3Error(
            f"{mission.path}: no exposure has colour at Level-2; run syntopic process first"
        )
    return numbers


def _exposure_times_us(mission: Mission, rig: Rig, number: int) -> dict[str, float]:
    """What the bands of an exposure were exposed for, as far as its record knows it.

    Level-2 holds frames as `reference_exposure_times` brings them to.
    """
    exposure = _record(mission, number)
    if exposure is None:
        return {}
    times_us = {f.sensor: f.exposure_time_us for f in exposure.frames if f.exposure_time_us}
    references = reference_exposure_times(rig, times_us)
    return {
        band: references[cone.sensors[0].name]
        for cone in rig.colour_cones
        if cone.sensors[0].name in references
        for band in cone.bands
    }


def _scales(times_us: Mapping[int, Mapping[str, float]]) -> dict[int, dict[str, float]]:
    """Median exposure time of the mission over that of each exposure, by band."""
    usual = {
        band: float(np.median([times[band] for times in times_us.values() if band in times]))
        for band in {band for times in times_us.values() for band in times}
    }
    return {
        number: {band: usual[band] / time for band, time in times.items()}
        for number, times in times_us.items()
    }


def _record(mission: Mission, number: int) -> Exposure | None:
    folder = mission.level0(number)
    if (sealed := read_sealed(folder)) is not None:
        return sealed.exposure
    capture = read_capture(folder)
    return None if capture is None else unsealed_exposure(capture)


def _pan(mission: Mission, number: int) -> NDArray[np.uint16]:
    pan = _read(mission.level2(number) / "pan.tif", number)
    if pan.ndim != 2:
        raise Level3Error(f"exposure {number}: pan.tif has shape {pan.shape}; process it again")
    return pan


def _colour(mission: Mission, number: int) -> dict[str, NDArray[np.uint16]]:
    """The colour bands of Level-2 that hold data, by name."""
    path = mission.level2(number) / "rgbn.tif"
    planes = _read(path, number)
    planes = planes[None] if planes.ndim == 2 else planes
    bands = read_description(path).get("bands")
    if not isinstance(bands, list) or len(bands) != len(planes) or set(bands) - set(BAND_ORDER):
        raise Level3Error(f"exposure {number}: rgbn.tif does not name its bands; process it again")
    return {
        band: np.ascontiguousarray(plane)
        for band, plane in zip(bands, planes, strict=True)
        if plane.any()
    }


def _read(path: Path, number: int) -> NDArray[np.uint16]:
    from tifffile import TiffFile

    try:
        with TiffFile(path) as tiff:
            page = tiff.pages[0]
            refuse_decompression_bomb(page, path)
            pixels: NDArray[Any] = page.asarray()
    except FileNotFoundError as error:
        raise Level3Error(
            f"exposure {number}: has no {path.name} at Level-2; run syntopic process first"
        ) from error
    except tiff_errors() as error:
        raise Level3Error(
            f"exposure {number}: {path.name} cannot be read ({error}); process it again"
        ) from error
    if pixels.dtype != np.uint16:
        raise Level3Error(f"exposure {number}: {path.name} holds {pixels.dtype}; process it again")
    return pixels
