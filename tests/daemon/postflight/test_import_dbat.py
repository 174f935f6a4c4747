"""Scripts of DBAT in the forms of its examples: columns in any order, filters, cameras in files.

The measurements are those of the camera calibration that `test_adjusting` compares with its result.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from daemon.postflight.adjustment.csv_tables import ProjectError
from daemon.postflight.importers.dbat import import_dbat
from processing.geometry.rotation import rotation_matrix
from tests.daemon.postflight.dbat_project import SCRIPT, write_dbat_project
from tests.daemon.postflight.test_adjusting import FOLDER


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_dbat_project(tmp_path)


def test_columns_filters_camera_files_and_estimates_are_honoured(folder: Path) -> None:
    done = import_dbat(folder / "script.xml")
    plain = import_dbat(FOLDER / "camcaldemo.xml")
    (camera,), (other,) = done.network.cameras, plain.network.cameras
    assert camera.free == other.free - {"k3"} and "b2" not in camera.free
    assert camera.f_mm == pytest.approx(7.45699532)
    assert (camera.xp_mm, camera.yp_mm) == pytest.approx((3.61546240, -2.61329280))
    assert camera.interior[3] == pytest.approx(4.58860663e-3)
    table, expected = done.network.image_points, plain.network.image_points
    assert np.allclose(table.sigma_mm, 5.0 * expected.sigma_mm)
    order = [
        np.lexsort((np.array(n.points.names)[n.image_points.point], n.image_points.image))
        for n in (done.network, plain.network)
    ]
    assert np.allclose(table.xy_mm[order[0]], expected.xy_mm[order[1]])
    known = dict(zip(done.network.points.names, done.network.points.sigma_m, strict=True))
    assert np.isnan(known["1003"]).all() and np.isfinite(known["1004"]).all()
    assert done.checks.names == ("1003",)


def test_prior_orientations_begin_a_block_without_control(folder: Path) -> None:
    ids = [
        line.split(",")[0].strip()
        for line in (folder / "images/images.txt").read_text().splitlines()
        if line.strip() and not line.startswith("#")
    ]
    (folder / "eo.txt").write_text("".join(f"{k},1.5,2.5,{k},10,-20,30\n" for k in ids))
    start, end = SCRIPT.index("    <ctrl_pts>"), SCRIPT.index("    <images>")
    prior = (
        '<prior_eo><file format="id,x,y,z,omega,phi,kappa" units="degrees">eo.txt</file></prior_eo>'
    )
    text = SCRIPT[:start] + prior + SCRIPT[end:]
    datum = '<operation><set_datum ref_cam="1">depend</set_datum></operation></operations>'
    (folder / "script.xml").write_text(text.replace("</operations>", datum))
    done = import_dbat(folder / "script.xml")
    assert done.file.adjust.minimum_norm
    assert done.notes == (
        "set_datum depend: imported as a free network (minimum norm); free_datum = "
        '"dependent" is the datum of DBAT',
    )
    assert np.allclose(done.network.stations.position_m[0], [1.5, 2.5, float(ids[0])])
    expected = rotation_matrix(*np.radians([10.0, -20.0, 30.0]))
    assert np.allclose(done.network.attitudes.rotation[0], expected)


def test_prior_orientations_of_mixed_units_are_refused(folder: Path) -> None:
    """Degrees would be taken for radians."""
    files = "".join(
        f'<file format="id,x,y,z,omega,phi,kappa" units="{unit}">eo.txt</file>'
        for unit in ("degrees", "radians")
    )
    (folder / "eo.txt").write_text("1,1,2,3,10,-20,30\n")
    text = SCRIPT.replace("    <images>", f"    <prior_eo>{files}</prior_eo><images>", 1)
    (folder / "script.xml").write_text(text)
    with pytest.raises(ProjectError, match="prior_eo in 'degrees', 'radians'"):
        import_dbat(folder / "script.xml")


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("<cameras>", "<prior_op/><cameras>", "input <prior_op> is not read"),
        ('sxy="0.5"', 'weight="0.5"', "unknown ..weight.."),
        (' sxy="0.5"', "", "no standard deviation"),
        ('format="id,im,x,y"', 'format="id,im,x,x"', "are not read"),
        ('<filter id="1003">remove', '<filter id="77">remove', "77.*not there"),
        ('<filter id="1003">remove', '<filter id="1003">half', "'half' by"),
        ("<K3>false</K3>", "<K4>false</K4>", "io K4 'false' is not read"),
        ("<eo><all>true", "<eo><all>false", "eo all 'false' is not read"),
        ("<io>loaded</io>", "<io>random</io>", "initial values of io"),
        (">bundle_adjustment<", ">helmert<", "operation helmert is not read"),
        ('base_dir="$HERE"', 'base_dir="/data"', "base_dir /data is not read"),
    ],
)
def test_what_is_not_honoured_is_refused_by_name(folder: Path, old, new, sentence) -> None:
    assert old in SCRIPT
    (folder / "script.xml").write_text(SCRIPT.replace(old, new, 1))
    with pytest.raises(ProjectError, match=sentence):
        import_dbat(folder / "script.xml")


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("<unit>mm", "<unit>px", "camera in px"),
        ("<skew>0", "<skew>0.1", "<skew> other than 0"),
        ("<cc>", "<cc>1,", "<cc> has 2 values"),
    ],
)
def test_cameras_that_are_not_carried_are_refused(folder: Path, old, new, sentence) -> None:
    text = (folder / "camera.xml").read_text()
    assert old in text
    (folder / "camera.xml").write_text(text.replace(old, new, 1))
    with pytest.raises(ProjectError, match=sentence):
        import_dbat(folder / "script.xml")


def test_files_of_a_base_folder_with_byte_order_marks_are_read(folder: Path) -> None:
    expected = import_dbat(folder / "script.xml")
    data = folder / "data"
    data.mkdir()
    for path in sorted(folder.iterdir()):
        if path.name not in ("data", "script.xml"):
            path.rename(data / path.name)
    for path in data.rglob("*.txt"):
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    text = SCRIPT.replace('base_dir="$HERE"', 'base_dir="$HERE/data"')
    assert text != SCRIPT
    (folder / "script.xml").write_text(text)
    done = import_dbat(folder / "script.xml")
    assert done.network.images.names == expected.network.images.names
    assert done.network.points.names == expected.network.points.names
    assert np.array_equal(done.network.image_points.xy_mm, expected.network.image_points.xy_mm)
    (folder / "script.xml").write_text(text.replace("$HERE/data", "$HERE/../other"))
    with pytest.raises(ProjectError, match="file"):
        import_dbat(folder / "script.xml")


def test_an_image_or_control_point_twice_is_refused_by_name(folder: Path) -> None:
    images = folder / "images/images.txt"
    lines = images.read_text().splitlines()
    last = [line for line in lines if line.strip() and not line.startswith("#")][-1]
    images.write_text("\n".join([*lines, last]) + "\n")
    name = last.split(",")[0].strip()
    with pytest.raises(ProjectError, match=f"images {name} more than once"):
        import_dbat(folder / "script.xml")


def _marks(folder: Path, line: int, new: str) -> None:
    path = folder / "marks.txt"
    lines = path.read_text().splitlines()
    lines[line - 1] = new
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(
    ("new", "sentence"),
    [
        ("6,1,12.5,abc", r"marks.txt:5: y is 'abc'; a number is right"),
        ("6,1,nan,3.0", r"marks.txt:5: x is 'nan'; a number is right"),
        ("#6,1,12.5,3.0", r"marks.txt:5: '#6' looks like a name"),
        ("6,77,12.5,3.0", r"marks.txt:5: image '77' is not among the images"),
        ("6,1,12.5", r"marks.txt:5: 3 values; 4 are right"),
    ],
)
def test_a_wrong_row_is_one_sentence_with_file_and_line(folder: Path, new, sentence) -> None:
    _marks(folder, 5, new)
    with pytest.raises(ProjectError, match=sentence) as caught:
        import_dbat(folder / "script.xml")
    assert len(caught.value.problems) == 1


@pytest.mark.parametrize(
    ("file", "old", "new", "sentence"),
    [
        ("script.xml", 'sxy="0.5"', 'sxy="0"', r"marks.txt:1: a standard deviation of 0"),
        ("script.xml", 'sxy="0.5"', 'sxy="-1"', r"marks.txt:1: sxy is -1; a standard deviation"),
        ("script.xml", 'sxy="0.5"', 'sxy="a"', r"marks.txt:1: sxy is 'a'; a number"),
        ("camera.xml", "<focal>.*</focal>", "<focal>0</focal>", r"<focal> is 0; it is positive"),
        ("camera.xml", "<focal>.*</focal>", "<focal>x</focal>", r"<focal> is 'x'; a number"),
        ("camera.xml", "<image>.*</image>", "<image>0,9</image>", r"<image> is '0,9'; width"),
        ("camera.xml", "<image>.*</image>", "<image>9</image>", r"<image> is '9'; width"),
        ("marks.txt", r"(?s).*", "# nothing\n", r"marks.txt: no rows"),
    ],
)
def test_a_value_that_cannot_be_is_one_sentence(folder: Path, file, old, new, sentence) -> None:
    path = folder / file
    text = path.read_text()
    changed = re.sub(old, new, text, count=1)
    assert changed != text
    path.write_text(changed)
    with pytest.raises(ProjectError, match=sentence) as caught:
        import_dbat(folder / "script.xml")
    assert len(caught.value.problems) == 1
