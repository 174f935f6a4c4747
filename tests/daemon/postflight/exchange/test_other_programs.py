"""Files for OpenSfM, OpenDroneMap, Metashape, Pix4D and nerfstudio, read by their definitions.

The formulas here are those of the programs' manuals, written again; targets and places are the
emulator's and PROJ's.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from daemon.postflight.exchange.block import Block, BlockError, rig_of
from daemon.postflight.exchange.block_project import import_block
from daemon.postflight.exchange.metashape import metashape_texts
from daemon.postflight.exchange.metashape_reader import read_metashape
from daemon.postflight.exchange.opensfm import geo_text, read_opensfm
from tests.daemon.postflight.exchange.flown_block import (
    FLIGHT,
    SIGMA_M,
    FlownBlock,
    fly,
    local_of_world,
    targets,
)
from tests.daemon.postflight.exchange.test_colmap import SECONDS, export

HEADS = ("nadir", "5", "7", "8", "19")


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> FlownBlock:
    return fly(tmp_path_factory.mktemp("oblique") / "mission", "midas-mini", seconds=SECONDS)


def grid(width: int, height: int) -> np.ndarray:
    columns, rows = np.meshgrid(np.linspace(0, width - 1, 7), np.linspace(0, height - 1, 6))
    return np.stack([columns.ravel(), rows.ravel()], axis=1)


def worst_px(flown: FlownBlock, origin: dict, project) -> float:
    """Of exposure 2 by head: `project` gives pixels, integer at centres, of local points."""
    worst = 0.0
    for head in HEADS:
        pixels = grid(1248, 832)
        world, _ = targets(flown, head, flown.marks[2], pixels, raw=True)
        seen = project(f"000002_{head}", local_of_world(world, origin))
        worst = max(worst, float(np.abs(seen - pixels).max()))
    return worst


def brown(x, y, k1=0.0, k2=0.0, k3=0.0, k4=0.0, p1=0.0, p2=0.0):
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def test_opensfm_shots_and_rig_instances_project_alike_and_right(flown) -> None:
    about, folder = export(flown, "--images", "raw", to="opensfm")
    (content,) = json.loads((folder / "reconstruction.json").read_text())

    def pixels(camera, rotation, translation, points):
        x, y, z = (Rotation.from_rotvec(rotation).apply(points) + translation).T
        x, y = brown(
            x / z, y / z, *(camera[k] for k in ("k1", "k2", "k3")), 0.0, camera["p1"], camera["p2"]
        )
        u, v = camera["focal_x"] * x + camera["c_x"], camera["focal_y"] * y + camera["c_y"]
        size = max(camera["width"], camera["height"])
        # OpenSfM: normalized = (pixel + 0.5 - half of the side) / longer side.
        return np.stack(
            [u * size - 0.5 + camera["width"] / 2, v * size - 0.5 + camera["height"] / 2], axis=1
        )

    def by_shot(name, points):
        shot = content["shots"][name + ".jpg"]
        return pixels(
            content["cameras"][shot["camera"]], shot["rotation"], shot["translation"], points
        )

    def by_rig(name, points):
        instance = content["rig_instances"]["000002"]
        head = content["rig_cameras"][instance["rig_camera_ids"][name + ".jpg"]]
        at_rig = Rotation.from_rotvec(instance["rotation"]).apply(points) + instance["translation"]
        camera = content["cameras"][instance["rig_camera_ids"][name + ".jpg"]]
        return pixels(camera, head["rotation"], head["translation"], at_rig)

    assert worst_px(flown, about["origin"], by_shot) < 0.02
    assert worst_px(flown, about["origin"], by_rig) < 0.02
    assert content["reference_lla"]["altitude"] == 0.0
    assignments = json.loads((folder / "rig_assignments.json").read_text())
    assert len(assignments) == 4 and {head for _, head in assignments["000002"]} == set(HEADS)


def test_geo_txt_has_place_attitude_and_accuracy_in_the_order_of_opendronemap(flown) -> None:
    _, folder = export(flown, to="opensfm")
    lines = (folder / "geo.txt").read_text().splitlines()
    assert lines[0] == "EPSG:4326" and len(lines) == 21
    row = next(line.split() for line in lines if line.startswith("000003_nadir.jpg"))
    pose = FLIGHT.pose(flown.marks[3])
    latitude, longitude, height = FLIGHT.geodetic(pose.position_enu_m)
    assert np.abs(np.array(row[1:3], float) - [longitude, latitude]).max() < 1e-8
    assert abs(float(row[3]) - height) < 0.001
    roll, pitch, heading = np.degrees(FLIGHT.attitude_rad(pose))
    assert np.abs(np.array(row[4:7], float) - [heading % 360, pitch, roll]).max() < 1e-5
    assert row[7:] == ["0.0500", "0.0800"]
    groups = [line.split() for line in (folder / "image_groups.txt").read_text().splitlines()]
    assert len(groups) == 20 and {g for _, g in groups} == {"line-1", "line-2"}


def test_geo_txt_has_the_larger_of_the_horizontal_accuracies(flown) -> None:
    _, folder = export(flown, to="opensfm")
    (image, *_) = read_opensfm(folder).images
    eo = SimpleNamespace(
        longitude_deg=13.0, latitude_deg=52.0, height_m=100.0, enu_from_camera=np.eye(3)
    )
    block = Block("b", (), (replace(image, eo=eo, sigma_m=(0.2, 0.05, 0.08)),))
    assert geo_text(block, "").split()[-2:] == ["0.2000", "0.0800"]


def test_metashape_cameras_project_right_and_lie_on_the_earth(flown) -> None:
    about, folder = export(flown, "--images", "raw", to="metashape")
    root = ElementTree.parse(folder / "cameras.xml").getroot()
    sensors = {s.get("id"): s for s in root.iter("sensor")}
    cameras = {c.get("label"): c for c in root.iter("camera")}

    def numbers(element, path):
        return np.array([float(v) for v in element.findtext(path).split()])

    def pixels(name, points, *, by_master=False):
        camera = cameras[name + ".jpg"]
        sensor = sensors[camera.get("sensor_id")]
        pose = numbers(camera, "transform").reshape(4, 4)
        if by_master and camera.get("master_id") is not None:
            master = next(c for c in cameras.values() if c.get("id") == camera.get("master_id"))
            pose = numbers(master, "transform").reshape(4, 4)
            own = np.eye(4)
            own[:3, :3] = numbers(sensor, "rotation").reshape(3, 3)
            own[:3, 3] = numbers(sensor, "translation")
            pose = pose @ own
        x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
        c = {
            e.tag: float(e.text)
            for e in sensor.find("calibration")
            if e.text and e.tag != "resolution"
        }
        # The manual's P1 goes with r2 + 2 x2 in x, its P2 with r2 + 2 y2 in y.
        x, y = brown(x / z, y / z, c["k1"], c["k2"], c["k3"], c["k4"], p1=c["p2"], p2=c["p1"])
        u = 1248 * 0.5 + c["cx"] + x * c["f"] + x * c["b1"] + y * c["b2"]
        v = 832 * 0.5 + c["cy"] + y * c["f"]
        return np.stack([u - 0.5, v - 0.5], axis=1)

    assert worst_px(flown, about["origin"], pixels) < 0.02
    assert worst_px(flown, about["origin"], lambda n, p: pixels(n, p, by_master=True)) < 0.02
    chunk = root.find("chunk")
    component = chunk.find("components/component")
    assert component.findtext("partition/camera_ids").split() == [
        c.get("id") for c in cameras.values()
    ]
    turn = numbers(component, "transform/rotation").reshape(3, 3)
    at = turn @ numbers(cameras["000002_nadir.jpg"], "transform").reshape(4, 4)[:3, 3]
    at += numbers(component, "transform/translation")
    to_earth = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978")
    truth = to_earth.transform(*FLIGHT.geodetic(FLIGHT.pose(flown.marks[2]).position_enu_m))
    assert np.abs(at - truth).max() < 0.001
    reference = cameras["000002_7.jpg"].find("reference")
    assert reference.get("sxyz") == "/".join(f"{v:g}" for v in SIGMA_M)
    assert [b.get("label") for b in sensors["0"].iter("band")] == ["Red", "Green", "Blue"]


def test_nerfstudio_matrices_project_right(flown) -> None:
    about, folder = export(flown, "--images", "raw", to="nerfstudio")
    content = json.loads((folder / "transforms.json").read_text())
    frames = {Path(f["file_path"]).stem: f for f in content["frames"]}

    def pixels(name, points):
        f = frames[name]
        pose = np.array(f["transform_matrix"])
        x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T  # OpenGL: looks along -z, y up
        x, y = brown(x / -z, -y / -z, f["k1"], f["k2"], f["k3"], 0.0, f["p1"], f["p2"])
        return np.stack([f["fl_x"] * x + f["cx"] - 0.5, f["fl_y"] * y + f["cy"] - 0.5], axis=1)

    assert worst_px(flown, about["origin"], pixels) < 0.02


def test_pix4d_has_grid_places_with_accuracies_and_angles_of_the_grid(flown) -> None:
    _, folder = export(flown, "--crs", "EPSG:32633", to="pix4d")
    rows = [r.split(",") for r in (folder / "geolocation.csv").read_text().splitlines()]
    row = next(r for r in rows if r[0] == "000002_8.jpg")
    world, centre = targets(flown, "8", flown.marks[2], np.array([[624.0, 416.0]]), raw=False)
    to_grid = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:32633", always_xy=True)
    latitude, longitude, height = FLIGHT.geodetic(centre)
    place = np.array(to_grid.transform(longitude, latitude, height))
    assert np.abs(np.array(row[1:4], float) - place).max() < 0.001
    assert row[7:] == ["0.0500", "0.0800"]
    turn = Rotation.from_euler("XYZ", np.array(row[4:7], float), degrees=True).as_matrix()
    target = np.array(to_grid.transform(*np.array(FLIGHT.geodetic(world[0]))[[1, 0, 2]]))
    ray = (target - place) @ turn
    # The scale of the grid is 1 here to 1e-4; half a pixel of the middle is the middle of four.
    assert np.abs(ray[:2] / -ray[2] * 51.0 / 0.0072 - [0.5, -0.5]).max() < 0.3
    external = (folder / "external_camera_parameters.txt").read_text().splitlines()
    assert external[0] == "imageName X Y Z Omega Phi Kappa"
    assert external[rows.index(row) + 1].split() == row[:7]
    camera = dict(
        line.split() for line in (folder / "8.cam").read_text().splitlines()[1:] if line[0] != "#"
    )
    assert [float(camera[k]) for k in ("F", "Px", "Py", "K1")] == pytest.approx(
        [51.0, 1248 * 0.0036, 832 * 0.0036, 0.0]
    )
    assert 'PROJCS["WGS 84 / UTM zone 33N"' in (folder / "coordinate_system.prj").read_text()


def test_opensfm_and_metashape_come_back_as_they_went(flown) -> None:
    _, folder = export(flown, "--images", "raw", to="opensfm")
    block = read_opensfm(folder)
    _, other = export(flown, "--images", "raw", to="metashape")
    again = read_metashape(other / "cameras.xml")
    assert [i.name for i in block.images] == [i.name for i in again.images]
    for a, b in zip(block.images, again.images, strict=True):
        assert np.abs(a.centre_m - b.centre_m).max() < 1e-8
        assert np.abs(a.rotation - b.rotation).max() < 1e-12
    assert [i.frame for i in block.images] == [1 + k // 5 for k in range(20)]
    assert again.frame is not None and again.frame.name == block.frame.name
    written, _ = metashape_texts(again, rig_of(again, 0), "")
    first = (other / "cameras.xml").read_text()
    assert sensors_of(written["cameras.xml"]) == sensors_of(first)


TURN = Rotation.from_euler("xyz", [20, -130, 75], degrees=True).as_matrix()
SHIFT, SCALE = np.array([3.0, -8.0, 11.0]), 12.354


def as_metashape_writes(text: str) -> ElementTree.Element:
    """Our file with chunk units of its own, and slaves without a transform."""
    root = ElementTree.fromstring(text)
    place = root.find("chunk/components/component/transform")
    rotation = np.array(place.findtext("rotation").split(), float).reshape(3, 3)
    origin = np.array(place.findtext("translation").split(), float)
    for camera in root.iter("camera"):
        own = camera.find("transform")
        if camera.get("master_id") is not None:
            camera.remove(own)
            continue
        pose = np.array(own.text.split(), float).reshape(4, 4)
        pose[:3, :3] = TURN @ pose[:3, :3]
        pose[:3, 3] = TURN @ pose[:3, 3] / SCALE + SHIFT
        own.text = " ".join(map(repr, pose.ravel().tolist()))
    to_earth = rotation @ TURN.T
    place.find("rotation").text = " ".join(map(repr, to_earth.ravel().tolist()))
    moved = origin - SCALE * to_earth @ SHIFT
    place.find("translation").text = " ".join(map(repr, moved.tolist()))
    place.find("scale").text = repr(SCALE)
    return root


def test_a_component_with_a_scale_of_its_own_is_read_in_metres(flown, tmp_path) -> None:
    _, folder = export(flown, "--images", "raw", to="metashape")
    root = as_metashape_writes((folder / "cameras.xml").read_text())
    file = tmp_path / "cameras.xml"
    file.write_bytes(ElementTree.tostring(root))
    first, again = read_metashape(folder / "cameras.xml"), read_metashape(file)
    assert again.is_metric and again.frame is not None
    at = {image.name: again.frame.to_geodetic(image.centre_m[None]) for image in again.images}
    for image in first.images:
        there = again.frame.from_geodetic(*first.frame.to_geodetic(image.centre_m[None]).T)
        back = again.frame.from_geodetic(*at[image.name].T)
        assert np.abs(there - back).max() < 1e-4
    turn = again.frame.local_from_enu(first.frame.latitude_deg, first.frame.longitude_deg)
    for a, b in zip(first.images, again.images, strict=True):
        assert np.abs(turn @ a.rotation - b.rotation).max() < 1e-9
    truth = FLIGHT.geodetic(FLIGHT.pose(flown.marks[2]).position_enu_m)
    assert np.abs(at["000002_nadir.jpg"] - truth).max() < 0.001
    assert any("is taken as metres" in note for note in again.notes)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ("p3", r"sensor nadir has p3 0\.5; b1, .* are carried"),
        ("fx", "PhotoScan before 1.2"),
        ("component", r"2 components, Component 1 \(15 cameras\), other \(5 cameras\)"),
        ("master", "names master 99"),
        ("datum", "not on the ellipsoid of WGS 84"),
        ("feet", "local coordinates in foot"),
        ("scale", "scale -2"),
        ("skewed", "is no rotation"),
    ],
)
def test_what_metashape_writes_and_is_not_carried_is_refused(
    flown, tmp_path, change, sentence
) -> None:
    _, folder = export(flown, "--images", "raw", to="metashape")
    root = as_metashape_writes((folder / "cameras.xml").read_text())
    place = root.find("chunk/components/component/transform")
    calibration, reference = root.find(".//calibration"), root.find("chunk/reference")
    if change in ("p3", "fx"):
        ElementTree.SubElement(calibration, change).text = "0.5"
    elif change == "component":
        other = ElementTree.SubElement(root.find("chunk/components"), "component", id="1")
        other.set("label", "other")
        for camera in [c for c in root.iter("camera") if c.get("label").startswith("000003")]:
            camera.set("component_id", "1")
    elif change == "master":
        root.findall(".//camera[@master_id]")[0].set("master_id", "99")
    elif change == "datum":
        reference.text = pyproj.CRS.from_epsg(4267).to_wkt("WKT1_GDAL")
    elif change == "feet":
        reference.text = 'LOCAL_CS["Local (ft)",LOCAL_DATUM["Local",0],UNIT["foot",0.3048]]'
    elif change == "scale":
        place.find("scale").text = "-2"
    else:
        place.find("rotation").text = "1 0 0 0 1 0 0 0 1.1"
    file = tmp_path / "cameras.xml"
    file.write_bytes(ElementTree.tostring(root))
    with pytest.raises(BlockError, match=sentence):
        read_metashape(file)


def test_chunk_units_are_no_metres(flown, tmp_path) -> None:
    _, folder = export(flown, "--images", "raw", to="metashape")
    root = as_metashape_writes((folder / "cameras.xml").read_text())
    component = root.find("chunk/components/component")
    component.remove(component.find("transform"))
    file = tmp_path / "cameras.xml"
    file.write_bytes(ElementTree.tostring(root))
    with pytest.raises(BlockError, match="not in metres"):
        import_block(file, "metashape", tmp_path / "p", position_sigma_m=(0.02, 0.02, 0.03))
    assert not (tmp_path / "p").exists()
    assert not import_block(file, "metashape", tmp_path / "p").block.is_metric
    place = 'LOCAL_CS["Local (m)",LOCAL_DATUM["Local",0],UNIT["metre",1]]'
    transform = ElementTree.SubElement(component, "transform")
    ElementTree.SubElement(transform, "scale").text = "2"
    root.find("chunk/reference").text = place
    file.write_bytes(ElementTree.tostring(root))
    block = read_metashape(file)
    assert block.is_metric and block.frame is None


def test_a_project_without_image_measurements_has_a_note(flown, tmp_path) -> None:
    _, folder = export(flown, to="metashape")
    done = import_block(folder / "cameras.xml", "metashape", tmp_path / "p")
    assert any("no image measurements" in note for note in done.block.notes)
    stated = json.loads((tmp_path / "p/frame.json").read_text())
    assert stated["latitude_deg"] == pytest.approx(done.block.frame.latitude_deg, abs=1e-12)


def sensors_of(text: str) -> list[str]:
    """Sensors of a file as text; numbers to nine digits, labels of bands and types as they are."""
    root = ElementTree.fromstring(text)
    rows = []
    for sensor in root.iter("sensor"):
        for element in sensor.iter():
            try:
                values = [str(round(float(v), 9) + 0.0) for v in (element.text or "").split()]
            except ValueError:
                values = [element.text or ""]
            rows.append(f"{element.tag} {sorted(element.attrib.items())} {values}")
    return rows


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('type="frame"', 'type="fisheye"', "frame cameras are carried"),
        ('sensor_id="4"', 'sensor_id="9"', "which is not in the file"),
        ("<chunk ", "<piece ", "not|mismatch|no file|chunks|Export"),
        ("<f>", "<g>", "Export|mismatch"),
    ],
)
def test_metashape_files_that_cannot_be_carried_are_refused(
    flown, tmp_path, old, new, sentence
) -> None:
    _, folder = export(flown, to="metashape")
    text = (folder / "cameras.xml").read_text()
    assert old in text
    file = tmp_path / "cameras.xml"
    file.write_text(text.replace(old, new))
    with pytest.raises(BlockError, match=sentence):
        read_metashape(file)


def test_opensfm_files_that_cannot_be_carried_are_refused(flown, tmp_path) -> None:
    _, folder = export(flown, to="opensfm")
    (content,) = json.loads((folder / "reconstruction.json").read_text())
    for change, sentence in (
        (lambda c: c["cameras"]["nadir"].update(projection_type="fisheye"), "are carried"),
        (lambda c: c["shots"]["000001_5.jpg"].update(camera="other"), "not there"),
        (lambda c: c["shots"]["000001_5.jpg"].update(rotation=[0, 0]), "not three numbers"),
        (lambda c: c.pop("shots"), "not OpenSfM's format"),
    ):
        other = json.loads(json.dumps(content))
        change(other)
        target = Path(
            shutil.copytree(folder, tmp_path / sentence.replace(" ", "-"), dirs_exist_ok=True)
        )
        (target / "reconstruction.json").write_text(json.dumps([other]))
        with pytest.raises(BlockError, match=sentence):
            read_opensfm(target)
    (folder.parent / "two.json").write_text(json.dumps([content, content]))
    with pytest.raises(BlockError, match="2 reconstructions"):
        read_opensfm(folder.parent / "two.json")


def test_a_lost_image_of_the_master_is_refused_by_a_metashape_rig_only(flown, tmp_path) -> None:
    mission = Path(shutil.copytree(flown.path, tmp_path / "mission"))
    (mission / "L2/000003/nadir.tif").unlink()
    lost = FlownBlock(mission, flown.rig, flown.trajectory, flown.marks)
    about, folder = export(lost)
    assert about["missing"] == ["000003 nadir"] and about["images"] == 19
    assert "000003_nadir" not in (folder / "sparse/images.txt").read_text()
    about, _ = export(lost, "--rig", "no", to="metashape")
    assert about["rig"] is None
