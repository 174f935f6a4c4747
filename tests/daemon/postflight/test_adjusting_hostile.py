"""Whatever stands in the files of an adjustment, it is read or refused with a sentence."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from daemon.postflight.adjustment.csv_tables import ProjectError, read_table, write_table
from daemon.postflight.adjustment.project import read_project
from daemon.postflight.importers.dbat import import_dbat

PROJECT = (
    'format = 1\nname = "x"\n[files]\npoints = "points.csv"\nexposures = "exposures.csv"\n'
    '[[camera]]\nname = "c"\nf_mm = 50.0\n'
)
CELLS = st.sampled_from(
    ["", "a", "b", "c", "1", "-2.5", "1e400", "nan", "inf", "held", "free", "control", "check",
     "tie", "direction", "0", '"', "#", "\u00e4", "x y"]
)  # fmt: skip
quiet = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def table(columns: str) -> st.SearchStrategy[str]:
    width = columns.count(",") + 1
    row = st.lists(CELLS, min_size=width - 1, max_size=width + 1).map(",".join)
    return st.lists(row, max_size=5).map(lambda rows: "\n".join([columns, *rows]) + "\n")


@quiet
@given(
    table("image,camera,exposure"),
    table("image,point,x_mm,y_mm"),
    table("point,role,x_m,y_m,z_m,sx_m,sy_m,sz_m"),
    table("exposure,x_m,y_m,z_m,position"),
)
def test_any_tables_are_read_or_refused(tmp_path: Path, images, seen, points, exposures) -> None:
    (tmp_path / "project.toml").write_text(PROJECT)
    for name, text in (
        ("images", images), ("image_points", seen), ("points", points), ("exposures", exposures)
    ):  # fmt: skip
        (tmp_path / f"{name}.csv").write_text(text)
    try:
        project = read_project(tmp_path / "project.toml")
    except ProjectError as error:
        assert error.problems
        assert all(isinstance(p, str) and p for p in error.problems)
    else:
        assert (
            len(project.network.image_points.image) == project.network.image_points.xy_mm.shape[0]
        )


@quiet
@given(st.binary(max_size=300))
def test_any_bytes_for_a_project_a_table_or_a_script_are_refused(tmp_path: Path, data) -> None:
    path = tmp_path / "file"
    path.write_bytes(data)
    for read in (read_project, import_dbat):
        with pytest.raises(ProjectError):
            read(path)
    try:
        read_table(path, ("image",), ())
    except ProjectError as error:
        assert error.problems


@quiet
@given(
    st.lists(
        st.tuples(
            st.text("ab, \"'#", min_size=1), st.floats(allow_nan=False, allow_infinity=False)
        ),
        max_size=6,
    )
)
def test_tables_come_back_as_they_were_written(tmp_path: Path, rows) -> None:
    rows = [(f"n{name.strip()}", value) for name, value in rows]
    write_table(tmp_path / "t.csv", "a remark\nof two lines", ("name", "value"), rows)
    back = read_table(tmp_path / "t.csv", ("name", "value"), ())
    assert back.numbers("value") == [value for _, value in rows]
    assert back.text("name") == [name for name, _ in rows]
    assert not back.problems


def test_a_script_that_declares_entities_is_refused(tmp_path) -> None:
    path = tmp_path / "bomb.xml"
    path.write_text('<!DOCTYPE d [<!ENTITY a "aaaa">]><document>&a;</document>')
    with pytest.raises(ProjectError, match="document type or entities"):
        import_dbat(path)


def test_names_given_twice_are_refused_with_file_and_line(tmp_path) -> None:
    (tmp_path / "project.toml").write_text(PROJECT)
    (tmp_path / "images.csv").write_text("image,camera\na,c\na,c\n")
    (tmp_path / "image_points.csv").write_text("image,point,x_mm,y_mm\na,1,0,0\n")
    (tmp_path / "points.csv").write_text("point,role\n1,tie\n1,tie\n")
    (tmp_path / "exposures.csv").write_text("exposure\na\na\n")
    with pytest.raises(ProjectError) as caught:
        read_project(tmp_path / "project.toml")
    assert set(caught.value.problems) == {
        "images.csv:3: image 'a' is given twice",
        "points.csv:3: point '1' is given twice",
        "exposures.csv:3: exposure 'a' is given twice",
    }
