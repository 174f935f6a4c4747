"""A folder of photographs becomes a mission folder that `syntopic triangulate` takes.

Files are copied as they are. Each camera becomes a head with a provisional interior orientation:
focal length of EXIF, no distortion, principal point in the middle. Positions are the camera's,
without standard deviation.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from daemon.mission.canonical_json import sha256_hex
from daemon.mission.exposure import Exposure, FrameRecord, exposure_bytes
from daemon.mission.layout import Mission, exposure_name
from daemon.mission.store import durable
from daemon.postflight.calibration.rig_writer import rig_toml
from daemon.postflight.importers import exif_tags
from daemon.postflight.importers.exif_tags import ImageTags, TagsError, read_tags
from daemon.postflight.importers.multispectral_tags import ImagesError
from daemon.postflight.importers.photograph_files import (
    check_complete,
    check_strips,
    other_images,
    photograph_paths,
)
from daemon.postflight.importers.photograph_positions import implausible_positions, same_place
from daemon.postflight.importers.xmp import XmpError, read_xmp
from processing.rig import Cone, Lens, Rig, Sensor, load_rig

CONE: Final = "C"
"""Name of the only cone and sensor; of several cameras C1, C2 and so on."""
_CONES: Final = re.compile(r"C[1-9]?[0-9]?")
_CAMERAS_MAX: Final = 20
RIG_NAME: Final = "photographs"
POSITIONS_MIN: Final = 3
_ABOVE_TAKEOFF: Final = "RelativeAltitude"
NO_HEIGHT_M: Final = 0.0
"""Height of all photographs where none states one."""
_NOMINAL_PITCH_MM: Final = 1e-3
_NAMED: Final = 5


@dataclass(frozen=True)
class Photograph:
    """One file: camera, size, provisional focal length in pixels, place or None.

    `above_takeoff_m` is RelativeAltitude of XMP, else NaN. `height_source` is the tag that the
    height of the place comes from, empty where all heights are taken as zero. `position_problem`
    is why a position of EXIF is not used.
    """

    path: Path
    camera: str
    serial: str
    width_px: int
    height_px: int
    focal_px: float
    focal_source: str
    pitch_mm: float
    f_number: float
    taken: str
    exposure_time_us: float | None
    position: tuple[float, float, float] | None
    above_takeoff_m: float = math.nan
    height_source: str = "GPSAltitude"
    orientation: int = 1
    position_problem: str = ""


@dataclass(frozen=True)
class ImportedPhotographs:
    """The written mission; `heads` are the names of the heads of `photographs`.

    `notes` state what is provisional or missing.
    """

    mission: Mission
    photographs: tuple[Photograph, ...]
    heads: tuple[str, ...]
    notes: tuple[str, ...]


def import_photographs(
    folder: Path,
    out: Path,
    *,
    focal_mm: float | None = None,
    pixel_um: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ImportedPhotographs:
    """Write the mission folder `out` from the photographs of a folder, in the order of their names.

    Args:
        folder: with JPEG or TIFF files; other files are not looked at.
        out: it must be new.
        focal_mm: focal length in place of EXIF; together with `pixel_um`.
        pixel_um: pixel pitch of the files.
        progress: gets files done and in all.

    Raises:
        ImagesError: no usable photographs, too many cameras, or fewer than three positions.
        OSError: the disk refused.
    """
    if out.exists():
        raise ImagesError([f"{out}: is there already; give the path of a new mission folder"])
    photographs, copies = _without_copies(
        read_photographs(folder, focal_mm=focal_mm, pixel_um=pixel_um)
    )
    heads = head_names(photographs)
    cameras = {name: photographs[heads.index(name)] for name in in_order(heads)}
    rig = rig_of(cameras)
    sources = ", ".join(sorted({one.focal_source for one in cameras.values()}))
    content = rig_toml(
        rig,
        remark=f"Photographs. The interior orientation is provisional: {sources}.",
        names_schema=False,
    )
    with durable.new_files(out, last="rig.toml") as part:
        for name in ("L0", "L2"):
            durable.make_directories(part / name)
        durable.create_file(part / "rig.toml", [content], mode=0o644)
        written = load_rig(part / "rig.toml")
        for number, (one, head) in enumerate(zip(photographs, heads, strict=True), start=1):
            _write_exposure(part, number, (one, head), written, sha256_hex(content))
            if progress is not None:
                progress(number, len(photographs))
    notes = [*_notes(photographs, heads), *copies]
    if others := other_images(folder):
        notes.append(f"{others}.")
    return ImportedPhotographs(Mission.open(out), tuple(photographs), heads, tuple(notes))


def read_photographs(
    folder: Path, *, focal_mm: float | None = None, pixel_um: float | None = None
) -> list[Photograph]:
    """The photographs of a folder.

    Raises:
        ImagesError: every reason why they make no block.
    """
    if (focal_mm is None) != (pixel_um is None):
        raise ImagesError(["--focal-mm and --pixel-um go together; give both or neither"])
    paths = photograph_paths(folder)
    given = None if focal_mm is None or pixel_um is None else (focal_mm, pixel_um)
    problems: list[str] = []
    found: list[Photograph] = []
    for path in paths:
        try:
            tags = read_tags(path)
            check_complete(path, is_jpeg=tags.kind == "jpeg")
            check_strips(path, tags)
            found.append(_photograph(path, tags, given))
        except TagsError as error:
            problems.append(str(error))
    kinds = Counter(map(_kind, found))
    if len(kinds) > _CAMERAS_MAX:
        counted = "; ".join(f"{count} of {kind}" for kind, count in kinds.most_common(6))
        problems.append(
            f"the folder holds photographs of {len(kinds)} cameras or settings ({counted}; ...); "
            f"{_CAMERAS_MAX} are estimated at most. A zoom lens needs one focal length for all"
        )
    found = _with_heights(_with_plausible_positions(found))
    placed = sum(one.position is not None for one in found)
    if not problems and placed < POSITIONS_MIN:
        unused = [one for one in found if one.position_problem][:_NAMED]
        problems.append(
            f"{folder}: {placed} of {len(found)} photographs have a position in EXIF (GPSLatitude, "
            "GPSLongitude with GPSLatitudeRef N or S, GPSLongitudeRef E or W) that can be used; "
            f"{POSITIONS_MIN} are needed to place a block"
            + "".join(f". {one.path.name}: {one.position_problem}" for one in unused)
        )
    if problems:
        raise ImagesError(problems)
    return found


def _without_copies(
    photographs: Sequence[Photograph],
) -> tuple[list[Photograph], tuple[str, ...]]:
    """Each photograph once, that of the shortest name, and a sentence for each copy of its file."""
    by_size = Counter(one.path.stat().st_size for one in photographs)
    first: dict[str, Path] = {}
    copies: dict[Path, str] = {}
    for one in sorted(photographs, key=lambda one: (len(one.path.name), one.path.name)):
        if by_size[one.path.stat().st_size] > 1:
            original = first.setdefault(sha256_hex(one.path.read_bytes()), one.path)
            if original != one.path:
                copies[one.path] = f"{one.path.name} is a copy of {original.name} and left out."
    return [one for one in photographs if one.path not in copies], tuple(copies.values())


def is_photographs(mission: Mission) -> bool:
    """Whether a mission was made of photographs: its only frames are JPEG or TIFF as they came."""
    try:
        return is_of_photographs(load_rig(mission.rig_path))
    except (OSError, ValueError):
        return False


def is_of_photographs(rig: Rig) -> bool:
    """Whether a rig is the one that `import_photographs` writes."""
    return rig.name == RIG_NAME and all(_CONES.fullmatch(cone.name) for cone in rig.cones)


def _photograph(path: Path, tags: ImageTags, given: tuple[float, float] | None) -> Photograph:
    focal = exif_tags.focal_length_px_of(tags)
    pitch = exif_tags.pitch_mm_of(tags)
    length = tags.number(exif_tags.FOCAL_LENGTH)
    if given is not None:
        focal = (given[0] * 1e3 / given[1], f"--focal-mm {given[0]:g} --pixel-um {given[1]:g}")
        pitch = given[1] * 1e-3
    elif focal is not None and (pitch is None or "35mm" in focal[1]):
        pitch = length / focal[0] if length else None
    if focal is None or not 0.2 < focal[0] / max(tags.width_px, tags.height_px) < 50.0:
        raise TagsError(
            f"{path.name}: no focal length that can be used (FocalLength with "
            "FocalPlaneXResolution, or FocalLengthIn35mmFilm); give --focal-mm and --pixel-um"
        )
    camera = f"{tags.text(exif_tags.MAKE)} {tags.text(exif_tags.MODEL)}".strip() or "unknown camera"
    seconds = tags.number(exif_tags.EXPOSURE_TIME)
    position, above_m = _with_height_of_xmp(path, tags)
    return Photograph(
        path=path,
        camera=camera[:80],
        serial=tags.text(exif_tags.BODY_SERIAL)[:40],
        width_px=tags.width_px,
        height_px=tags.height_px,
        focal_px=focal[0],
        focal_source=focal[1],
        pitch_mm=pitch or _NOMINAL_PITCH_MM,
        f_number=tags.number(exif_tags.F_NUMBER) or 5.6,
        taken=tags.text(exif_tags.DATE_TIME_ORIGINAL)[:40],
        exposure_time_us=None if seconds is None or seconds <= 0.0 else seconds * 1e6,
        position=position,
        above_takeoff_m=above_m,
        orientation=int(tags.number(exif_tags.ORIENTATION) or 1),
    )


def _with_height_of_xmp(
    path: Path, tags: ImageTags
) -> tuple[tuple[float, float, float] | None, float]:
    """Position and height above the takeoff point, m; heights that are not stated are NaN.

    A height that EXIF has not is that of XMP (drone-dji:AbsoluteAltitude).
    """
    place, above = exif_tags.position_of(tags), math.nan
    if place is None or tags.xmp is None:
        return place, above
    try:
        xmp = read_xmp(tags.xmp, path.name)
    except XmpError:
        return place, above
    with suppress(XmpError):
        above = xmp.number("RelativeAltitude")
    if not math.isfinite(place[2]):
        with suppress(XmpError):
            place = (*place[:2], xmp.number("AbsoluteAltitude"))
    return place, above


def _with_plausible_positions(photographs: list[Photograph]) -> list[Photograph]:
    """Positions that cannot be of the block are not used; the photographs state why."""
    problems = implausible_positions([one.position for one in photographs])
    return [
        replace(one, position=None, position_problem=problems[k]) if k in problems else one
        for k, one in enumerate(photographs)
    ]


def _with_heights(photographs: list[Photograph]) -> list[Photograph]:
    """Positions without height are none where enough others have one.

    Otherwise all heights are those above the takeoff point, and zero where one has none.
    """
    placed = [one for one in photographs if one.position is not None]
    heights = np.array([one.position[2] for one in placed if one.position is not None])
    if np.isfinite(heights).all():
        return photographs
    are_enough = int(np.isfinite(heights).sum()) >= POSITIONS_MIN
    is_above = all(math.isfinite(one.above_takeoff_m) for one in placed)
    found = []
    for one in photographs:
        place, source = one.position, one.height_source
        if place is not None and not (are_enough and math.isfinite(place[2])):
            height = one.above_takeoff_m if is_above else NO_HEIGHT_M
            place = None if are_enough else (*place[:2], height)
            source = _ABOVE_TAKEOFF if is_above else ""
        found.append(replace(one, position=place, height_source=source))
    return found


def _kind(one: Photograph) -> str:
    """Photographs that differ in it have an interior orientation each."""
    serial = f" {one.serial}" if one.serial else ""
    size = f"{one.width_px} x {one.height_px} px"
    return f"{one.camera}{serial}, {size}, f {one.focal_px:.0f} px"


def head_names(photographs: Sequence[Photograph]) -> tuple[str, ...]:
    """Name of the head of each photograph: of one camera C, of several C1 for the most, C2, ...

    Camera, serial number, size and focal length in pixels make a head.
    """
    kinds = Counter(map(_kind, photographs)).most_common()
    if len(kinds) == 1:
        return (CONE,) * len(photographs)
    number = {kind: k for k, (kind, _) in enumerate(kinds, start=1)}
    return tuple(f"{CONE}{number[_kind(one)]}" for one in photographs)


def in_order(heads: Iterable[str]) -> list[str]:
    """The different names of heads: C1, C2, ..., C10."""
    return sorted(set(heads), key=lambda name: (len(name), name))


def rig_of(cameras: Mapping[str, Photograph]) -> Rig:
    """A rig with a head for each camera, with a provisional interior orientation.

    Args:
        cameras: a photograph of each head, by its name.
    """
    first = next(iter(cameras))
    return Rig(
        name=RIG_NAME,
        title=cameras[first].camera,
        timing="synchronous",
        frame_interval_s=1.0,
        master_cone=first,
        colour_master_cone=first,
        reference_cone=first,
        calibration_id="uncalibrated",
        calibration_date="",
        virtual_image=None,
        cones=tuple(_cone(name, one) for name, one in cameras.items()),
    )


def _cone(name: str, photograph: Photograph) -> Cone:
    sensor = Sensor(
        name=name,
        serial=photograph.serial,
        width_px=photograph.width_px,
        height_px=photograph.height_px,
        pitch_um=round(photograph.pitch_mm * 1e3, 6),
        x_mm=0.0,
        y_mm=0.0,
        calibration_c=20.0,
        probe="",
        bits=8,
    )
    return Cone(
        name=name,
        role="colour",
        bands=("red", "green", "blue"),
        position_mm=(0.0, 0.0, 0.0),
        rotation_rad=(0.0, 0.0, 0.0),
        probe="",
        calibration_c=20.0,
        lens=Lens(
            f_mm=round(photograph.focal_px * photograph.pitch_mm, 6),
            f_number=photograph.f_number,
            f_sigma_ppm=20_000.0,
        ),
        sensors=(sensor,),
    )


def _write_exposure(
    mission: Path, number: int, photograph: tuple[Photograph, str], rig: Rig, rig_sha256: str
) -> None:
    one, head = photograph
    folder = mission / "L0" / exposure_name(number)
    folder.mkdir()
    name = f"{head}{one.path.suffix.lower()}"
    data = one.path.read_bytes()
    durable.create_file(folder / name, [data])
    settings: dict[str, float | int | str] = {"Source": one.path.name}
    if one.taken:
        settings["DateTimeOriginal"] = one.taken
    if one.orientation != 1:
        settings["Orientation"] = one.orientation
    if one.position is not None:
        place = ("GpsLatitudeDeg", "GpsLongitudeDeg", "GpsAltitudeM")
        settings |= dict(zip(place, one.position, strict=True))
        if one.height_source != "GPSAltitude":
            settings["HeightSource"] = one.height_source or "none"
    frame = FrameRecord(
        sensor=head,
        head_serial=one.serial,
        file=name,
        sha256=sha256_hex(data),
        width_px=one.width_px,
        height_px=one.height_px,
        pixel_format="JPEG" if name.endswith(("jpg", "jpeg")) else "TIFF",
        exposure_time_us=one.exposure_time_us,
        settings=settings,
    )
    exposure = Exposure(
        number=number,
        frames=(frame,),
        missing=(),
        state="complete",
        calibration_id=rig.calibration_id,
        calibration_sha256=rig_sha256,
        mark_gps_ns=None,
        mark_source="none",
        software="syntopic import photographs",
    )
    durable.create_file(folder / "exposure.json", [exposure_bytes(exposure)])
    durable.sync_directory(folder)


def _notes(photographs: Sequence[Photograph], heads: Sequence[str]) -> tuple[str, ...]:
    notes = []
    for head in in_order(heads):
        own = [one for one, name in zip(photographs, heads, strict=True) if name == head]
        of = f"{head}, {len(own)} photographs of {_kind(own[0])}: t" if head != CONE else "T"
        notes.append(
            f"{of}he interior orientation is provisional: f {own[0].focal_px:.1f} px from "
            f"{own[0].focal_source}, no distortion."
        )
    without = [one.path.name for one in photographs if one.position is None]
    if without:
        notes.append(
            f"{len(without)} photographs have no position: {', '.join(without[:5])}"
            f"{', ...' if len(without) > 5 else ''}."
        )
    unused = [one for one in photographs if one.position_problem]
    notes += [
        f"{one.path.name}: {one.position_problem}. It is not used." for one in unused[:_NAMED]
    ]
    if len(unused) > _NAMED:
        notes.append(f"{len(unused) - _NAMED} further positions are not used for such reasons.")
    if caution := same_place([one.position for one in photographs]):
        notes.append(caution)
    sources = {one.height_source for one in photographs if one.position is not None}
    few = f", or fewer than {POSITIONS_MIN} photographs have one"
    if _ABOVE_TAKEOFF in sources:
        notes.append(
            f"EXIF has no GPSAltitude{few}: heights are those above the takeoff point "
            "(RelativeAltitude of XMP), and all heights of the block are, unless control places "
            "it (--points)."
        )
    elif "" in sources:
        notes.append(
            f"EXIF has no GPSAltitude{few}: all heights are taken as 0 m, as of level flight. "
            "Heights of the block are below the flight, unless control places it (--points)."
        )
    else:
        notes.append(
            "EXIF does not state which heights GPSAltitude has; they are taken as ellipsoidal."
        )
    return tuple(notes)
