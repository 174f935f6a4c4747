"""Foreign plans: wrong types, encodings, sizes and names end in an error message."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest

from daemon.planning.plan_readers import PlanError, read_plan
from tests.daemon.planning.test_plan_readers import A, B, C, collection, feature, plan_of

LINES = 20_000


def qgc(**mission: Any) -> bytes:
    return json.dumps({"fileType": "Plan", "mission": mission}).encode()


def survey(**transects: Any) -> bytes:
    return qgc(items=[{"TransectStyleComplexItem": transects}])


POINT_OF_A_LINE = {"type": "Feature", "geometry": {"type": "Point", "coordinates": A}}
WRONG_TYPES: dict[str, tuple[str, bytes]] = {
    "properties are a list": (
        ".geojson",
        collection({**feature([A, B]), "properties": ["line"]}),
    ),
    "properties are a number": (".geojson", collection({**feature([A, B]), "properties": 5})),
    "properties of a place are a text": (
        ".geojson",
        collection({**POINT_OF_A_LINE, "properties": "line"}),
    ),
    "the line of a place is a list": (
        ".geojson",
        collection(feature([A, B]), {**POINT_OF_A_LINE, "properties": {"line": [1]}}),
    ),
    "a coordinate of 400 digits": (".geojson", collection(feature([[10**400, 1], A]))),
    "a coordinate that is a list": (".geojson", collection(feature([[[1], 1], A]))),
    "coordinates are an object": (".geojson", collection(feature({"a": 1}))),
    "an id that is an object": (".geojson", collection(feature([A, B], id={"a": [1]}))),
    "an id of a megabyte": (".geojson", collection(feature([A, B], id="x" * 1_000_000))),
    "a distance of 400 digits": (".geojson", collection(feature([A, B], distance_m=10**400))),
    "a specification of lists": (
        ".geojson",
        collection(feature([A, B]), specification={"sidelap": []}),
    ),
    "a specification that is a list": (".geojson", collection(feature([A, B]), specification=[1])),
    "a number of 5000 digits": (".geojson", b'{"type": ' + b"1" * 5000 + b"}"),
    "items are a number": (".plan", qgc(items=5)),
    "items are an object": (".plan", qgc(items={"a": 1})),
    "an item is a text": (".plan", qgc(items=["x"])),
    "transect points are a number": (".plan", survey(VisualTransectPoints=7)),
    "transect points are an object": (".plan", survey(VisualTransectPoints={"a": 1})),
    "a transect point is null": (".plan", survey(VisualTransectPoints=[None, None])),
    "a footprint is a text": (
        ".plan",
        survey(VisualTransectPoints=[A, B], CameraCalc={"AdjustedFootprintFrontal": "x"}),
    ),
    "parameters are texts": (".plan", qgc(items=[{"command": 16, "params": ["x"] * 7}])),
    "a mission that is a list": (".plan", json.dumps({"fileType": "Plan", "mission": []}).encode()),
}


@pytest.mark.trust
@pytest.mark.parametrize("kind", WRONG_TYPES)
def test_a_value_of_the_wrong_type_is_refused_in_a_short_sentence(
    tmp_path: Path, kind: str
) -> None:
    suffix, data = WRONG_TYPES[kind]
    with pytest.raises(PlanError) as refused:
        plan_of(tmp_path, f"p{suffix}", data)
    assert len(str(refused.value)) < 500


@pytest.mark.trust
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
def test_a_document_type_is_refused_in_every_encoding(tmp_path: Path, encoding: str) -> None:
    name = "utf-16" if encoding.startswith("utf-16") else "utf-8"
    line = "<LineString><coordinates>1,2 1,3</coordinates></LineString>"
    body = f"<kml><Placemark>{line}</Placemark></kml>"
    plain = f'<?xml version="1.0" encoding="{name}"?>{body}'
    mark = "" if encoding in ("utf-8", "utf-8-sig", "utf-16") else "\ufeff"
    assert plan_of(tmp_path, "good.kml", (mark + plain).encode(encoding)).lines
    for declared in ("<!DOCTYPE kml>", '<!DOCTYPE kml [<!ENTITY a "b">]>'):
        hostile = plain.replace("<kml>", f"{declared}<kml>", 1)
        with pytest.raises(PlanError, match="document type or entities"):
            plan_of(tmp_path, "p.kml", (mark + hostile).encode(encoding))


def test_xml_that_is_nested_deeply_or_has_too_many_elements_is_refused(tmp_path: Path) -> None:
    for data, sentence in ((b"<a>" * 200_000, "deep"), (b"<a>" + b"<b/>" * 600_000, "elements")):
        with pytest.raises(PlanError, match=sentence):
            plan_of(tmp_path, "p.kml", data)


def test_json_of_millions_of_lists_is_refused_before_it_takes_memory(tmp_path: Path) -> None:
    with pytest.raises(PlanError, match="more than 2000000 lists"):
        plan_of(tmp_path, "p.geojson", b"[" + b"[]," * 3_000_000 + b"[]]")


@pytest.mark.trust
@pytest.mark.parametrize("suffix", [".geojson", ".kml"])
def test_a_plan_of_20000_lines_is_read_in_seconds(tmp_path: Path, suffix: str) -> None:
    if suffix == ".geojson":
        places = [[15 + i % 100 * 1e-2, 47 + i // 100 * 1e-3] for i in range(LINES)]
        data = collection(*(feature([[x, y], [x + 9e-3, y]], id=f"L{x}/{y}") for x, y in places))
    else:
        data = b"".join(
            f"<Placemark><name>{i}</name><LineString><coordinates>15,{40 + i * 1e-4} "
            f"15.1,{40 + i * 1e-4}</coordinates></LineString></Placemark>".encode()
            for i in range(LINES)
        )
        data = b"<kml>" + data + b"</kml>"
    (tmp_path / f"p{suffix}").write_bytes(data)
    begun_s = time.process_time()
    assert len(read_plan(tmp_path / f"p{suffix}").lines) == LINES
    assert time.process_time() - begun_s < 6.0


def test_names_that_a_person_cannot_see_are_refused_and_blanks_made_one(tmp_path: Path) -> None:
    for hidden in ("a\x1b[2Jb", "a\x00b", "a\u202eb", "a\u200bb", "\ud800"):
        with pytest.raises(PlanError, match="cannot be seen"):
            plan_of(tmp_path, "p.geojson", collection(feature([A, B], id=hidden)))
        with pytest.raises(PlanError, match="cannot be seen"):
            plan_of(tmp_path, "p.geojson", collection(feature([B, C], strip=hidden)))
    plan = plan_of(tmp_path, "p.geojson", collection(feature([A, B], id=" Strip\n 7 ")))
    assert plan.lines[0].id == "Strip 7"
