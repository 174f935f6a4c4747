"""A mission's block as a folder for one program: its files, the images, and what they state.

One folder a program, `export/block/<program>/`, replaced as a whole; images of a stitched rig other
than PAN have a folder each, such as `export/block/<program>-rgbn/`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

from daemon.mission.layout import Mission
from daemon.mission.store.direct_io import create_file
from daemon.mission.store.durable import make_directories, sync_directory, sync_file
from daemon.mission.store.output_places import refuse_foreign_files
from daemon.mission.store.publication import published
from daemon.postflight.exchange.block import (
    FIT_LIMIT_PX,
    Block,
    BlockError,
    BlockImage,
    BlockRig,
    rig_of,
    with_rig,
)
from daemon.postflight.exchange.colmap import VERSION as COLMAP_VERSION
from daemon.postflight.exchange.colmap import colmap_texts
from daemon.postflight.exchange.colmap_database import write_database
from daemon.postflight.exchange.metashape import metashape_texts
from daemon.postflight.exchange.mission_block import MissionBlock
from daemon.postflight.exchange.nerfstudio import nerfstudio_texts
from daemon.postflight.exchange.opensfm import opensfm_texts
from daemon.postflight.exchange.photogrammetry import (
    DEFAULTS,
    Angles,
    Unit,
    photogrammetry_texts,
    table_texts,
)
from daemon.postflight.exchange.pix4d import pix4d_texts
from daemon.postflight.export.level2_export import (
    Level2Image,
    jpeg_with_metadata,
    metadata_of,
    rig_place,
)

Program = Literal[
    "colmap",
    "opensfm",
    "metashape",
    "pix4d",
    "nerfstudio",
    "bingo",
    "patb",
    "bluh",
    "imagestation",
    "inpho",
]
PROGRAMS: tuple[Program, ...] = get_args(Program)
WITHOUT_RIG = ("pix4d", "nerfstudio", *DEFAULTS)
RigChoice = Literal["auto", "yes", "no"]
RIG_LIMIT_PX = 0.1
"""Change of attitude between heads, at most, for a rig that is chosen automatically."""
RIG_LIMIT_M = 0.005
SUFFIX = ".jpg"


@dataclass(frozen=True)
class ExportedBlock:
    """The folder, its block, and what was found: residuals of fits in px, the rig, priors."""

    folder: Path
    block: Block
    residuals_px: Mapping[str, float]
    rig: BlockRig | None
    rig_reason: str
    priors: int
    about: Mapping[str, Any]


def export_block(
    mission: Mission,
    read: MissionBlock,
    program: Program,
    *,
    rig: RigChoice = "auto",
    database: bool = False,
    images: bool = True,
    angles: Angles | None = None,
    unit: Unit | None = None,
    progress: Callable[[int], None] = lambda _done: None,
) -> ExportedBlock:
    """Write a block for a program, in place of an earlier one.

    Args:
        read: the block of the mission.
        rig: whether heads share a rig; "auto" where attitudes hardly change between them.
        database: COLMAP's database as well, with position priors.
        angles: order of angles for programs that read angles; None is the program's own.
        unit: of these angles; None is the program's own.
        images: copies of the images as JPEG with EXIF and XMP.
        progress: called with the number of images written.

    Raises:
        BlockError: a camera does not fit the program's models, or a rig cannot be stated.
        MissingExtraError: pycolmap is not installed.
        OutputPlaceError: the folder holds something else, such as results of the program.
        OSError: the disk refused.
    """
    block, chosen, reason = _rigged(read, rig, program)
    if program in DEFAULTS:
        texts = photogrammetry_texts(program, block, SUFFIX, angles, unit)
        residuals = {camera.name: 0.0 for camera in block.cameras}
    elif angles is not None or unit is not None:
        raise BlockError(f"{program} has angles of its own; leave --angles and --unit out")
    else:
        texts, residuals = _texts(program, block, chosen)
    about = _about(read, block, program, chosen, reason, residuals)
    name = program if read.stitched == "pan" else f"{program}-{read.stitched}"
    folder = mission.export_dir / "block" / name
    refuse_foreign_files(folder, _own_files(texts))
    priors = 0
    with published(folder) as part:
        for name, text in {**texts, "about.json": json.dumps(about, indent=1) + "\n"}.items():
            path = part / name
            make_directories(path.parent)
            create_file(path, [text.encode("utf-8")], mode=0o644)
        if program == "colmap" and database:
            priors = write_database(part / "database.db", _with_suffix(block), chosen)
            sync_file(part / "database.db")
        if images:
            (part / "images").mkdir()
            tagged = chosen or _rigid_heads(read, rig)
            names_bands = program != "opensfm" or _is_one_camera_a_band(block)
            for done, image in enumerate(block.images, 1):
                data = picture_of(read, block, image, rig=tagged, names_bands=names_bands)
                create_file(part / "images" / (image.name + SUFFIX), [data], mode=0o644)
                progress(done)
            sync_directory(part / "images")
    return ExportedBlock(folder, block, residuals, chosen, reason, priors, about)


def _own_files(texts: Mapping[str, str]) -> re.Pattern[str]:
    """Matches what an export to the program writes; tables of a rig are not in each."""
    folders = {name.rpartition("/")[0] for name in texts}
    tables = [rf"{re.escape(folder)}/[^/]+\.txt" for folder in folders if folder]
    names = [re.escape(name) for name in texts]
    others = [r"rig_(cameras|assignments)\.json", r"about\.json", r"database\.db", r"[^/]+\.cam"]
    return re.compile("|".join([*names, *tables, *others, rf"images/.*{re.escape(SUFFIX)}"]))


def picture_of(
    read: MissionBlock,
    block: Block,
    image: BlockImage,
    *,
    rig: BlockRig | None = None,
    names_bands: bool = True,
) -> bytes:
    """An image as 8-bit JPEG with EXIF and XMP; a raw frame of a Bayer head in its colours.

    Args:
        rig: that of the tags; None writes none.
        names_bands: whether the tags name bands.

    Raises:
        BlockError: the image belongs to no mission.
    """
    camera = block.cameras[image.camera]
    if image.eo is None or image.source is None or camera.pitch_mm is None:
        raise BlockError(f"image {image.name} has no file in the mission")
    f_mm = camera.model.fx_px * camera.pitch_mm
    is_raw = camera.rays is not None
    picture = Level2Image(
        image.source, image.name, image.eo, f_mm, camera.pitch_mm, None, camera.bands,
        (camera.width_px, camera.height_px), is_perspective=not is_raw,
        colour_filter_array=read.rig.sensor(camera.name).colour_filter_array if is_raw else "none",
        principal_point_px=(camera.model.cx_px, camera.model.cy_px) if is_raw else None,
    )  # fmt: skip
    shot = metadata_of(read.rig, picture, read.crs, simulated=read.simulated)
    place = None
    if rig is not None:
        place = rig_place(
            read.rig.title or read.rig.name,
            image.camera,
            rig.reference,
            rig.rotation[image.camera],
            f"{block.name}/{image.frame}",
        )
    # Frames of one size differ in their principal points: programs take one camera a model.
    model = f"{shot.camera} {camera.name}" if is_raw else shot.camera
    shot = replace(shot, rig=place, camera=model)
    if not names_bands:
        shot = replace(shot, bands=(), wavelengths_nm=())
    return jpeg_with_metadata(picture, shot)


def _rigged(
    read: MissionBlock, choice: RigChoice, program: Program
) -> tuple[Block, BlockRig | None, str]:
    """The block as it is written, its rig, and why it has one or none."""
    block = read.block
    if choice == "no" or len(block.cameras) == 1:
        reason = "one camera" if len(block.cameras) == 1 else "not requested"
        return block, None, reason
    if program in WITHOUT_RIG:
        return block, None, f"{program} has no rig in this file"
    reference = _reference(read)
    try:
        rig = rig_of(block, reference)
    except BlockError as error:
        if choice == "yes":
            raise
        return block, None, str(error)
    change = f"{rig.change_px:.3f} px and {rig.change_m * 1e3:.2f} mm between exposures"
    if choice == "auto" and not _is_rigid(rig):
        return block, None, (
            f"heads change against each other by {change}, more than {RIG_LIMIT_PX:g} px or "
            f"{RIG_LIMIT_M * 1e3:g} mm; --rig yes writes a rig nevertheless"
        )  # fmt: skip
    return with_rig(block, rig), rig, f"heads change against each other by {change} at most"


def _is_one_camera_a_band(block: Block) -> bool:
    """Whether no band has two cameras.

    OpenDroneMap registers images of different bands with each other, and refuses bands with
    different numbers of images.
    """
    bands = [band for camera in block.cameras for band in camera.bands]
    return len(set(bands)) == len(bands)


def _rigid_heads(read: MissionBlock, choice: RigChoice) -> BlockRig | None:
    """The rig that tags of images state where the program's files have none."""
    if choice == "no" or len(read.block.cameras) == 1:
        return None
    try:
        rig = rig_of(read.block, _reference(read))
    except BlockError:
        return None
    return rig if choice == "yes" or _is_rigid(rig) else None


