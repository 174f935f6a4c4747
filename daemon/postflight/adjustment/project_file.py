"""Schema of project.toml of an adjustment; docs/reference/formats.md describes it."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from daemon.mission.foreign_files import ForeignFileError, read_regular_file
from daemon.postflight.adjustment.csv_tables import ProjectError
from processing.bundle.critical_values import TestName
from processing.bundle.free_datum import FreeDatum
from processing.bundle.network import INTERIOR, Model
from processing.bundle.robust_weights import WeightFunction
from processing.bundle.self_calibration import SetName
from processing.rig.problem_sentences import findings_of, line_finder, sentences
from processing.rig.toml_text import TomlError, parse_toml

PROJECT_FILE_MAX_BYTES = 4_000_000


class _ProjectSection(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class AdjustSection(_ProjectSection):
    """Settings of the adjustment."""

    robust: bool = False
    weight_function: WeightFunction = "huber"
    reject_beyond: float | None = Field(default=None, gt=1.0)
    significance: float | None = Field(default=None, gt=0.0, lt=1.0)
    test: TestName = "pope"
    power: float = Field(default=0.8, gt=0.0, lt=1.0)
    max_rounds: int = Field(default=100, ge=1, le=10_000)
    variance_components: bool = False
    minimum_norm: bool = False
    free_datum: FreeDatum = "unknowns"
    datum_names: tuple[str, ...] = ()
    max_iterations: int = Field(default=50, ge=1, le=1000)
    image_sigma_um: float = Field(default=1.0, gt=0.0)
    gnss: Literal["none", "shift", "linear"] = "none"
    earth_radius_m: float | None = Field(default=None, gt=1e6)
    refraction: bool = False
    ground_m: float = Field(default=0.0, ge=-12_000.0, le=20_000.0)

    @model_validator(mode="after")
    def _one_limit(self) -> AdjustSection:
        if self.reject_beyond is not None and self.significance is not None:
            raise ValueError("reject_beyond and significance both set the limit; give one of them")
        return self

    @model_validator(mode="after")
    def _datum_of_a_free_network(self) -> AdjustSection:
        if self.datum_names and self.free_datum == "unknowns":
            raise ValueError(
                "datum_names has no effect with free_datum unknowns; points, stations, all or "
                "dependent is right"
            )
        return self


class FilesSection(_ProjectSection):
    """Paths of the tables, relative to the project file."""

    images: str = "images.csv"
    image_points: str = "image_points.csv"
    exposures: str | None = None
    points: str | None = None
    distances: str | None = None
    gnss: str | None = None
    attitudes: str | None = None
    motion: str | None = None
    patterns: str | None = None


class CameraSection(_ProjectSection):
    """A camera."""

    name: str
    f_mm: float = Field(gt=0.0)
    xp_mm: float = 0.0
    yp_mm: float = 0.0
    model: Model = "australis"
    pixel_um: float | None = Field(default=None, gt=0.0)
    width_px: int | None = Field(default=None, gt=0)
    height_px: int | None = Field(default=None, gt=0)
    dx0: float = 0.0
    dy0: float = 0.0
    df: float = 0.0
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    b1: float = 0.0
    b2: float = 0.0
    free: tuple[str, ...] = ()
    sigma: dict[str, float] = {}
    parameters: SetName = "none"
    base_mm: float | None = Field(default=None, gt=0.0)
    interior: bool = False
    rig: str | None = None
    without: tuple[str, ...] = ()
    terms: dict[str, float] = {}

    @field_validator("free")
    @classmethod
    def _known_parameters(cls, free: tuple[str, ...]) -> tuple[str, ...]:
        if foreign := [name for name in free if name not in INTERIOR]:
            raise ValueError(f"{foreign} are not among {', '.join(INTERIOR)}")
        return free


class AdjustmentHeadSection(_ProjectSection):
    """Pose of a camera relative to the others of an exposure."""

    name: str
    omega_deg: float = 0.0
    phi_deg: float = 0.0
    kappa_deg: float = 0.0
    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    rotation: Literal["held", "free"] = "held"
    offset: Literal["held", "free"] = "held"
    rotation_sigma_deg: float | None = Field(default=None, gt=0.0)
    offset_sigma_m: float | None = Field(default=None, gt=0.0)
    delay_ms: float = 0.0
    delay: Literal["held", "free"] = "held"
    delay_sigma_ms: float | None = Field(default=None, gt=0.0)
    readout_ms: float = 0.0
    readout: Literal["held", "free"] = "held"
    readout_sigma_ms: float | None = Field(default=None, gt=0.0)
    frame_height_mm: float | None = Field(default=None, gt=0.0)
    jitter_sigma_ms: float | None = Field(default=None, gt=0.0)


class ConstraintSection(_ProjectSection):
    """Corrections of named unknowns whose weighted sum is zero."""

    coefficients: dict[str, float] = Field(min_length=1)


class ProjectFile(_ProjectSection):
    """project.toml."""

    format: Literal[1]
    name: str
    adjust: AdjustSection = AdjustSection()
    files: FilesSection = FilesSection()
    camera: tuple[CameraSection, ...] = Field(min_length=1)
    head: tuple[AdjustmentHeadSection, ...] = ()
    constraint: tuple[ConstraintSection, ...] = ()


def read_project_file(path: Path) -> ProjectFile:
    """Read and validate project.toml.

    Raises:
        ProjectError: with a sentence per mistake.
    """
    try:
        data = read_regular_file(path, PROJECT_FILE_MAX_BYTES)
        # Editors of Windows begin a file with a byte order mark, which TOML has not.
        content = parse_toml(data.removeprefix(b"\xef\xbb\xbf"))
    except ForeignFileError as error:
        raise ProjectError([f"{error}; give the path of a project.toml"]) from error
    except TomlError as error:
        raise ProjectError([f"{path.name}: not valid TOML: {error}"]) from error
    try:
        return ProjectFile.model_validate(content)
    except ValidationError as error:
        findings = findings_of(error, {"adjust.most_iterations": "max_iterations"})
        raise ProjectError(sentences(findings, path.name, line_finder(data))) from error
