"""Level-2 in its folder: what others read there, and that it is whole or not there."""

from __future__ import annotations

import json

import numpy as np
import pytest
import tifffile

from daemon.mission.canonical_json import RecordError
from daemon.mission.store import publication
from daemon.mission.store.level2 import ProductError, recover_level2, write_level2
from tests.daemon.small_camera import new_mission

PAN = np.arange(60 * 90, dtype=np.uint16).reshape(60, 90)
COLOUR = {
    "nir": np.full((20, 30), 4, np.uint16),
    "red": np.full((20, 30), 1, np.uint16),
    "blue": np.full((20, 30), 3, np.uint16),
    "green": np.full((20, 30), 2, np.uint16),
}
GEOMETRY = {
    "free": {"SU00.vip": np.ones((5, 2)), "SU00.raw": np.zeros((5, 2))},
    "fixed-no-tdm": {"SU00.vip": np.ones((1, 2))},
}
REPORT = {"verdict": "good", "flags": 0, "figures": {"sigma0_px": 0.1}}


@pytest.fixture
def mission(tmp_path):
    return new_mission(tmp_path)


def _write(mission, **changes):
    quicklook = np.zeros((60, 90, 3), np.uint8)
    quicklook[:, :45, 0] = 255
    content = {
        "pan": PAN, "colour": COLOUR, "quicklook": quicklook, "report_json": REPORT,
        "geometry": GEOMETRY, "residuals_svg": "<svg/>",
        "mosaic_json": {"format": 1}, "residuals_json": {"vectors": []},
        "histogram_json": {"SU00": [1, 2]},
    }  # fmt: skip
    return write_level2(mission, 7, **{**content, **changes})


def test_every_product_is_read_by_others(mission):
    import cv2

    record = _write(mission)
    folder = mission.level2(7)
    assert set(record.files) == {p.name for p in folder.iterdir()} == {
        "pan.tif", "rgbn.tif", "quicklook.jpg", "quality.json", "geometry.npz",
        "geometry-fixed-no-tdm.npz", "residuals.svg", "mosaic.json",
        "thumbnail.jpg", "residuals.json", "histogram.json",
    }  # fmt: skip
    assert all((folder / name).stat().st_size == size for name, size in record.files.items())
    assert record.verdict == "good"
    assert np.array_equal(tifffile.imread(folder / "pan.tif"), PAN)
    assert tifffile.imread(folder / "rgbn.tif")[:, 0, 0].tolist() == [1, 2, 3, 4]
    blue, _, red = cv2.imread(str(folder / "quicklook.jpg"))[30, 10]
    assert red > 240 and blue < 15
    with np.load(folder / "geometry.npz") as geometry:
        assert np.array_equal(geometry["SU00.vip"], np.ones((5, 2)))
    assert json.loads((folder / "quality.json").read_bytes()) == REPORT


def test_images_of_emulated_hardware_say_so_themselves(mission):
    import cv2

    _write(mission)
    folder = mission.level2(7)
    real = {path.name: path.read_bytes() for path in folder.iterdir()}
    _write(mission, report_json=REPORT | {"flags": ["SIGMA0", "SIMULATED"]})
    for name in ("pan.tif", "rgbn.tif"):
        with tifffile.TiffFile(folder / name) as written:
            assert json.loads(written.pages[0].description)["simulated"] is True
        assert b"simulated" not in real[name]
    for name in ("quicklook.jpg", "thumbnail.jpg"):
        written = (folder / name).read_bytes()
        assert b"SIMULATED: emulated hardware" in written and b"SIMULATED" not in real[name]
        pixels = [cv2.imdecode(np.frombuffer(data, np.uint8), 1) for data in (written, real[name])]
        assert np.array_equal(*pixels)


def test_the_same_products_are_the_same_bytes(mission):
    _write(mission)
    first = {p.name: p.read_bytes() for p in mission.level2(7).iterdir()}
    _write(mission)
    assert {p.name: p.read_bytes() for p in mission.level2(7).iterdir()} == first
    assert [p.name for p in mission.level2_root.iterdir()] == ["000007"]


def test_an_exposure_without_pan_or_colour_has_its_report_all_the_same(mission):
    record = _write(
        mission, pan=None, colour={}, quicklook=None, geometry=None, residuals_svg=None,
        mosaic_json=None,
    )  # fmt: skip
    assert set(record.files) == {"quality.json", "histogram.json", "residuals.json"}


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"colour": {"infrared": PAN}}, ProductError),
        ({"quicklook": PAN}, ProductError),
        ({"geometry": {"../up": {}}}, ProductError),
        ({"geometry": {"free": {"a": np.array([object()])}}}, ProductError),
        ({"report_json": {"figures": {"sigma0_px": float("nan")}}}, RecordError),
    ],
)
def test_what_cannot_be_written_is_refused_before_the_disk_is_touched(mission, changes, error):
    with pytest.raises(error):
        _write(mission, **changes)
    assert list(mission.level2_root.iterdir()) == []


def test_recovery_clears_what_an_interrupted_writer_left(mission, monkeypatch):
    _write(mission)

    def killed(*_folders):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(publication, "_take_name", killed)
        patched.setattr(publication.durable, "remove_tree", killed)
        with pytest.raises(KeyboardInterrupt):
            _write(mission, report_json={"verdict": "refly"})
    (done,) = recover_level2(mission)
    assert done.startswith("L2/000007.") and done.endswith("its writer did not finish")
    assert [p.name for p in mission.level2_root.iterdir()] == ["000007"]
    assert json.loads((mission.level2(7) / "quality.json").read_bytes())["verdict"] == "good"
    assert recover_level2(mission) == []