def _is_rigid(rig: BlockRig) -> bool:
    return rig.change_px <= RIG_LIMIT_PX and rig.change_m <= RIG_LIMIT_M


def _reference(read: MissionBlock) -> int:
    """The camera of the rig's master cone, else the first."""
    cone = read.rig.image_cone_name
    for index, camera in enumerate(read.block.cameras):
        if camera.name == cone or any(
            sensor.name == camera.name and read.rig.cone_of(sensor.name).name == cone
            for sensor in read.rig.sensors
        ):
            return index
    return 0


def _texts(
    program: Program, block: Block, rig: BlockRig | None
) -> tuple[dict[str, str], dict[str, float]]:
    if program == "colmap":
        named = _with_suffix(block)
        texts, residuals = colmap_texts(named, rig)
        return {f"sparse/{name}": text for name, text in texts.items()}, residuals
    if program == "opensfm":
        return opensfm_texts(block, rig, SUFFIX)
    if program == "metashape":
        return metashape_texts(block, rig, SUFFIX)
    if program == "pix4d":
        texts, residuals = pix4d_texts(block, SUFFIX)
        return texts | table_texts(block, SUFFIX), residuals
    return nerfstudio_texts(block, "images", SUFFIX)


def _with_suffix(block: Block) -> Block:
    images = tuple(replace(image, name=image.name + SUFFIX) for image in block.images)
    return replace(block, images=images)


