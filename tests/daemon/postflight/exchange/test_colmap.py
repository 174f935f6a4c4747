"""What pycolmap reads of an exported block: places, reprojections, rig, priors, adjustment."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.layout import Mission
from daemon.postflight.exchange.block import BlockError, fitted
from daemon.postflight.exchange.colmap import read_colmap
from daemon.postflight.exchange.mission_block import block_of_mission
from processing.bundle.adjust import AdjustmentSettings, adjust
from processing.bundle.adjustment_results import exposures_of
from processing.bundle.network import (
    Attitudes,
    CameraModel,
    Gnss,
    HeadMounting,
    ImagePoints,
    Images,
    Network,
    Points,
    Stations,
)
from tests.daemon.postflight.exchange.flown_block import (
    LENS,
    SIGMA_M,
    FlownBlock,
    fly,
    local_of_world,
    targets,
)

pycolmap = pytest.importorskip("pycolmap")
pytestmark = pytest.mark.peer

RUN = CliRunner()
SECONDS = (5.0, 9.0, 13.0, 17.0)


@pytest.fixture(scope="module")
def oblique(tmp_path_factory) -> FlownBlock:
    """Four exposures of five heads that fire at one instant, with distorting lenses."""
    return fly(tmp_path_factory.mktemp("oblique") / "mission", "midas-mini", seconds=SECONDS)


@pytest.fixture(scope="module")
def syntopic(tmp_path_factory) -> FlownBlock:
    """Two exposures of heads that share a place and not a time."""
    folder = tmp_path_factory.mktemp("syntopic") / "mission"
    return fly(
        folder,
        "ultracam-l-mini",
        seconds=SECONDS[:2],
        lens="f_number = 5.6\nk1 = -4e-7",
        is_syntopic=True,
    )


def export(flown: FlownBlock, *more: str, to: str = "colmap") -> tuple[dict, Path]:
    sigma = [str(v) for v in SIGMA_M]
    done = RUN.invoke(
        app,
        ["export", "block", str(flown.path), "--to", to, "--json", "--no-copies",
         "--trajectory", str(flown.trajectory), "--position-sigma", *sigma, *more],
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    about = json.loads(done.stdout)
    return about, Path(about["folder"])


def worst_reprojection(flown: FlownBlock, model, about: dict, *, raw: bool) -> tuple[float, float]:
    """Largest differences from the emulator's own targets (px) and projection centres (m)."""
    worst_px = worst_m = 0.0
    for image in model.images.values():
        name = image.name.removesuffix(".jpg")
        number, camera_name = name.split("_", 1)
        cone = (
            flown.rig.cone_of(camera_name).name
            if raw
            else flown.rig.image_cone_name
            if camera_name == "pan"
            else camera_name
        )
        camera = model.cameras[image.camera_id]
        columns, rows = np.meshgrid(
            np.linspace(0, camera.width - 1, 7), np.linspace(0, camera.height - 1, 6)
        )
        pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
        world, centre = targets(flown, cone, flown.marks[int(number)], pixels, raw=raw)
        local = local_of_world(world, about["origin"])
        seen = np.array([image.project_point(point) for point in local])
        worst_px = max(worst_px, float(np.abs(seen - 0.5 - pixels).max()))
        there = local_of_world(centre, about["origin"])[0]
        worst_m = max(worst_m, float(np.abs(image.projection_center() - there).max()))
    return worst_px, worst_m


def test_perspective_images_reproject_to_a_thousandth_of_a_pixel(oblique) -> None:
    about, folder = export(oblique)
    model = pycolmap.Reconstruction(folder / "sparse")
    assert (len(model.images), len(model.rigs), len(model.frames)) == (20, 1, 4)
    assert about["rig"]["change_px"] < 1e-4
    worst_px, worst_m = worst_reprojection(oblique, model, about, raw=False)
    assert worst_px < 0.001 and worst_m < 0.001


