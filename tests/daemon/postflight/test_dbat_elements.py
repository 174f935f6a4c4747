"""What a DBAT script or camera file asks for and is not honoured is refused by its name."""

from __future__ import annotations

from pathlib import Path

import pytest

from daemon.postflight.adjustment.csv_tables import ProjectError
from daemon.postflight.importers.dbat import import_dbat
from processing.bundle.network import INTERIOR
from tests.daemon.postflight.dbat_project import SCRIPT, write_dbat_project

PRIOR = '<prior_eo><file format="id,x,y,z,omega,phi,kappa" units="degrees">eo.txt</file></prior_eo>'
IO_LOADED = "<io>loaded</io>"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_dbat_project(tmp_path)


def changed(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert text.count(old) >= 1, old
    path.write_text(text.replace(old, new, 1))


def refused(folder: Path, sentence: str) -> None:
    with pytest.raises(ProjectError, match=sentence) as caught:
        import_dbat(folder / "script.xml")
    assert len(caught.value.problems) == 1, caught.value.problems


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('min_rays="2"', 'min_rays="3"', "min_rays is '3'; 2 is read"),
        ('min_rays="2"', 'min_rays="2" max_angle="5"', "attribute max_angle of <operation>"),
        (
            "<operation>bundle",
            '<operation damping="gna" max_iter="1">bundle',
            "attribute damping, max_iter of <operation>",
        ),
        ("<operation>bundle", '<operation min_rays="2">bundle', "min_rays of operation bundle_"),
        ("<operations>", '<operations><resection n="4"/>', "<resection> in <operations>"),
        ("<operations>", '<operations order="2">', "attribute order of <operations>"),
        ("<operation><set_initial", "<operation>helmert<set_initial", "text 'helmert' next to"),
        (IO_LOADED, '<io sigma="1">loaded</io>', "attribute sigma of <io>"),
        (IO_LOADED, "<io><cc>loaded</cc></io>", "initial values of io"),
        (IO_LOADED, "<io>loaded</io><io>default</io>", "<io> is 2 times"),
        (IO_LOADED, "<eo>loaded</eo>", "<prior_eo> is not there: add it"),
        (IO_LOADED, "<lens>loaded</lens>", "<lens> in <set_initial_values>"),
        ("<eo><all>true</all></eo>", "<ro><all>true</all></ro>", "<ro> in <set_bundle_est"),
        ("<eo><all>true</all></eo>", "<eo>false</eo>", "eo all 'false' is not read"),
        ("<K3>false</K3>", "<K3>false</K3><K3>true</K3>", "<K3> is 2 times in <io>"),
        ("<input ", "<settings/><input ", "<settings> in <document>"),
        ('version="1.0"', 'version="9.0"', "dbat_script_version is '9.0'; 1.0 is read"),
        ("<input ", "<meta><project_unit>ft</project_unit></meta><input ", "unit> is 'ft'; m is"),
        ("<input ", '<input units="mm" ', "attribute units of <input>"),
        ("<images>", '<images scale="2">', "attribute scale of <images>"),
        ("<images>", "<images><mask>a</mask>", "<mask> in <images>"),
        ('sxyz">reference', 'sxyz" units="mm">reference', "unknown .'units'."),
        ("<cameras><file>", '<cameras><file units="mm">', "attribute units of <file>"),
        ("<cameras>", '<cameras model="4">', "attribute model of <cameras>"),
    ],
)
def test_elements_and_attributes_of_a_script(folder, old, new, sentence) -> None:
    import_dbat(folder / "script.xml")
    changed(folder / "script.xml", old, new)
    refused(folder, sentence)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("<nP>", "<distortion_model>fisheye</distortion_model><nP>", "<distortion_model> in <cam"),
        ("<nK>3", "<nK>1", "<nK> is 1; 3 is read"),
        ("<nP>2", "<nP>0", "<nP> is 0; 2 is read"),
        ("<calibrated>yes", "<calibrated>no", "<calibrated> is no, and the initial values of io"),
        ("<focal>", "<focal>1</focal><focal>", "<focal> is 2 times in <camera>"),
        ("<focal>", '<focal unit="px">', "attribute unit of <focal>"),
        ("<cameras>", "<lenses/><cameras>", "<lenses> in <document>"),
        ('camera_version="1.0"', 'camera_version="2.0"', "dbat_camera_version is '2.0'"),
    ],
)
def test_elements_and_attributes_of_a_camera(folder, old, new, sentence) -> None:
    changed(folder / "camera.xml", old, new)
    refused(folder, sentence)


def test_radial_coefficients_are_three(folder) -> None:
    text = (folder / "camera.xml").read_text()
    begin, end = text.index("<K>"), text.index("</K>")
    (folder / "camera.xml").write_text(text[:begin] + "<K>1e-4" + text[end:])
    refused(folder, "<K> has 1 coefficients; three are read")


def test_a_camera_that_is_not_calibrated_begins_with_its_nominal_values(folder) -> None:
    changed(folder / "camera.xml", "<calibrated>yes", "<calibrated>no")
    changed(folder / "script.xml", IO_LOADED, "<io>default</io>")
    (camera,) = import_dbat(folder / "script.xml").network.cameras
    assert camera.f_mm == 7.5


