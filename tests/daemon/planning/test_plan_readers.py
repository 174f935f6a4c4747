"""Plans of others become lines; what is none is refused in a sentence."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.planning.model import PlannedLine, Point
from daemon.planning.plan_readers import PlanError, read_plan
from daemon.planning.reflight_files import geojson, kml, mavlink_mission
from daemon.planning.reflight_planning import Segment

A, B, C = [15.43, 47.07], [15.45, 47.07], [15.45, 47.09]


def feature(coordinates: object, **properties: object) -> dict[str, object]:
    geometry = {"type": "LineString", "coordinates": coordinates}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def collection(*features: object, **more: object) -> bytes:
    return json.dumps({"type": "FeatureCollection", "features": list(features), **more}).encode()


def plan_of(tmp_path: Path, name: str, data: bytes):
    (tmp_path / name).write_bytes(data)
    return read_plan(tmp_path / name)


def test_geojson_with_ids_strips_and_a_specification(tmp_path: Path) -> None:
    plan = plan_of(
        tmp_path,
        "block.geojson",
        collection(
            feature([A, B], id="L1", strip="S1"),
            feature([B, C]),
            {"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": A}},
            specification={"forward_overlap": 0.8, "sidelap": 0.6},
        ),
    )
    assert plan.lines == (
        PlannedLine("L1", Point(47.07, 15.43), Point(47.07, 15.45), "S1"),
        PlannedLine("2", Point(47.07, 15.45), Point(47.09, 15.45)),
    )
    assert plan.specification.images_on_every_point == 5


def test_a_bent_line_is_a_strip_of_straight_ones(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, "b.geojson", collection(feature([A, B, C], id="X")))
    assert [(line.id, line.strip) for line in plan.lines] == [("X.1", "X"), ("X.2", "X")]


def test_kml(tmp_path: Path) -> None:
    text = """<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document>
      <Placemark><name>7</name><LineString><coordinates>
        15.43,47.07,900 15.45,47.07,900</coordinates></LineString></Placemark>
      <Placemark><name>park</name><Point><coordinates>1,2</coordinates></Point></Placemark>
      </Document></kml>"""
    plan = plan_of(tmp_path, "p.kml", text.encode())
    assert plan.lines == (PlannedLine("7", Point(47.07, 15.43), Point(47.07, 15.45)),)


def test_qgroundcontrol_surveys_and_waypoints_with_a_trigger_distance(tmp_path: Path) -> None:
    def item(command: int, *parameters: float) -> dict[str, object]:
        return {"type": "SimpleItem", "command": command, "params": list(parameters)}

    items = [
        item(16, 0, 0, 0, None, 47.00, 15.40, 100),
        item(206, 25, 0, 1, 0, 0, 0, 0),
        item(16, 0, 0, 0, None, 47.01, 15.40, 100),
        item(206, 0, 0, 0, 0, 0, 0, 0),
        item(16, 0, 0, 0, None, 47.01, 15.41, 100),
        {
            "type": "ComplexItem",
            "TransectStyleComplexItem": {
                "VisualTransectPoints": [[47.1, 15.4], [47.2, 15.4], [47.2, 15.5], [47.1, 15.5]]
            },
        },
    ]
    data = json.dumps({"fileType": "Plan", "mission": {"items": items}}).encode()
    plan = plan_of(tmp_path, "survey.plan", data)
    assert [(line.start, line.end) for line in plan.lines] == [
        (Point(47.0, 15.4), Point(47.01, 15.4)),
        (Point(47.1, 15.4), Point(47.2, 15.4)),
        (Point(47.2, 15.5), Point(47.1, 15.5)),
    ]

    assert [line.distance_m for line in plan.lines] == [25.0, None, None]


def test_geojson_may_say_where_to_expose(tmp_path: Path) -> None:
    middle = {"type": "Point", "coordinates": [15.44, 47.07]}
    plan = plan_of(
        tmp_path,
        "p.geojson",
        collection(
            feature([A, B], id="L1", distance_m=80),
            feature([B, C], id="L2"),
            {"type": "Feature", "properties": {"line": "L2"}, "geometry": {**middle}},
            {
                "type": "Feature",
                "properties": {"line": "L2"},
                "geometry": {"type": "Point", "coordinates": B},
            },
        ),
    )
    assert plan.line("L1").distance_m == 80.0
    # The place west of the line is exposed where it is passed.
    assert plan.line("L2").at_m == pytest.approx((0.0, 0.0), abs=0.1)


def test_qgroundcontrol_photographs_at_waypoints_are_lines_that_end_where_the_way_turns(
    tmp_path: Path,
) -> None:
    def item(command: int, *parameters: object) -> dict[str, object]:
        return {"type": "SimpleItem", "command": command, "params": list(parameters)}

    def waypoint(latitude: float, longitude: float) -> dict[str, object]:
        return item(16, 0, 0, 0, None, latitude, longitude, 100)

    once = item(2000, 0, 0, 1, 0, 0, 0, 0)
    items = [waypoint(46.99, 15.4)]
    for latitude in (47.000, 47.001, 47.003):
        items += [waypoint(latitude, 15.4), once]
    for latitude in (47.003, 47.001):
        items += [waypoint(latitude, 15.41), item(203, 0, 0, 0, 0, 1, 0, 0)]
    data = json.dumps({"fileType": "Plan", "mission": {"items": items}}).encode()
    lines = plan_of(tmp_path, "survey.plan", data).lines
    assert [(line.start, line.end) for line in lines] == [
        (Point(47.0, 15.4), Point(47.003, 15.4)),
        (Point(47.003, 15.41), Point(47.001, 15.41)),
    ]
    assert lines[0].at_m == pytest.approx((0.0, 111.2, 333.5), abs=0.2)


@pytest.mark.parametrize(
    ("name", "data", "sentence"),
    [
        ("p.geojson", collection(feature([A, B], distance_m=-1)), "metres between two"),
        ("p.txt", b"", "ends in"),
        ("p.geojson", b"[]", "no object"),
        ("p.geojson", b"\xff", "not JSON"),
        ("p.geojson", b"[" * 100_000, "nested too deeply|not JSON"),
        ("p.geojson", collection(), "no line"),
        ("p.geojson", collection(feature([A])), "two places"),
        ("p.geojson", collection(feature([[200, 0], A])), "no place on earth"),
        ("p.geojson", collection(feature([["x", 0], A])), "is no place"),
        ("p.geojson", collection(feature([A, B], id=1), feature([A, C], id=1)), "several lines"),
        ("p.geojson", collection(feature([A, B]), specification={"overlap": 1}), "there is"),
        ("p.geojson", collection(feature([A, B]), specification={"sidelap": 2}), "0 to 0.95"),
        ("p.kml", b"<!DOCTYPE x [<!ENTITY a 'b'>]><kml/>", "document type or entities"),
        ("p.kml", b"<kml", "not valid XML"),
        ("p.plan", b"{}", "no QGroundControl plan"),
    ],
)
def test_what_is_no_plan_is_refused(tmp_path: Path, name: str, data: bytes, sentence: str) -> None:
    with pytest.raises(PlanError, match=sentence):
        plan_of(tmp_path, name, data)


@given(st.sampled_from([".geojson", ".kml", ".plan"]), st.binary(max_size=200))
def test_any_bytes_are_a_plan_or_refused(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, data: bytes
) -> None:
    path = tmp_path_factory.getbasetemp() / f"any{suffix}"
    path.write_bytes(data)
    with pytest.raises(PlanError):
        read_plan(path)


@pytest.mark.parametrize(("strip", "written"), [("", "4"), ("S2", "S2")])
def test_advice_names_the_strip_of_its_line_or_the_line(strip: str, written: str) -> None:
    line = PlannedLine("4", Point(47.0, 15.0), Point(47.1, 15.0), strip)
    segment = Segment(line, 100.0, 300.0, Point(47.01, 15.0), Point(47.02, 15.0), ())
    (feature_written,) = json.loads(geojson([segment]))["features"]
    assert feature_written["properties"]["strip"] == written


def test_an_exposure_on_an_unknown_line_is_refused_with_twenty_lines_named(tmp_path: Path) -> None:
    place = {"type": "Point", "coordinates": A}
    lines = [feature([A, B], id=f"L{number:02}") for number in range(1, 26)]
    data = collection(*lines, {"type": "Feature", "properties": {"line": "M"}, "geometry": place})
    with pytest.raises(PlanError, match=r"line 'M'; there is L01, L02, .*, L20$"):
        plan_of(tmp_path, "p.geojson", data)


def test_advice_comes_back_as_a_plan_and_as_a_mission(tmp_path: Path) -> None:
    line = PlannedLine("4 & 5", Point(47.0, 15.0), Point(47.1, 15.0))
    segment = Segment(line, 100.0, 300.0, Point(47.01, 15.0), Point(47.02, 15.0), ("refly <BLUR>",))
    for name, text in (("a.geojson", geojson([segment])), ("a.kml", kml([segment]))):
        (again,) = plan_of(tmp_path, name, text.encode()).lines
        assert (again.start, again.end) == (segment.start, segment.end)
    assert "<name>Fly again</name>" in kml([segment])
    text = mavlink_mission([segment], height_m=500.0, distance_m=80.0)
    assert text.startswith("QGC WPL 110\n")
    wp = pytest.importorskip("pymavlink.mavwp", reason="pip install 'syntopic[mavlink]'")
    (tmp_path / "m.waypoints").write_text(text)
    loader = wp.MAVWPLoader()
    assert loader.load(str(tmp_path / "m.waypoints")) == 4
    assert [loader.wp(i).command for i in range(4)] == [16, 206, 16, 206]
    assert math.isclose(loader.wp(2).x, 47.02, abs_tol=1e-6)
    assert [loader.wp(i).param1 for i in (1, 3)] == [80.0, 0.0]


@pytest.mark.parametrize(("count", "is_read"), [(6, True), (5, False)])
def test_a_waypoint_has_its_place_in_the_fifth_and_sixth_parameter(
    tmp_path: Path, count: int, is_read: bool
) -> None:
    def item(command: int, *parameters: object) -> dict[str, object]:
        return {"type": "SimpleItem", "command": command, "params": list(parameters)}

    def waypoint(latitude: float) -> dict[str, object]:
        return item(16, *(0, 0, 0, None, latitude, 15.4)[:count])

    by_distance = [waypoint(47.00), item(206, 25), waypoint(47.01)]
    once = item(203, 0, 0, 0, 0, 1)
    by_photograph = [waypoint(47.00), once, waypoint(47.01), once]
    for items in (by_distance, by_photograph):
        data = json.dumps({"fileType": "Plan", "mission": {"items": items}}).encode()
        if is_read:
            (line,) = plan_of(tmp_path, "survey.plan", data).lines
            assert (line.start, line.end) == (Point(47.00, 15.4), Point(47.01, 15.4))
        else:
            with pytest.raises(PlanError, match="no line"):
                plan_of(tmp_path, "survey.plan", data)