def test_raw_frames_reproject_within_the_limit_of_the_fit(oblique) -> None:
    about, folder = export(oblique, "--images", "raw")
    model = pycolmap.Reconstruction(folder / "sparse")
    assert {camera.model.name for camera in model.cameras.values()} <= {"OPENCV", "FULL_OPENCV"}
    residuals = {name: one["residual_px"] for name, one in about["cameras"].items()}
    assert 1e-5 < max(residuals.values()) < 0.02
    worst_px, worst_m = worst_reprojection(oblique, model, about, raw=True)
    assert worst_px < 0.02 and worst_m < 0.001


def test_heads_of_other_instants_are_written_without_a_rig_and_it_is_stated(syntopic) -> None:
    about, folder = export(syntopic, "--images", "raw")
    model = pycolmap.Reconstruction(folder / "sparse")
    assert about["rig"] is None and "heads change against each other" in about["rig_reason"]
    assert len(model.rigs) == len(model.cameras)
    worst_px, worst_m = worst_reprojection(syntopic, model, about, raw=True)
    assert worst_px < 0.02 and worst_m < 0.001


def test_a_rig_of_heads_of_other_instants_is_off_by_no_more_than_stated(syntopic) -> None:
    about, folder = export(syntopic, "--images", "raw", "--rig", "yes")
    model = pycolmap.Reconstruction(folder / "sparse")
    assert len(model.rigs) == 1 and len(model.frames) == 2
    worst_px, worst_m = worst_reprojection(syntopic, model, about, raw=True)
    assert about["rig"]["change_px"] > 0.02 and worst_m < about["rig"]["change_m"] + 0.001
    # Of the attitude; the displacement of the centre adds less than a tenth of a pixel at 1500 m.
    assert worst_px < 1.5 * about["rig"]["change_px"] + 0.1


def test_priors_of_the_database_have_the_stated_covariance_once_a_frame(oblique) -> None:
    about, folder = export(oblique, "--database")
    assert about["priors"] == 4
    with pycolmap.Database.open(str(folder / "database.db")) as database:
        assert (database.num_rigs(), database.num_frames(), database.num_images()) == (1, 4, 20)
        priors = database.read_all_pose_priors()
        names = {image.image_id: image.name for image in database.read_all_images()}
    model = pycolmap.Reconstruction(folder / "sparse")
    assert len(priors) == 4
    for prior in priors:
        assert names[prior.corr_data_id.id].endswith("_nadir.jpg")
        assert np.allclose(prior.position_covariance, np.diag(np.square(SIGMA_M)))
        image = model.images[prior.corr_data_id.id]
        assert np.abs(prior.position - image.projection_center()).max() < 1e-6


def test_a_frame_without_the_image_of_the_master_keeps_its_places(oblique, tmp_path) -> None:
    mission = Path(shutil.copytree(oblique.path, tmp_path / "mission"))
    (mission / "L2/000003/nadir.tif").unlink()
    lost = FlownBlock(mission, oblique.rig, oblique.trajectory, oblique.marks)
    about, folder = export(lost)
    assert about["missing"] == ["000003 nadir"] and about["rig"]["reference"] == "nadir"
    model = pycolmap.Reconstruction(folder / "sparse")
    assert (len(model.images), len(model.frames)) == (19, 4)
    worst_px, worst_m = worst_reprojection(lost, model, about, raw=False)
    assert worst_px < 0.001 and worst_m < 0.001


def test_export_import_export_is_byte_identical(oblique, tmp_path: Path) -> None:
    from daemon.postflight.exchange.block import rig_of
    from daemon.postflight.exchange.colmap import colmap_texts

    _, folder = export(oblique)
    block = read_colmap(folder / "sparse")
    texts, _ = colmap_texts(block, rig_of(block, 0))
    for name in ("cameras.txt", "points3D.txt"):
        assert texts[name] == (folder / "sparse" / name).read_text()
    # Poses are composed of rig and frame again: the same to 1e-7, not to the last digit.
    for name in ("rigs.txt", "frames.txt", "images.txt"):
        ours = [line.split() for line in texts[name].splitlines()]
        theirs = [line.split() for line in (folder / "sparse" / name).read_text().splitlines()]
        for a, b in zip(ours, theirs, strict=True):
            assert len(a) == len(b)
            for x, y in zip(a, b, strict=True):
                assert x == y or abs(float(x) - float(y)) < 1e-7