def _about(
    read: MissionBlock,
    block: Block,
    program: Program,
    rig: BlockRig | None,
    reason: str,
    residuals: Mapping[str, float],
) -> dict[str, Any]:
    frame = block.frame
    about: dict[str, Any] = {
        "format": 1,
        "program": f"COLMAP {COLMAP_VERSION} or later" if program == "colmap" else program,
        "mission": block.name,
        "simulated": read.simulated,
        "calibrated": read.rig.is_calibrated,
        "frame": None if frame is None else frame.name,
        "origin": None
        if frame is None
        else {
            "latitude_deg": frame.latitude_deg,
            "longitude_deg": frame.longitude_deg,
            "height_m": 0.0,
        },
        "crs": read.crs,
        "images": len(block.images),
        "cameras": {
            camera.name: {
                "residual_px": residuals[camera.name],
                "limit_px": FIT_LIMIT_PX,
                "temperature_change_px": camera.drift_px,
            }
            for camera in block.cameras
        },
        "rig": None
        if rig is None
        else {
            "reference": block.cameras[rig.reference].name,
            "change_px": rig.change_px,
            "change_m": rig.change_m,
        },
        "rig_reason": reason,
        "without_accuracy": sum(image.sigma_m is None for image in block.images),
        "missing": list(read.missing),
    }
    return about
