"""Control points of photographs: ODM's `gcp_list.txt`, or the two tables of `syntopic triangulate`.

Images are named by their files. Pixels are zero in the middle of the upper left pixel.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.mission.foreign_files import ForeignFileError, read_regular_file
from daemon.orientation.geodesy import CRS, CRSError, ProjError
from daemon.orientation.georeference import GeoreferenceError, accurate_transformer
from daemon.orientation.local_frame import LocalFrame
from daemon.postflight.adjustment.csv_tables import read_table
from daemon.postflight.triangulation.photograph_block import PhotographBlock
from daemon.postflight.triangulation.triangulation import TriangulationError

Array = NDArray[np.float64]

MEASURED_SIGMA_PX: Final = 0.5
SURVEYED_SIGMA_M: Final = (0.02, 0.02, 0.03)
_FILE_MAX_BYTES: Final = 20_000_000


@dataclass(frozen=True)
class GroundControl:
    """Points with role, place (n, 3) m in the local frame, sigma; and where images show them.

    `image` and `point` are indices (m,), `px` (m, 2). `unused` names measurements in images that
    are not in the block.
    """

    names: tuple[str, ...]
    roles: tuple[str, ...]
    xyz_m: Array
    sigma_m: Array
    image: NDArray[np.int64]
    point: NDArray[np.int64]
    px: Array
    sigma_px: Array
    unused: tuple[str, ...] = ()


def no_control() -> GroundControl:
    """No points."""
    none, empty = np.zeros(0, np.int64), np.zeros((0, 3))
    return GroundControl((), (), empty, empty, none, none, np.zeros((0, 2)), np.zeros(0))


def read_gcp_list(path: Path, images: Mapping[str, int], frame: LocalFrame) -> GroundControl:
    """Control points of OpenDroneMap's file.

    First line: coordinate system (EPSG code, PROJ text, or "WGS84 UTM 16N"). Then a measurement a
    line: east north height column row image [name]. Points without a name are joined by their
    coordinates. Heights are those of the coordinate system; without one, above the ellipsoid of
    WGS 84.

    Args:
        path: the file.
        images: index of an image by the name of its file.
        frame: of the block.

    Raises:
        TriangulationError: with every line that cannot be read.

    Source: OpenDroneMap, "Ground Control Points", format of gcp_list.txt.
    """
    try:
        lines = read_regular_file(path, _FILE_MAX_BYTES).decode("utf-8-sig").splitlines()
    except (ForeignFileError, OSError, UnicodeDecodeError) as error:
        raise TriangulationError(f"{path}: {error}") from error
    numbered = [(n, line.strip()) for n, line in enumerate(lines, start=1)]
    numbered = [(n, line) for n, line in numbered if line and not line.startswith("#")]
    if len(numbered) < 2:
        raise TriangulationError(f"{path.name}: a line with the coordinate system, then points")
    problems: list[str] = []
    rows: list[tuple[str, tuple[float, float, float], int, tuple[float, float]]] = []
    unused: list[str] = []
    for n, line in numbered[1:]:
        parts = _parts(line, images)
        try:
            numbers = [_number(part) for part in parts[:5]]
            image = parts[5]
            if len(numbers) < 5 or not all(map(math.isfinite, numbers)):
                raise ValueError
        except (ValueError, IndexError):
            problems.append(f"{path.name} line {n}: east north height column row image [name]")
            continue
        at = _image_of(image, images)
        name = parts[6] if len(parts) > 6 else "_".join(f"{v:.12g}" for v in numbers[:3])
        if at is None:
            unused.append(f"{image}: {name}")
            continue
        east, north, height, column, row = numbers
        rows.append((name, (east, north, height), at, (column, row)))
    if unused and not rows and not problems:
        problems.append(
            f"{path.name}: no line names a photograph of the block; the first one names "
            f"{unused[0].split(':')[0]!r}. A line is: east north height column row image [name], "
            "with decimal points. Correct the names, or leave the file out"
        )
    places: dict[str, tuple[float, float, float]] = {}
    for name, place, _, _ in rows:
        if places.setdefault(name, place) != place:
            problems.append(f"{path.name}: point {name} has two different places")
    rows, contradictions = _once(path, rows, {at: name for name, at in images.items()})
    problems += contradictions
    if problems:
        raise TriangulationError("; ".join(problems[:20]))
    names = tuple(places)
    number = {name: k for k, name in enumerate(names)}
    geodetic = _geodetic(path, numbered[0][1], np.array([places[n] for n in names]).reshape(-1, 3))
    return GroundControl(
        names,
        ("control",) * len(names),
        frame.from_geodetic(*geodetic.T) if len(names) else np.zeros((0, 3)),
        np.tile(SURVEYED_SIGMA_M, (len(names), 1)),
        np.array([at for _, _, at, _ in rows], np.int64),
        np.array([number[name] for name, *_ in rows], np.int64),
        np.array([px for *_, px in rows]).reshape(-1, 2),
        np.full(len(rows), MEASURED_SIGMA_PX),
        tuple(unused),
    )


_Row = tuple[str, tuple[float, float, float], int, tuple[float, float]]
"""Point, its place, index of the image, column and row."""


def _once(
    path: Path, rows: Sequence[_Row], images: Mapping[int, str]
) -> tuple[list[_Row], list[str]]:
    """Rows without copies, and a sentence for each point with two places in an image."""
    first: dict[tuple[str, int], _Row] = {}
    problems = []
    for row in rows:
        name, _, at, px = row
        other = first.setdefault((name, at), row)
        if (apart_px := math.dist(other[3], px)) > 0.0:
            problems.append(
                f"{path.name}: point {name} is measured twice in {images[at]}, {apart_px:.1f} px "
                "apart; keep one of both"
            )
    return list(first.values()), problems


def _number(text: str) -> float:
    """A number in ASCII digits; Python would take 1_0 and digits of other scripts, too."""
    if "_" in text or not text.isascii():
        raise ValueError(text)
    return float(text)


def read_control_tables(
    points_file: Path, measured_file: Path, images: Mapping[str, int], frame: LocalFrame
) -> GroundControl:
    """The tables of `syntopic triangulate --points --measured`; images by file or image name.

    Raises:
        TriangulationError: with every mistake.
    """
    table = read_table(
        points_file, ("point", "role", "latitude_deg", "longitude_deg", "height_m"),
        ("sx_m", "sy_m", "sz_m"),
    )  # fmt: skip
    names, roles = table.names("point"), table.text("role")
    for role, line in zip(roles, table.lines, strict=True):
        if role not in ("control", "check"):
            table.add_problem(line, f"role is {role!r}; control or check is right")
    place = np.array([table.numbers(c) for c in ("latitude_deg", "longitude_deg", "height_m")])
    sigma = [
        table.numbers(c, s) for c, s in zip(("sx_m", "sy_m", "sz_m"), SURVEYED_SIGMA_M, strict=True)
    ]
    seen = read_table(measured_file, ("image", "point", "column_px", "row_px"), ("sigma_px",))
    number = {name: k for k, name in enumerate(names)}
    own = seen.text("image")
    of = [_image_of(name, images) for name in own]
    for name, line in zip(seen.text("point"), seen.lines, strict=True):
        if name not in number:
            seen.add_problem(line, f"point {name!r} is not there")
    px = np.array([seen.numbers("column_px"), seen.numbers("row_px")]).T.reshape(-1, 2)
    problems = [*table.problems, *seen.problems]
    if problems or not np.isfinite(place).all() or not np.isfinite(px).all():
        raise TriangulationError("; ".join(problems) or "an empty cell where a number is needed")
    keep = np.array([k is not None for k in of], bool)
    points = np.array([number[name] for name in seen.text("point")], np.int64)
    return GroundControl(
        tuple(names),
        tuple(roles),
        frame.from_geodetic(*place),
        np.array(sigma).T.reshape(-1, 3),
        np.array([k for k in of if k is not None], np.int64),
        points[keep],
        px[keep],
        np.array(seen.numbers("sigma_px", MEASURED_SIGMA_PX))[keep],
        tuple(f"{n}: not in the block" for n, k in zip(own, of, strict=True) if k is None),
    )


def _geodetic(path: Path, system: str, xyz: Array) -> Array:
    """Latitude, longitude, ellipsoidal height (n, 3) of coordinates in a system."""
    place = f"{path.name} line 1: {system[:80]!r}"
    try:
        crs = CRS.from_user_input(_named_utm(system) or _with_datum(system))
    except CRSError as error:
        raise TriangulationError(
            f"{place} is no coordinate system; write EPSG:32616, a PROJ text or WGS84 UTM 16N"
        ) from error
    horizontal = crs.sub_crs_list[0] if crs.is_compound else crs
    if not (horizontal.is_projected or horizontal.is_geographic):
        raise TriangulationError(f"{place} is neither a projected nor a geographic system")
    units = {axis.unit_name for axis in horizontal.axis_info} - {"metre", "degree"}
    if units and not crs.is_compound:
        raise TriangulationError(
            f"{place} counts in {', '.join(sorted(units))} and has no height system: the unit of "
            "heights is unknown; add a height system, such as EPSG:2236+6360, or convert to metres"
        )
    try:
        transformer = accurate_transformer(crs, system[:80])
        x, y, z = xyz.T
        longitude, latitude, height = transformer.transform(
            x, y, z, direction="INVERSE", errcheck=True
        )
    except (GeoreferenceError, ProjError) as error:
        raise TriangulationError(f"{path.name} line 1: {error}") from error
    return np.stack([latitude, longitude, height], axis=-1)


def _parts(line: str, images: Mapping[str, int]) -> list[str]:
    """Columns of a line; the name of an image may contain spaces.

    Between tabs or semicolons, as spreadsheets write them, numbers may have decimal commas.
    """
    for separator in ("\t", ";"):
        if line.count(separator) >= 5:
            cells = [cell.strip() for cell in line.split(separator)]
            return [*(cell.replace(",", ".") for cell in cells[:5]), *cells[5:]]
    parts = line.replace(",", " ").split()
    rest = re.split(r"[\s,]+", line, maxsplit=5)[5:]
    if not rest or _image_of(parts[5], images) is not None:
        return parts
    ends = [match.start() for match in re.finditer(r"[\s,]+|$", rest[0])]
    for end in reversed(ends):
        own = rest[0][:end]
        _, dot, suffix = own.rpartition(".")
        if not (dot and " " in suffix) and _image_of(own, images) is not None:
            return [*parts[:5], own, *rest[0][end:].replace(",", " ").split()]
    return parts


def _image_of(name: str, images: Mapping[str, int]) -> int | None:
    """Index of an image by its file's name, without its folder, or with another suffix."""
    own = _plain(name.replace("\\", "/").rsplit("/", 1)[-1])
    if own in images:
        return images[own]
    stem = own.rsplit(".", 1)[0]
    of_stem = {k for file, k in images.items() if file.rsplit(".", 1)[0] == stem}
    return of_stem.pop() if len(of_stem) == 1 else None