@pytest.mark.parametrize(
    ("name", "old", "new", "sentence"),
    [
        ("frames.txt", "CAMERA 2 ", "CAMERA 9 ", "belongs to another rig"),
        ("cameras.txt", "PINHOLE", "FOV", "is not carried"),
        ("images.txt", " 3 000001_7.jpg", " 8 000001_7.jpg", "is not in cameras.txt"),
        ("cameras.txt", "1248", "wide", "not a line of COLMAP's text format"),
    ],
)
def test_models_that_do_not_fit_are_refused(oblique, tmp_path, name, old, new, sentence) -> None:
    _, folder = export(oblique)
    model = Path(shutil.copytree(folder / "sparse", tmp_path / "sparse"))
    text = (model / name).read_text()
    assert old in text
    (model / name).write_text(text.replace(old, new))
    with pytest.raises(BlockError, match=sentence):
        read_colmap(model)


def test_a_lens_that_no_model_fits_is_refused_with_its_residual(tmp_path) -> None:
    lens = LENS + "\nb2 = 4e-4"
    flown = fly(tmp_path / "mission", "midas-mini", seconds=(5.0,), lens=lens)
    done = RUN.invoke(
        app,
        ["export", "block", str(flown.path), "--to", "colmap", "--images", "raw",
         "--trajectory", str(flown.trajectory)],
    )  # fmt: skip
    assert done.exit_code != 0
    text = " ".join(str(done.exception or done.output).split())
    assert "does not fit" in text and "strict perspective" in text
    # Metashape's model has a skew, and holds it.
    found = block_of_mission(Mission.open(flown.path), "raw", trajectory_file=flown.trajectory)
    assert fitted(found.block.cameras[0], ("pinhole", "metashape"))[2] < 0.02


def test_its_adjustment_of_the_rig_returns_to_ours_from_three_sigmas_away(oblique) -> None:
    about, folder = export(oblique)
    model = pycolmap.Reconstruction(folder / "sparse")
    generator = np.random.default_rng(11)
    points, seen = _measured(oblique, model, about, generator)
    ours, sigma = _our_adjustment(model, points, seen)
    for point in points:
        model.add_point3D(point + generator.normal(0.0, 1.0, 3), pycolmap.Track())
    keypoints: dict[int, list[tuple[int, np.ndarray]]] = {}
    for image_id, point, pixel in seen:
        keypoints.setdefault(image_id, []).append((point, pixel))
    for image_id, of_image in keypoints.items():
        model.images[image_id].points2D = pycolmap.Point2DList(
            [pycolmap.Point2D(pixel) for _, pixel in of_image]
        )
        for k, (point, _) in enumerate(of_image):
            model.add_observation(point + 1, pycolmap.TrackElement(image_id, k))
    priors = [_prior(image) for image in model.images.values() if image.camera_id == 1]
    for frame in model.frames.values():
        pose = frame.rig_from_world
        moved = -(pose.rotation.inverse() * pose.translation)
        moved = moved + 3.0 * np.array(SIGMA_M) * generator.choice([-1.0, 1.0], 3)
        turn = pycolmap.Rotation3d(generator.normal(0.0, 1e-4, 3)) * pose.rotation
        frame.rig_from_world = pycolmap.Rigid3d(turn, -(turn * moved))
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.images:
        config.add_image(image_id)
    for camera_id in model.cameras:
        config.set_constant_cam_intrinsics(camera_id)
        if camera_id > 1:
            sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)
            config.set_constant_sensor_from_rig_pose(sensor)
    options = pycolmap.BundleAdjustmentOptions(refine_sensor_from_rig=False, print_summary=False)
    options.ceres.solver_options.gradient_tolerance = 1e-10
    options.ceres.solver_options.function_tolerance = 1e-14
    adjuster = pycolmap.create_pose_prior_bundle_adjuster(
        options, pycolmap.PosePriorBundleAdjustmentOptions(), config, priors, model
    )
    adjuster.solve()
    theirs = {
        image.frame_id: image.projection_center()
        for image in model.images.values()
        if image.camera_id == 1
    }
    difference = np.array([theirs[k] for k in sorted(theirs)]) - ours
    assert np.abs(difference / sigma).max() < 0.1


