"""Rig files: read, validated with all mistakes at once, and found by name."""

from __future__ import annotations

import datetime
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from processing.rig.model import (
    CALIBRATION_VALID_DAYS,
    Cone,
    Lens,
    LensGrid,
    Rig,
    Sensor,
    ThermalDrift,
    VirtualImage,
)
from processing.rig.toml_table import RigError, TomlTable
from processing.rig.toml_text import TomlError, parse_toml

RIG_FORMAT = 1
RIG_FILE_MAX_BYTES = 1_000_000
BANDS = ("pan", "red", "green", "blue", "nir", "red_edge")
SIDE_MAX_PX = 65_535
SENSOR_MAX_PIXELS = 200_000_000
IMAGE_MAX_PIXELS = 500_000_000
CONES_MAX, SENSORS_MAX = 64, 256
PITCH_LIMITS_UM = (0.1, 1000.0)
FOCAL_LIMITS_MM = (0.1, 100_000.0)
EXPOSURE_OFFSET_LIMITS_NS = (-10_000_000_000, 10_000_000_000)
JUSTIFICATIONS = ("right", "left")
MAX_SKEW_PPM_PER_MM = 1000.0
COLOUR_FILTER_ARRAYS = ("none", "RGGB", "BGGR", "GRBG", "GBRG")


def shipped_rigs() -> dict[str, Path]:
    """Rig files that come with the package, by name."""
    return {path.stem: path for path in sorted((Path(__file__).parent / "files").glob("*.toml"))}


def find_rig(name_or_path: str) -> Rig:
    """Load a shipped rig by its name, or any rig file by its path.

    Raises:
        RigError: no such rig, or a file with mistakes (all of them listed).
    """
    shipped = shipped_rigs()
    if name_or_path in shipped:
        return load_rig(shipped[name_or_path])
    path = Path(name_or_path)
    if path.suffix == ".toml" or path.exists():
        return load_rig(path)
    known = ", ".join(shipped)
    raise RigError([f"rig {name_or_path!r} is neither a file nor one of: {known}"])


