"""`python -m benchmarks.photographs_colmap FOLDER`: photographs oriented by Syntopic and by COLMAP.

Both orient the same photographs without known attitudes, with one camera whose principal point is
held: `syntopic import photographs`, `triangulate` and `adjust`, and pycolmap's features, exhaustive
matching and incremental mapping. Positions are compared after a similarity, which neither
determines from images, in standard deviations of our adjustment with the similarity taken out;
distortion over the image after a common principal distance and shift, which attitude and height
compensate; and the reprojection errors.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import shutil
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typer.testing import CliRunner

from daemon.cli import app
from daemon.cli.benchmark.measurement import machine
from processing.pipelines.perspective import perspective_of, raw_of_perspective
from processing.rig import load_rig

Array = NDArray[np.float64]

FEATURES_MAX = 6000
GRID = (25, 19)


@dataclass(frozen=True)
class OurBlock:
    """Positions (n, 3) in a local frame, their covariance (3n, 3n), pixels of a grid of rays.

    `rays` are x and y of the direction with z = 1, x right and y down, `pixels` column and row.
    """

    names: tuple[str, ...]
    centre_m: Array
    covariance: Array
    rays: Array
    pixels: Array
    f_px: float
    f_sigma_px: float
    reprojection_px: float
    seconds: float


@dataclass(frozen=True)
class Comparison:
    """Differences of two blocks.

    `normalised` is the root of r' C^+ r / rank of all positions, the covariance with the similarity
    taken out; `stations_rms_m` the root mean square difference of a coordinate.
    """

    images: int
    stations_rms_m: float
    sigma_rms_m: float
    normalised: float
    worst_in_sigmas: float
    distortion_rms_px: float
    distortion_worst_px: float


def our_block(photographs: Path, folder: Path) -> OurBlock:
    """Orient photographs by the commands.

    Raises:
        RuntimeError: a command failed.
    """
    begun = time.perf_counter()
    mission = folder / "mission"
    _run("import", "photographs", photographs, "--out", mission)
    report = _run("triangulate", mission)
    seconds = time.perf_counter() - begun
    project = mission / "export/triangulation/photographs"
    archive = folder / "covariance.npz"
    _run("adjust", project, "--covariance", archive)
    found = np.load(archive)
    order = {str(name): k for k, name in enumerate(found["unknowns"])}
    rows = _rows(project / "adjusted_images.csv")
    columns = [order[f"station {row[0]} {axis}"] for row in rows for axis in "XYZ"]
    cone = load_rig(project / "adjusted-rig.toml").cones[0]
    image = perspective_of(cone)
    col, row_ = np.meshgrid(
        np.linspace(0, image.width_px - 1, GRID[0]), np.linspace(0, image.height_px - 1, GRID[1])
    )
    perspective = np.column_stack([col.ravel(), row_.ravel()])
    middle = np.array([(image.width_px - 1) / 2, (image.height_px - 1) / 2])
    photos = report["photographs"]
    return OurBlock(
        tuple(photos["files"][row[0]] for row in rows),
        np.array([[float(v) for v in row[1:4]] for row in rows]),
        found["covariance"][np.ix_(columns, columns)],
        (perspective - middle) * image.pitch_mm / image.f_mm,
        raw_of_perspective(cone, {}, perspective),
        photos["f_px"],
        photos["f_sigma_px"],
        math.hypot(*report["triangulation"]["image_rms_px"]),
        seconds,
    )


def colmap_model(photographs: Path, folder: Path, f_px: float, size: tuple[int, int]) -> Any:
    """The largest reconstruction that pycolmap finds."""
    import pycolmap

    pycolmap.logging.minloglevel = 2
    names = sorted(path.name for path in photographs.iterdir() if path.suffix.lower() == ".jpg")
    database = folder / "colmap.db"
    extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
    extraction.use_gpu = matching.use_gpu = False
    extraction.sift.max_num_features = FEATURES_MAX
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "OPENCV"
    reader.camera_params = f"{f_px},{f_px},{size[0] / 2},{size[1] / 2},0,0,0,0"
    pycolmap.extract_features(
        database,
        photographs,
        image_names=names,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_principal_point = False
    models = pycolmap.incremental_mapping(database, photographs, folder / "sparse", options=options)
    return max(models.values(), key=lambda model: model.num_reg_images())


def compare(ours: OurBlock, model: Any) -> Comparison:
    """Hold our block against COLMAP's."""
    theirs = {image.name: image.projection_center() for image in model.images.values()}
    common = [k for k, name in enumerate(ours.names) if name in theirs]
    here = ours.centre_m[common]
    there = np.array([theirs[ours.names[k]] for k in common])
    rest, jacobian = similarity_residuals(here, there)
    q, _ = np.linalg.qr(jacobian)
    project = np.eye(3 * len(common)) - q @ q.T
    at = np.array([3 * k + axis for k in common for axis in range(3)])
    covariance = project @ ours.covariance[np.ix_(at, at)] @ project
    rank = 3 * len(common) - 7
    inverse = np.linalg.pinv(covariance, rcond=1e-9, hermitian=True)
    sigma = np.sqrt(np.diag(covariance))
    difference = distortion_difference(ours, next(iter(model.cameras.values())))
    return Comparison(
        len(common),
        float(np.sqrt(np.mean(rest**2))),
        float(np.sqrt(np.mean(sigma**2))),
        float(np.sqrt(rest.ravel() @ inverse @ rest.ravel() / rank)),
        float(np.max(np.abs(rest.ravel()) / sigma)),
        float(np.sqrt(np.mean(difference**2))),
        float(np.max(difference)),
    )


