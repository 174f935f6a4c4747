"""Drawings are well-formed, name everything, and cannot be broken by a name."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import pytest

from processing.mosaic.mosaic_plots import focal_planes_svg
from processing.rig import find_rig


@pytest.mark.parametrize("name", ["ultracam-x", "ultracam-x-mini"])
def test_focal_planes_name_every_sensor_in_plane_and_image(name: str) -> None:
    rig = find_rig(name)
    root = ET.fromstring(focal_planes_svg(rig))
    texts = [element.text or "" for element in root.iter() if element.tag.endswith("text")]
    for cone in rig.cones:
        assert any(text.startswith(f"cone {cone.name}") for text in texts)
        for sensor in cone.sensors:
            assert texts.count(sensor.name) == (2 if cone.role == "pan" else 1)
    # Twelve overlap strips carry their size in pixels.
    assert sum(re.fullmatch(r"\d+ x \d+", text) is not None for text in texts) == 12


def test_a_rig_without_a_virtual_image_has_its_focal_planes() -> None:
    rig = replace(find_rig("ultracam-x-mini"), virtual_image=None)
    assert "virtual image" not in focal_planes_svg(rig)


def test_a_hostile_name_stays_text() -> None:
    rig = replace(find_rig("ultracam-x-mini"), name='<script>alert("1")</script>&')
    root = ET.fromstring(focal_planes_svg(rig))
    assert not [element for element in root.iter() if element.tag.endswith("script")]