def load_rig(path: Path) -> Rig:
    """Read and validate a rig file.

    Raises:
        RigError: with one sentence per mistake: file, key, value, and what would be right.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise RigError([f"{path}: not a regular file; give a rig file"])
        if status.st_size > RIG_FILE_MAX_BYTES:
            raise RigError([f"{path.name}: larger than {RIG_FILE_MAX_BYTES} bytes; not a rig file"])
        content = parse_toml(path.read_bytes())
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise RigError([f"{path}: cannot be read ({reason}); give a readable file"]) from error
    except TomlError as error:
        raise RigError([f"{path.name}: not valid TOML ({error})"]) from error
    return rig_from_mapping(content, path.name)


def rig_from_mapping(content: Mapping[str, Any], file: str) -> Rig:
    """Build a rig from parsed TOML; `file` names it in the error sentences."""
    problems: list[str] = []
    top = TomlTable(content, "", file, problems)
    if top.integer("format", RIG_FORMAT) != RIG_FORMAT:
        top.add_problem("format", f"this version reads format {RIG_FORMAT}")
    defaults = top.table("defaults", optional=True)
    calibration = top.table("calibration")
    image = top.table("virtual_image", optional=True)
    probes = top.table("probe_serials", optional=True)
    rig = Rig(
        name=top.name("name"),
        title=top.text("title", ""),
        timing="synchronous"
        if top.choice("timing", ("syntopic", "synchronous")) == "synchronous"
        else "syntopic",
        frame_interval_s=top.number("frame_interval_s", positive=True),
        master_cone=top.text("master_cone", "") or None,
        colour_master_cone=top.text("colour_master_cone", "") or None,
        reference_cone=top.text("reference_cone"),
        calibration_id=calibration.text("id"),
        calibration_date=_date(calibration),
        calibration_valid_days=calibration.integer(
            "valid_days", CALIBRATION_VALID_DAYS, positive=True
        ),
        virtual_image=_virtual_image(image) if image.content else None,
        cones=tuple(_cone(cone, defaults) for cone in top.tables("cone")),
        probe_serials={name: probes.text(name) for name in probes.content},
    )
    for table in (defaults, calibration, image, top):
        table.refuse_unknown()
    _check_names(rig, file, problems)
    if problems:
        raise RigError(problems)
    return rig


def _date(calibration: TomlTable) -> str:
    text = calibration.text("date")
    try:
        datetime.date.fromisoformat(text or "2000-01-01")
    except ValueError:
        calibration.add_problem("date", "write YYYY-MM-DD")
    return text


def _virtual_image(table: TomlTable) -> VirtualImage:
    width_px, height_px = _size(table, IMAGE_MAX_PIXELS)
    image = VirtualImage(
        width_px=width_px,
        height_px=height_px,
        pitch_um=table.number("pitch_um", positive=True, limits=PITCH_LIMITS_UM),
        f_mm=table.number("f_mm", positive=True, limits=FOCAL_LIMITS_MM),
        colour_ratio=_colour_ratio(table),
    )
    if not 1 <= image.colour_width_px * image.colour_height_px <= IMAGE_MAX_PIXELS:
        table.add_problem("colour_ratio", f"the colour image has 1 to {IMAGE_MAX_PIXELS} pixels")
    return image


def _size(table: TomlTable, pixels_max: int) -> tuple[int, int]:
    """Width and height, so that no file asks for more memory than a camera needs."""
    width_px, height_px = (
        table.integer(key, positive=True, limits=(1, SIDE_MAX_PX))
        for key in ("width_px", "height_px")
    )
    if width_px * height_px > pixels_max:
        table.add_problem("width_px", f"width times height is {pixels_max} pixels at most")
    return width_px, height_px


def _colour_ratio(table: TomlTable) -> float:
    """A whole ratio stays whole; another one divides the image without rest."""
    ratio = table.number("colour_ratio", 1, positive=True)
    if ratio == int(ratio):
        return int(ratio)
    for key in ("width_px", "height_px"):
        size = table.content.get(key)
        if isinstance(size, int) and abs(size / ratio - round(size / ratio)) > 1e-6:
            table.add_problem(key, f"at a colour_ratio of {ratio:g} it is a whole number of them")
    return ratio


def _cone(table: TomlTable, defaults: TomlTable) -> Cone:
    probe = table.text("probe")
    calibration_c = table.number("calibration_c")
    bands = table.texts("bands")
    for band in bands:
        if band not in BANDS:
            table.add_problem("bands", f"a band is one of {', '.join(BANDS)}")
    lens_defaults = defaults.table("lens", optional=True)
    sensor_defaults = defaults.table("sensor", optional=True)
    lens = table.table("lens").with_defaults(lens_defaults)
    sensors = [s.with_defaults(sensor_defaults) for s in table.tables("sensor")]
    cone = Cone(
        name=table.name("name"),
        role="pan" if table.choice("role", ("pan", "colour")) == "pan" else "colour",
        bands=bands,
        position_mm=table.triple("position_mm"),
        rotation_rad=table.triple("rotation_rad"),
        rotation_sigma_urad=table.number("rotation_sigma_urad", 30.0, positive=True),
        probe=probe,
        calibration_c=calibration_c,
        mark_to_mid_exposure_ns=table.integer(
            "mark_to_mid_exposure_ns", 0, limits=EXPOSURE_OFFSET_LIMITS_NS
        ),
        mark_to_mid_exposure_sigma_ns=table.integer(
            "mark_to_mid_exposure_sigma_ns", 1000, limits=(0, EXPOSURE_OFFSET_LIMITS_NS[1])
        ),
        lens=_lens(lens),
        sensors=tuple(_sensor(sensor, probe, calibration_c) for sensor in sensors),
    )
    table.refuse_unknown()
    return cone


def _lens(table: TomlTable) -> Lens:
    direction = table.text("direction", "ideal_from_measured")
    if direction != "ideal_from_measured":
        table.add_problem("direction", "a lens correction here is ideal_from_measured")
    number = table.number
    lens = Lens(
        f_mm=number("f_mm", positive=True, limits=FOCAL_LIMITS_MM),
        f_ppm_per_k=number("f_ppm_per_k", 0.0),
        f_sigma_ppm=number("f_sigma_ppm", 20.0, positive=True),
        f_number=number("f_number", 5.6, positive=True),
        serial=table.text("serial", ""),
        dx0_mm=number("dx0_mm", 0.0),
        dy0_mm=number("dy0_mm", 0.0),
        df_mm=number("df_mm", 0.0),
        k1=number("k1", 0.0),
        k2=number("k2", 0.0),
        k3=number("k3", 0.0),
        p1=number("p1", 0.0),
        p2=number("p2", 0.0),
        b1=number("b1", 0.0),
        b2=number("b2", 0.0),
        residual_grid=_lens_grid(table.table("residual_grid", optional=True)),
    )
    table.refuse_unknown()
    return lens


def _lens_grid(table: TomlTable) -> LensGrid | None:
    if not table.content:
        return None
    x_mm, y_mm = table.steps("x_mm"), table.steps("y_mm")
    grid = LensGrid(
        x_mm,
        y_mm,
        table.matrix("dx_um", len(y_mm), len(x_mm)),
        table.matrix("dy_um", len(y_mm), len(x_mm)),
    )
    table.refuse_unknown()
    return grid


def _sensor(table: TomlTable, probe: str, calibration_c: float) -> Sensor:
    drift = table.table("drift", optional=True)
    sign = table.integer("tdi_row_sign", 1)
    if sign not in (-1, 1):
        table.add_problem("tdi_row_sign", "it is 1 (charge moves to higher rows) or -1")
    bits = table.integer("bits", 12, positive=True)
    if bits > 16:
        table.add_problem("bits", "a pixel has at most 16 bits")
    width_px, height_px = _size(table, SENSOR_MAX_PIXELS)
    sensor = Sensor(
        name=table.name("name"),
        serial=table.text("serial", ""),
        width_px=width_px,
        height_px=height_px,
        pitch_um=table.number(
            "pitch_um",
            positive=True,
            requirement="a pixel pitch is positive",
            limits=PITCH_LIMITS_UM,
        ),
        x_mm=table.number("x_mm"),
        y_mm=table.number("y_mm"),
        rotation_rad=table.number("rotation_rad", 0.0),
        scale=table.number("scale", 1.0, positive=True),
        position_sigma_um=table.number("position_sigma_um", 0.0),
        calibration_c=table.number("calibration_c", calibration_c),
        probe=table.text("probe", probe),
        drift=ThermalDrift(
            x_um_per_k=drift.number("x_um_per_k", 0.0),
            y_um_per_k=drift.number("y_um_per_k", 0.0),
            rotation_urad_per_k=drift.number("rotation_urad_per_k", 0.0),
            scale_ppm_per_k=drift.number("scale_ppm_per_k", 0.0),
            sigma_um_per_k=drift.number("sigma_um_per_k", 0.0),
            lag_s=drift.number("lag_s", 0.0),
        ),
        bits=bits,
        black_dn=table.number("black_dn", 0.0),
        electrons_per_dn=table.number("electrons_per_dn", 1.0, positive=True),
        read_noise_e=table.number("read_noise_e", 0.0),
        colour_filter_array=table.choice("colour_filter_array", COLOUR_FILTER_ARRAYS, "none"),
        tdi_row_sign=sign,
        justified=table.choice("justified", JUSTIFICATIONS, "right"),
        skew_x_ppm_per_mm=_skew(table, "skew_x_ppm_per_mm"),
        skew_y_ppm_per_mm=_skew(table, "skew_y_ppm_per_mm"),
    )
    drift.refuse_unknown()
    table.refuse_unknown()
    return sensor


def _skew(table: TomlTable, key: str) -> float:
    skew = table.number(key, 0.0)
    if abs(skew) > MAX_SKEW_PPM_PER_MM:
        table.add_problem(key, f"a skew is {MAX_SKEW_PPM_PER_MM:g} ppm/mm at most")
    return skew


def _check_names(rig: Rig, file: str, problems: list[str]) -> None:
    cones = [cone.name for cone in rig.cones]
    sensors = [sensor.name for sensor in rig.sensors]
    for kind, names, most in (("cone", cones, CONES_MAX), ("sensor", sensors, SENSORS_MAX)):
        if len(names) > most:
            problems.append(f"{file}: {len(names)} {kind}s; a rig has {most} at most")
            continue
        twice = dict.fromkeys(name for name in names if names.count(name) > 1)
        problems.extend(f"{file}: {kind} name {n!r} is used twice; names are unique" for n in twice)
    for key in ("master_cone", "colour_master_cone", "reference_cone"):
        name = getattr(rig, key)
        if name is not None and name not in cones:
            listed = ", ".join(cones) or "none"
            problems.append(f"{file}: {key} is {name!r}; it names a cone of this rig: {listed}")
    if rig.master_cone is None:
        problems.extend(_master_missing(rig, file))
    problems.extend(
        f"{file}: cone {cone.name!r} has no sensor; give it [[cone.sensor]]"
        for cone in rig.cones
        if not cone.sensors
    )
    problems.extend(
        f"{file}: probe_serials.{name} is of no probe here: {', '.join(rig.probes) or 'none'}"
        for name in rig.probe_serials
        if name not in rig.probes
    )
    problems.extend(
        f"{file}: sensor {sensor.name!r} is left-justified; a rig with [virtual_image] has "
        f"right-justified words"
        for sensor in rig.sensors
        if rig.virtual_image is not None and sensor.justified == "left"
    )


def _master_missing(rig: Rig, file: str) -> list[str]:
    """Only heads that converge, all at one instant, do without a master cone."""
    missing = f"{file}: master_cone is missing; it names the cone whose layer is the virtual image"
    if rig.virtual_image is None or len(rig.pan_cones) < 2:
        return [missing]
    if rig.timing != "synchronous":
        return [f"{missing}. Only a synchronous rig of converging PAN heads has none"]
    return []