def _with_datum(system: str) -> str:
    """A PROJ text on the ellipsoid of WGS 84 that names no datum: WGS 84 is meant."""
    is_bare = "+proj=" in system and not re.search(r"\+(datum|towgs84|nadgrids)=", system)
    return f"{system} +datum=WGS84" if is_bare and "+ellps=WGS84" in system else system


def _named_utm(system: str) -> str | None:
    """EPSG code of "WGS84 UTM 16N"."""
    parts = system.upper().split()
    if len(parts) != 3 or parts[:2] != ["WGS84", "UTM"] or parts[2][-1:] not in ("N", "S"):
        return None
    zone = parts[2][:-1]
    if not zone.isdigit() or not 1 <= int(zone) <= 60:
        return None
    return f"EPSG:{326 if parts[2][-1] == 'N' else 327}{int(zone):02d}"


def image_index(names: Sequence[str], files: Mapping[str, str]) -> dict[str, int]:
    """Index of every image by its name and by that of its file, as `_plain` writes them."""
    by_name = {_plain(name): k for k, name in enumerate(names)}
    return by_name | {_plain(files[name]): k for k, name in enumerate(names)}


def _plain(name: str) -> str:
    """In small letters and composed characters: macOS decomposes them in the names of files."""
    return unicodedata.normalize("NFC", name).strip().lower()


def control_of(
    found: PhotographBlock, points_file: Path | None, measured_file: Path | None
) -> GroundControl:
    """Control of a block of photographs: a `gcp_list.txt` alone, or two tables.

    Raises:
        TriangulationError: files with mistakes, or one table without the other.
    """
    images = image_index(found.block.names, found.files)
    frame = found.block.frame
    if points_file is None and measured_file is None:
        return no_control()
    if points_file is not None and measured_file is not None:
        return read_control_tables(points_file, measured_file, images, frame)
    if points_file is None or points_file.suffix.lower() != ".txt":
        raise TriangulationError(
            "--points takes a gcp_list.txt alone, or a table together with --measured"
        )
    return read_gcp_list(points_file, images, frame)
