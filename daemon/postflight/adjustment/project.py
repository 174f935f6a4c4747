"""Reading an adjustment project: `project.toml` and its tables become a network.

The format is described in docs/reference/formats.md. Coordinates without a value are NaN in the
network and found by `processing.bundle.initial_values`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon.mission.foreign_files import ForeignFileError, within
from daemon.postflight.adjustment.csv_tables import CsvTable, ProjectError, read_table
from daemon.postflight.adjustment.heads_and_motion import KNOWN, NEEDED, head_of, motion_of
from daemon.postflight.adjustment.patterns_file import patterns_of_project
from daemon.postflight.adjustment.plausibility import (
    check_control,
    check_distances,
    check_format,
    check_image_points,
    check_observations,
    check_rows,
)
from daemon.postflight.adjustment.project_camera import camera_of
from daemon.postflight.adjustment.project_file import ProjectFile, read_project_file
from daemon.postflight.adjustment.repeated_measurements import (
    check_repeated_images,
    repeated_points,
)
from daemon.postflight.adjustment.sigma_bounds import (
    check_coordinates,
    check_degrees,
    check_distance_sigmas,
    check_image_sigmas,
    check_metres,
    extent_m,
)
from processing.bundle.adjust import AdjustmentSettings
from processing.bundle.curvature_refraction import RayModel
from processing.bundle.network import (
    Attitudes,
    CameraModel,
    Distances,
    Gnss,
    ImagePoints,
    Images,
    LinearConstraint,
    MeasuredAttitudes,
    Motion,
    Network,
    Points,
    Stations,
    no_distances,
    no_gnss,
    no_measured_attitudes,
)
from processing.geometry.rotation import rotation_matrix

Array = NDArray[np.float64]

XYZ = ("x_m", "y_m", "z_m")
SIGMAS = ("sx_m", "sy_m", "sz_m")
ANGLES = ("omega_deg", "phi_deg", "kappa_deg")
AXIS_SIGMAS = ("sx_deg", "sy_deg", "sz_deg")


@dataclass(frozen=True)
class CheckPoints:
    """Independent coordinates of object points: names, (n, 3) m, sigmas (n, 3) m."""

    names: tuple[str, ...]
    xyz_m: Array
    sigma_m: Array


@dataclass(frozen=True)
class Project:
    """A network, the settings of its adjustment, its check points, and what is suspicious."""

    name: str
    file: ProjectFile
    network: Network
    settings: AdjustmentSettings
    checks: CheckPoints
    cautions: tuple[str, ...] = ()


def read_project(path: Path) -> Project:
    """Read a project file and its tables.

    Raises:
        ProjectError: with a sentence per mistake.
    """
    file = read_project_file(path)
    folder = path.parent
    problems: list[str] = []
    cameras = tuple(camera_of(section, folder, problems) for section in file.camera)
    heads = tuple(head_of(section) for section in file.head)
    images = _read(folder, file.files.images, ("image", "camera"), ("exposure", "head", *ANGLES))
    exposures = _optional(
        folder, file.files.exposures, ("exposure",), (*XYZ, *ANGLES, "position", "attitude")
    )
    points = _optional(folder, file.files.points, ("point",), (*XYZ, *SIGMAS, "role"))
    seen = _read(
        folder,
        file.files.image_points,
        ("image", "point"),
        ("x_mm", "y_mm", "column_px", "row_px", "sx_um", "sy_um"),
    )
    build = _TableIndex(images, exposures, seen, points, problems)
    check_rows(images, is_needed=True)
    for table in (exposures, points):
        if table is not None:
            check_rows(table)
    reported = [problem for t in build.tables for problem in t.problems]
    if reported:
        # Names that are not unique fit no index: further mistakes cannot be found yet.
        raise ProjectError(reported)
    network = Network(
        cameras=cameras,
        heads=heads,
        stations=build.stations(),
        attitudes=build.attitudes(),
        images=build.images(file),
        points=build.points(),
        image_points=build.image_points(file, cameras),
        distances=_distances(folder, file, build),
        gnss=_gnss(folder, file, build),
        measured_attitudes=_bearings(folder, file, build),
        constraints=tuple(LinearConstraint(dict(c.coefficients)) for c in file.constraint),
        motion=_motion(folder, file, build),
        rays=RayModel(file.adjust.earth_radius_m, file.adjust.refraction, file.adjust.ground_m),
        patterns=patterns_of_project(folder, file.files.patterns, build.image_names, problems),
    )
    build.check(network, file)
    problems += [p for table in build.tables for p in table.problems]
    if problems:
        raise ProjectError(problems)
    a = file.adjust
    settings = AdjustmentSettings(
        max_iterations=a.max_iterations,
        robust=a.robust,
        weight_function=a.weight_function,
        reject_beyond=a.reject_beyond,
        significance=a.significance,
        test=a.test,
        power=a.power,
        max_rounds=a.max_rounds,
        variance_components=a.variance_components,
        minimum_norm=a.minimum_norm,
        free_datum=a.free_datum,
        datum_names=a.datum_names,
    )
    remarks = [sentence for table in build.tables for sentence in table.remark_sentences()]
    cautions = (*remarks, *build.cautions)
    return Project(file.name, file, network, settings, build.checks(), cautions)


class _TableIndex:
    """Tables by name, and the indices of what they name."""

    def __init__(
        self, images: CsvTable, exposures: CsvTable | None, seen: CsvTable, points: CsvTable | None,
        problems: list[str],
    ) -> None:  # fmt: skip
        self.tables = [t for t in (images, exposures, seen, points) if t is not None]
        self.problems = problems
        self.cautions: list[str] = []
        self._images, self._exposures, self._seen, self._points = images, exposures, seen, points
        self.image_names = images.names("image")
        listed = exposures.names("exposure") if exposures is not None else []
        of_image = [
            given or name
            for given, name in zip(images.text("exposure"), self.image_names, strict=True)
        ]
        self.exposure_names = list(dict.fromkeys([*listed, *of_image]))
        self._exposure_of_image = of_image
        self._own = np.array([images.numbers(c) for c in ANGLES]).T.reshape(-1, 3)
        self._has_own = np.isfinite(self._own).all(axis=1)
        own = [n for n, has in zip(self.image_names, self._has_own, strict=True) if has]
        needing = dict.fromkeys(
            e for e, has in zip(of_image, self._has_own, strict=True) if not has
        )
        self.attitude_names = [*needing, *(f"image {name}" for name in own)]
        roles = points.text("role", "tie") if points is not None else []
        listed_points = points.names("point") if points is not None else []
        self.point_names = list(dict.fromkeys([*listed_points, *seen.text("point")]))
        self._roles = roles
        self.exposure_at = {name: k for k, name in enumerate(self.exposure_names)}
        self.attitude_at = {name: k for k, name in enumerate(self.attitude_names)}
        self.image_at = {name: k for k, name in enumerate(self.image_names)}
        self.point_at = {name: k for k, name in enumerate(self.point_names)}

    @property
    def extent_m(self) -> float:
        """Of exposures and object points."""
        return extent_m(self._exposures, self._points)

    def index(
        self, table: CsvTable, column: str, at: dict[str, int], what: str
    ) -> NDArray[np.int64]:
        found = []
        for name, line in zip(table.text(column), table.lines, strict=True):
            if name not in at:
                table.add_problem(line, f"{what} {name!r} is not there")
            found.append(at.get(name, 0))
        return np.array(found, dtype=np.int64)

    def stations(self) -> Stations:
        n = len(self.exposure_names)
        position = np.full((n, 3), np.nan)
        held = np.zeros(n, dtype=bool)
        table = self._exposures
        if table is not None:
            at = self.index(table, "exposure", self.exposure_at, "exposure")
            position[at] = np.array([table.numbers(c) for c in XYZ]).T.reshape(-1, 3)
            held[at] = self._held(table, "position")
            check_coordinates(table, XYZ)
        return Stations(tuple(self.exposure_names), position, held)

    def attitudes(self) -> Attitudes:
        n = len(self.attitude_names)
        rotation = np.full((n, 3, 3), np.nan)
        held = np.zeros(n, dtype=bool)
        table = self._exposures
        if table is not None:
            angles = np.array([table.numbers(c) for c in ANGLES]).T.reshape(-1, 3)
            fixed = self._held(table, "attitude")
            for name, own, hold in zip(table.text("exposure"), angles, fixed, strict=True):
                if name in self.attitude_at:
                    rotation[self.attitude_at[name]] = _rotation(own)
                    held[self.attitude_at[name]] = hold
        for name, own, has in zip(self.image_names, self._own, self._has_own, strict=True):
            if has:
                rotation[self.attitude_at[f"image {name}"]] = _rotation(own)
        return Attitudes(tuple(self.attitude_names), rotation, held)

    def images(self, file: ProjectFile) -> Images:
        table = self._images
        cameras = {c.name: k for k, c in enumerate(file.camera)}
        heads = {"": -1, **{h.name: k for k, h in enumerate(file.head)}}
        station = [self.exposure_at[e] for e in self._exposure_of_image]
        attitude = [
            self.attitude_at[f"image {name}" if has else exposure]
            for name, exposure, has in zip(
                self.image_names, self._exposure_of_image, self._has_own, strict=True
            )
        ]
        return Images(
            tuple(self.image_names),
            np.array(station, dtype=np.int64),
            np.array(attitude, dtype=np.int64),
            self.index(table, "camera", cameras, "camera"),
            self.index(table, "head", heads, "head"),
        )

    def points(self) -> Points:
        n = len(self.point_names)
        xyz, sigma = np.full((n, 3), np.nan), np.full((n, 3), np.nan)
        with_coordinates = np.zeros(n, dtype=bool)
        table = self._points
        if table is not None:
            given = np.array([table.numbers(c) for c in XYZ]).T.reshape(-1, 3)
            own = np.array([table.numbers(c) for c in SIGMAS]).T.reshape(-1, 3)
            for k, role in enumerate(self._roles):
                if role not in ("tie", "control", "check", "direction"):
                    table.add_problem(
                        table.lines[k],
                        f"role is {role!r}; one of tie, control, check, direction is right",
                    )
                xyz[k] = given[k] if role != "check" else np.nan
                sigma[k] = own[k] if role in ("control", "direction") else np.nan
                with_coordinates[k] = role == "direction"
                if role in ("control", "direction") and not np.isfinite(given[k]).any():
                    table.add_problem(table.lines[k], f"a {role} point needs coordinates")
                if (own[k] < 0.0).any():
                    table.add_problem(
                        table.lines[k], "a sigma is negative; 0 holds, empty leaves free"
                    )
            check_coordinates(table, XYZ)
            # A coordinate that is not known is no control, whatever sigma it has.
            sigma[: len(given)] = np.where(np.isfinite(given), sigma[: len(given)], np.nan)
        return Points(tuple(self.point_names), xyz, sigma, with_coordinates)

    def checks(self) -> CheckPoints:
        table = self._points
        if table is None:
            return CheckPoints((), np.zeros((0, 3)), np.zeros((0, 3)))
        rows = [k for k, role in enumerate(self._roles) if role == "check"]
        given = np.array([table.numbers(c) for c in XYZ]).T.reshape(-1, 3)
        own = np.array([table.numbers(c, 0.0) for c in SIGMAS]).T.reshape(-1, 3)
        return CheckPoints(tuple(self.point_names[k] for k in rows), given[rows], own[rows])

    def image_points(self, file: ProjectFile, cameras: Sequence[CameraModel]) -> ImagePoints:
        table = self._seen
        image = self.index(table, "image", self.image_at, "image")
        point = self.index(table, "point", self.point_at, "point")
        sigma = np.array(
            [table.numbers(c, file.adjust.image_sigma_um) for c in ("sx_um", "sy_um")]
        ).T.reshape(-1, 2)
        if table.has("x_mm") and table.has("y_mm"):
            xy = np.array([table.numbers("x_mm"), table.numbers("y_mm")]).T.reshape(-1, 2)
        elif table.has("column_px") and table.has("row_px"):
            px = np.array([table.numbers("column_px"), table.numbers("row_px")]).T.reshape(-1, 2)
            xy = self._from_pixels(file, image, px)
        else:
            self.problems.append(
                f"{table.file}: columns x_mm, y_mm or column_px, row_px are needed"
            )
            xy = np.zeros((len(table.rows), 2))
        for row in np.flatnonzero(~np.isfinite(xy).all(axis=1)):
            table.add_problem(table.lines[row], "an image point needs both coordinates")
        return ImagePoints(image, point, np.nan_to_num(xy), sigma * 1e-3)

    def check(self, network: Network, file: ProjectFile) -> None:
        """Report what cannot be right although it can be read."""
        if self.problems or any(table.problems for table in self.tables):
            return
        check_image_sigmas(self._seen)
        seen, at_infinity = network.image_points, network.points.at_infinity
        check_repeated_images(self._seen, seen, at_infinity)
        self.cautions += repeated_points(self._seen, seen)
        check_image_points(self._seen, seen, network.images, network.cameras)
        if not self._seen.problems:
            check_format(self._seen, seen, network.images, file.camera)
        if self._points is not None:
            known = [k for k, r in enumerate(self._roles) if r in ("control", "direction")]
            known = [k for k in known if not network.points.at_infinity[k]]
            check_metres(self._points, SIGMAS, self.extent_m, known)
            check_control(self._points, self._roles, network.points.xyz_m[: len(self._roles)])

    def _from_pixels(self, file: ProjectFile, image: NDArray[np.int64], px: Array) -> Array:
        camera_at = {c.name: c for c in file.camera}
        names = self._images.text("camera")
        xy = np.zeros_like(px)
        reported: set[str] = set()
        for k in np.unique(image):
            camera = camera_at.get(names[k])
            if camera is None:
                continue
            if camera.pixel_um is None or camera.width_px is None or camera.height_px is None:
                if camera.name not in reported:
                    reported.add(camera.name)
                    self.problems.append(
                        f"camera {camera.name}: pixel coordinates need pixel_um, width_px and "
                        "height_px"
                    )
                continue
            rows, pitch = image == k, camera.pixel_um * 1e-3
            xy[rows, 0] = (px[rows, 0] - (camera.width_px - 1) / 2.0) * pitch
            xy[rows, 1] = ((camera.height_px - 1) / 2.0 - px[rows, 1]) * pitch
        return xy

    def _held(self, table: CsvTable, column: str) -> NDArray[np.bool_]:
        found = []
        for value, line in zip(table.text(column, "free"), table.lines, strict=True):
            if value not in ("free", "held"):
                table.add_problem(line, f"{column} is {value!r}; free or held is right")
            found.append(value == "held")
        return np.array(found, dtype=bool)


def _rotation(angles_deg: Array) -> Array:
    return rotation_matrix(*np.radians(angles_deg))


def _optional(
    folder: Path, name: str | None, needed: Sequence[str], known: Sequence[str]
) -> CsvTable | None:
    return None if name is None else _read(folder, name, needed, known)


def _read(folder: Path, name: str, needed: Sequence[str], known: Sequence[str]) -> CsvTable:
    try:
        return read_table(within(folder, name, "project.toml: files"), needed, known)
    except ForeignFileError as error:
        raise ProjectError([str(error)]) from error


def _distances(folder: Path, file: ProjectFile, build: _TableIndex) -> Distances:
    table = _optional(
        folder, file.files.distances, ("point_a", "point_b", "distance_m", "sigma_m"), ()
    )
    if table is None:
        return no_distances()
    build.tables.append(table)
    check_distances(table)
    check_distance_sigmas(table)
    return Distances(
        build.index(table, "point_a", build.point_at, "point"),
        build.index(table, "point_b", build.point_at, "point"),
        np.array(table.numbers("distance_m")),
        np.array(table.sigmas("sigma_m")),
    )


def _gnss(folder: Path, file: ProjectFile, build: _TableIndex) -> Gnss:
    lever = ("lever_x_m", "lever_y_m", "lever_z_m")
    table = _optional(
        folder, file.files.gnss, ("exposure", *XYZ, *SIGMAS), ("line", "time_s", *lever)
    )
    if table is None:
        return no_gnss()
    build.tables.append(table)
    levers = np.array([table.numbers(c, 0.0) for c in lever]).T.reshape(-1, 3)
    # Several antennas of an exposure differ in their lever arms.
    check_observations(
        table,
        SIGMAS,
        [
            f"the antenna position of exposure {name}" + f", lever arm {own}" * bool(own.any())
            for name, own in zip(table.text("exposure"), levers, strict=True)
        ],
    )
    check_coordinates(table, XYZ)
    check_metres(table, SIGMAS, max(build.extent_m, extent_m(table)))
    station = build.index(table, "exposure", build.exposure_at, "exposure")
    attitude = np.array([build.attitude_at.get(n, -1) for n in table.text("exposure")])
    for row in np.flatnonzero((attitude < 0) & (levers != 0.0).any(axis=1)):
        table.add_problem(
            table.lines[row],
            "a lever arm needs an attitude of the exposure; here every image has its own",
        )
    position = np.array([table.numbers(c) for c in XYZ]).T.reshape(-1, 3)
    for row in np.flatnonzero(~np.isfinite(position).all(axis=1)):
        table.add_problem(table.lines[row], "an antenna position needs three coordinates")
    lines = tuple(dict.fromkeys(name for name in table.text("line") if name))
    at = {"": -1, **{name: k for k, name in enumerate(lines)}}
    return Gnss(
        station=station,
        attitude=np.clip(attitude, 0, None).astype(np.int64),
        position_m=position,
        sigma_m=np.array([table.sigmas(c) for c in SIGMAS]).T.reshape(-1, 3),
        lever_m=levers,
        line=build.index(table, "line", at, "line"),
        time_s=np.array(table.numbers("time_s", 0.0)),
        lines=lines,
        drift=file.adjust.gnss,
    )


def _motion(folder: Path, file: ProjectFile, build: _TableIndex) -> Motion | None:
    table = _optional(folder, file.files.motion, NEEDED, KNOWN)
    if table is None:
        return None
    build.tables.append(table)
    return motion_of(table, build.exposure_names)


def _bearings(folder: Path, file: ProjectFile, build: _TableIndex) -> MeasuredAttitudes:
    table = _optional(
        folder, file.files.attitudes, ("exposure", *ANGLES), ("sigma_deg", *AXIS_SIGMAS)
    )
    if table is None:
        return no_measured_attitudes()
    build.tables.append(table)
    own = AXIS_SIGMAS if any(table.has(c) for c in AXIS_SIGMAS) else ("sigma_deg",) * 3
    if table.has("sigma_deg") and table.has(own[0]) and own is AXIS_SIGMAS:
        table.add_problem(table.header, "sigma_deg, or sx_deg, sy_deg and sz_deg; not both")
    names = [f"the attitude of exposure {name}" for name in table.text("exposure")]
    check_observations(table, tuple(dict.fromkeys(own)), names)
    check_degrees(table, tuple(dict.fromkeys(own)))
    angles = np.array([table.numbers(c) for c in ANGLES]).T.reshape(-1, 3)
    return MeasuredAttitudes(
        build.index(table, "exposure", build.attitude_at, "attitude of exposure"),
        np.array([_rotation(a) for a in angles]).reshape(-1, 3, 3),
        np.radians(np.array([table.sigmas(c) for c in own]).T.reshape(-1, 3)),
    )