def _measured(flown, model, about, generator):
    """Ground points in the local frame, and their noisy images: image id, point, COLMAP's pixel."""
    points = []
    for image in model.images.values():
        if image.camera_id == 1:
            pixels = generator.uniform([50, 50], [1198, 782], (15, 2))
            number = int(image.name[:6])
            world, _ = targets(flown, "nadir", flown.marks[number], pixels, raw=False)
            points += list(local_of_world(world, about["origin"]))
    seen = []
    for image_id in sorted(model.images):
        image = model.images[image_id]
        for k, point in enumerate(points):
            pixel = image.project_point(point)
            if pixel is not None and 0 < pixel[0] < 1248 and 0 < pixel[1] < 832:
                seen.append((image_id, k, pixel + generator.normal(0.0, 0.3, 2)))
    counts = np.bincount([k for _, k, _ in seen], minlength=len(points))
    used = {k: i for i, k in enumerate(np.flatnonzero(counts >= 2))}
    assert len(used) > 20
    return (
        np.array([points[k] for k in used]),
        [(image, used[k], pixel) for image, k, pixel in seen if k in used],
    )


def _prior(image):
    prior = pycolmap.PosePrior()
    sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, image.camera_id)
    prior.corr_data_id = pycolmap.data_t(sensor, image.image_id)
    prior.position = image.projection_center()
    prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
    prior.position_covariance = np.diag(np.square(SIGMA_M))
    return prior


def _our_adjustment(model, points, seen):
    """Adjusted rig positions by frame, and their standard deviations; image sigma is one pixel."""
    flip = np.diag([1.0, -1.0, -1.0])
    frames, cameras = sorted(model.frames), sorted(model.cameras)
    rigs = [model.frames[f].rig_from_world for f in frames]
    turn = np.array([r.rotation.matrix().T @ flip for r in rigs])
    place = np.array([-(r.rotation.inverse() * r.translation) for r in rigs])
    pitch = 0.0072
    heads, models = [], []
    for c in cameras:
        camera = model.cameras[c]
        models.append(CameraModel(f"c{c}", camera.params[0] * pitch, pixel_mm=pitch))
        pose = model.rigs[1].sensor_from_rig(
            pycolmap.sensor_t(pycolmap.SensorType.CAMERA, c)
        ) if c > 1 else pycolmap.Rigid3d()  # fmt: skip
        matrix = flip @ pose.rotation.matrix().T @ flip
        offset = flip @ -(pose.rotation.inverse() * pose.translation)
        heads.append(HeadMounting(f"h{c}", matrix, offset))
    images = sorted(model.images)
    at = np.array([frames.index(model.images[i].frame_id) for i in images])
    of = np.array([cameras.index(model.images[i].camera_id) for i in images])
    px = np.array([pixel for *_, pixel in seen])
    half = np.array([624.0, 416.0])
    n = len(frames)
    network = Network(
        cameras=tuple(models),
        heads=tuple(heads),
        stations=Stations(tuple(f"s{k}" for k in frames), place, np.zeros(n, bool)),
        attitudes=Attitudes(tuple(f"a{k}" for k in frames), turn, np.zeros(n, bool)),
        images=Images(tuple(f"i{k}" for k in images), at, at, of, of),
        points=Points(
            tuple(f"p{k}" for k in range(len(points))), points,
            np.full(points.shape, np.nan), np.zeros(len(points), bool),
        ),
        image_points=ImagePoints(
            np.array([images.index(i) for i, *_ in seen]),
            np.array([k for _, k, _ in seen]),
            (px - half) * pitch * [1, -1],
            np.full(px.shape, pitch),
        ),
        gnss=Gnss(
            station=np.arange(n), attitude=np.arange(n), position_m=place,
            sigma_m=np.tile(SIGMA_M, (n, 1)), lever_m=np.zeros((n, 3)),
            line=np.full(n, -1), time_s=np.zeros(n),
        ),
    )  # fmt: skip
    every = exposures_of(adjust(network, AdjustmentSettings()))
    result = [every[k] for k in np.unique(at, return_index=True)[1]]
    return (
        np.array([one.position_m for one in result]),
        np.array([one.position_sigma_m for one in result]),
    )