def similarity_residuals(here: Array, there: Array) -> tuple[Array, Array]:
    """What is left of `there` (n, 3) against `here` after the best similarity, and its Jacobian.

    Source: Umeyama (1991), equations 40 to 42.
    """
    a, b = here - here.mean(axis=0), there - there.mean(axis=0)
    u, singular, vt = np.linalg.svd(a.T @ b)
    signs = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ signs @ vt
    scale = float(np.trace(np.diag(singular) @ signs) / np.sum(b**2))
    moved = scale * b @ rotation.T
    jacobian = np.zeros((3 * len(a), 7))
    for k, (x, y, z) in enumerate(a):
        jacobian[3 * k : 3 * k + 3, :3] = np.eye(3)
        jacobian[3 * k : 3 * k + 3, 3:6] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
        jacobian[3 * k : 3 * k + 3, 6] = (x, y, z)
    return moved - a, jacobian


def distortion_difference(ours: OurBlock, camera: Any) -> Array:
    """Distances in px over the image of equal rays, after a common scale and shift of the rays."""
    from scipy.optimize import least_squares

    known = np.isfinite(ours.pixels).all(axis=1)
    rays, pixels = ours.rays[known], ours.pixels[known]

    def residuals(p: Array) -> Array:
        turned = np.column_stack([rays * (1.0 + p[0]) + p[1:], np.ones(len(rays))])
        # COLMAP's first pixel has its centre at 0.5.
        return np.asarray((camera.img_from_cam(turned) - 0.5 - pixels).ravel())

    best = least_squares(residuals, np.zeros(3), method="lm")
    return np.asarray(np.linalg.norm(best.fun.reshape(-1, 2), axis=1))


def _rows(path: Path) -> list[list[str]]:
    with path.open(encoding="utf-8", newline="") as file:
        lines = [line for line in file if not line.startswith("#")]
    return list(csv.reader(lines))[1:]


def _run(*arguments: object) -> dict[str, Any]:
    done = CliRunner().invoke(app, [*map(str, arguments), "--json"])
    if done.exit_code:
        raise RuntimeError(f"{arguments[0]}: {done.exception or done.output}")
    content: dict[str, Any] = json.loads(done.stdout)
    return content


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("photographs", type=Path)
    arguments = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="photographs-"))
    try:
        ours = our_block(arguments.photographs, folder)
        begun = time.perf_counter()
        size = (round(ours.pixels[:, 0].max()) + 1, round(ours.pixels[:, 1].max()) + 1)
        model = colmap_model(arguments.photographs, folder, ours.f_px, size)
        seconds = time.perf_counter() - begun
        camera = next(iter(model.cameras.values()))
        content = {
            "machine": machine(),
            "ours": {
                "images": len(ours.names),
                "f_px": ours.f_px,
                "f_sigma_px": ours.f_sigma_px,
                "reprojection_px": ours.reprojection_px,
                "seconds": ours.seconds,
            },
            "colmap": {
                "images": model.num_reg_images(),
                "points": model.num_points3D(),
                "f_px": list(camera.params[:2]),
                "reprojection_px": model.compute_mean_reprojection_error(),
                "seconds": seconds,
            },
            "comparison": vars(compare(ours, model)),
        }
        print(json.dumps(content, indent=1))
    finally:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