def test_prior_orientations_that_the_script_does_not_load_are_refused(folder) -> None:
    ids = [
        line.split(",")[0].strip()
        for line in (folder / "images/images.txt").read_text().splitlines()
        if line.strip() and not line.startswith("#")
    ]
    (folder / "eo.txt").write_text("".join(f"{k},1.5,2.5,{k},10,-20,30\n" for k in ids))
    changed(folder / "script.xml", "<images>", f"{PRIOR}<images>")
    changed(folder / "script.xml", IO_LOADED, f"{IO_LOADED}<eo><all>loaded</all></eo>")
    import_dbat(folder / "script.xml")
    changed(folder / "script.xml", "<eo><all>loaded", "<eo><all>default")
    refused(folder, "initial values of eo are 'default', and <prior_eo> is there")


def test_remarks_plots_and_folders_of_images_are_harmless(folder) -> None:
    """As in the public scripts: remarks anywhere, plots with attributes, files of results."""
    plain = import_dbat(folder / "script.xml")
    path = folder / "script.xml"
    output = (
        '<output><plots><plot cam_size="0.1">params</plot></plots><files base_dir="/home">'
        "<report><file>a.txt</file></report></files></output></document>"
    )
    changed(path, "</document>", output)
    changed(path, "<images>", '<images image_base_dir="$DBAT"><c>x</c>')
    meta = "<meta><date>2019</date><project_unit>m</project_unit></meta>"
    changed(path, "<input ", f"<c>one</c>{meta}<input ")
    changed(path, "<operations>", "<operations><c>two <plots/></c>")
    changed(path, "<io><all>true", "<io><c>three</c><all>true")
    changed(path, ">bundle_adjustment<", ">bundle_adjustment><")
    changed(path, 'version="1.0"', 'version="1.0.0"')
    done = import_dbat(path)
    assert done.notes == (
        "ignored: <output> (plots and files), image_base_dir (no image is opened)",
    )
    assert done.network.cameras[0].free == plain.network.cameras[0].free


def test_a_parameter_in_the_text_of_its_part_is_that_of_all(folder) -> None:
    path = folder / "script.xml"
    begin, end = SCRIPT.index("<io><all>true"), SCRIPT.index("</io>\n")
    path.write_text(SCRIPT[:begin] + "<io>false" + SCRIPT[end:])
    (camera,) = import_dbat(path).network.cameras
    assert not camera.free


@pytest.mark.parametrize(
    ("more", "free"),
    [
        ("<io><cc>false</cc></io>", {"dx0", "dy0", "k1", "k2", "p1", "p2", "b1"}),
        ("<eo>true</eo>", {"df", "dx0", "dy0", "k1", "k2", "p1", "p2", "b1"}),
        ("<io><K3>false</K3><all>true</all></io>", set(INTERIOR)),
        ("<io><all>false</all><P1>true</P1></io>", {"p1"}),
    ],
)
def test_a_second_operation_changes_what_it_names(folder, more, free) -> None:
    second = f"<set_bundle_estimate_params>{more}</set_bundle_estimate_params>"
    bundle = "<operation>bundle_adjustment"
    changed(folder / "script.xml", bundle, f"<operation>{second}</operation>{bundle}")
    (camera,) = import_dbat(folder / "script.xml").network.cameras
    assert camera.free == free


def test_a_script_that_does_not_state_what_is_estimated_is_refused(folder) -> None:
    text = (folder / "script.xml").read_text()
    begin = text.index("    <operation><set_bundle_estimate_params>")
    end = text.index("    <operation>bundle_adjustment")
    (folder / "script.xml").write_text(text[:begin] + text[end:])
    refused(folder, "no <set_bundle_estimate_params>, so that it does not state which")
    part = "<operation><set_bundle_estimate_params><io><K3>false</K3></io>"
    operation = f"{part}</set_bundle_estimate_params></operation>"
    (folder / "script.xml").write_text(text[:begin] + operation + text[end:])
    (camera,) = import_dbat(folder / "script.xml").network.cameras
    assert camera.free == set(), "nothing is estimated at the beginning"


@pytest.mark.parametrize("value", ["nan", "1_0", "\u0663", "inf"])
@pytest.mark.parametrize(("file", "old"), [("camera.xml", "<K>"), ("marks.txt", "")])
def test_a_number_that_is_none_is_refused_with_its_place(folder, value, file, old) -> None:
    """Python reads 1_0 as 10, and digits of other scripts."""
    path = folder / file
    text = path.read_text()
    start = text.index(old) + len(old) if old else text.index(",", text.index(",") + 1) + 1
    path.write_text(f"{text[:start]}{value},{text[start:].split(',', 1)[1]}", encoding="utf-8")
    refused(folder, f"(script.xml: <K>|marks.txt:1: x) is '{value}'; a number is right")


def test_a_table_whose_last_line_has_no_end_is_stated(folder) -> None:
    assert not [note for note in import_dbat(folder / "script.xml").notes if "cut" in note]
    path = folder / "marks.txt"
    path.write_text(path.read_text()[:-3])
    (note,) = [note for note in import_dbat(folder / "script.xml").notes if "cut" in note]
    assert note == "marks.txt: its last line has no end; was the file cut?"
