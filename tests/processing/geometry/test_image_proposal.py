"""A virtual image proposed for heads that overlap, compared with a brute-force projection."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace

import numpy as np
import pytest

from processing.geometry.image_proposal import (
    BODY_FROM_CAMERA,
    ProposalError,
    boresight_deg,
    propose_image,
)
from processing.geometry.placement import nominal_placements, raw_from_vip_mm, vip_mm_from_px
from processing.geometry.rotation import level_from_body, rotation_matrix
from processing.rig import Rig, rig_from_mapping

HEAD = """
[[cone]]
name = "{name}"
role = "pan"
bands = ["pan"]
position_mm = [0.0, {right}, 0.0]
rotation_rad = [0.0, {phi}, 0.0]
probe = ""
calibration_c = 20.0
[cone.lens]
f_mm = 12.0
[[cone.sensor]]
name = "{name}"
width_px = 640
height_px = 480
pitch_um = 7.0
x_mm = 0.0
y_mm = 0.0
"""


def rig(*angles_deg: float, master: int = 0) -> Rig:
    names = [f"h{k}" for k in range(len(angles_deg))]
    text = f"""
name = "heads"
timing = "synchronous"
frame_interval_s = 1.0
master_cone = "{names[master]}"
reference_cone = "{names[master]}"
""" + "".join(
        HEAD.format(name=name, right=40.0 * k, phi=-math.radians(angle))
        for k, (name, angle) in enumerate(zip(names, angles_deg, strict=True))
    )
    return rig_from_mapping(tomllib.loads(text), "rig.toml")


def test_the_image_is_covered_everywhere_and_no_larger_one_is() -> None:
    proposal = propose_image(rig(0.0, 18.0))
    image = proposal.image

    def covered(width: int, height: int) -> bool:
        wide = replace(proposal.rig, virtual_image=replace(image, width_px=width, height_px=height))
        assert wide.virtual_image is not None
        c, r = np.meshgrid(np.linspace(0, width - 1, 61), np.linspace(0, height - 1, 61))
        vip = vip_mm_from_px(wide.virtual_image, np.stack([c.ravel(), r.ravel()], axis=1))
        inside = np.zeros(len(vip), bool)
        for placement in nominal_placements(wide, {}, {}).values():
            raw = raw_from_vip_mm(placement, vip)
            inside |= ((raw > -0.5) & (raw < np.array([639.5, 479.5]))).all(axis=1)
        return bool(inside.all())

    assert covered(image.width_px, image.height_px)
    assert not covered(image.width_px, image.height_px + 16)
    assert not covered(image.width_px + 16, image.height_px)
    assert image.width_px > 950 and image.f_mm == 12.0 and image.pitch_um == 7.0


def test_the_overlap_is_that_of_the_fields() -> None:
    (overlap,) = propose_image(rig(0.0, 18.0)).overlaps
    # Inner borders of both fields in the middle row: 9 degrees inwards of half a field.
    half = math.atan(639 * 0.007 / 2 / 12.0)
    width = 2.0 * 12.0 * math.tan(half - math.radians(9.0)) / 0.007
    assert overlap.width_px == pytest.approx(width, rel=0.03)
    assert overlap.heads == ("h0", "h1") and 0.1 < overlap.share < 0.3


def test_the_virtual_camera_is_in_the_middle_and_every_head_looks_where_it_did() -> None:
    before = rig(0.0, 18.0)
    proposal = propose_image(before)
    assert proposal.rig.master_cone is None
    for cone in before.cones:
        own = rotation_matrix(*proposal.rig.cone(cone.name).rotation_rad)
        assert np.allclose(proposal.turned @ own, rotation_matrix(*cone.rotation_rad), atol=1e-12)
    phi = [cone.rotation_rad[1] for cone in proposal.rig.cones]
    assert phi == pytest.approx([math.radians(9.0), -math.radians(9.0)])


def test_the_boresight_keeps_heads_and_places_in_the_vehicle() -> None:
    before = rig(0.0, 18.0)
    former = (-9.0, 1.5, 90.0)
    proposal = propose_image(before)
    new = boresight_deg(former, proposal.turned)
    imu_before = level_from_body(*np.radians(former)) @ BODY_FROM_CAMERA
    imu_after = level_from_body(*np.radians(new)) @ BODY_FROM_CAMERA
    for cone in before.cones:
        own = proposal.rig.cone(cone.name)
        assert np.allclose(
            imu_after @ rotation_matrix(*own.rotation_rad),
            imu_before @ rotation_matrix(*cone.rotation_rad),
            atol=1e-12,
        )
        assert np.allclose(
            level_from_body(*np.radians(new)) @ own.position_mm,
            level_from_body(*np.radians(former)) @ cone.position_mm,
            atol=1e-9,
        )


def test_three_heads_overlap_in_a_chain() -> None:
    proposal = propose_image(rig(-18.0, 0.0, 18.0, master=1))
    assert [o.heads for o in proposal.overlaps] == [("h0", "h1"), ("h1", "h2")]
    assert np.allclose(proposal.turned, np.eye(3))
    assert proposal.image.width_px > 1400


def test_narrow_overlaps_are_warned_of() -> None:
    proposal = propose_image(rig(0.0, 19.0))
    assert proposal.overlaps[0].width_px < 128
    assert "give tie points over any ground" in proposal.warnings[0]
    assert not propose_image(rig(0.0, 15.0)).warnings


@pytest.mark.parametrize(
    ("angles", "sentence"),
    [
        ((0.0, 30.0), "overlap by 0 px at most; 48 px at least"),
        ((0.0, 80.0), "40 degrees away from the middle"),
        ((0.0, 0.5), "see the same field"),
        ((0.0,), "has one head"),
    ],
)
def test_heads_that_make_no_image_are_refused(angles: tuple[float, ...], sentence: str) -> None:
    with pytest.raises(ProposalError, match=sentence):
        propose_image(rig(*angles))


def test_rigs_of_another_kind_are_refused_with_the_reason() -> None:
    two = rig(0.0, 18.0)
    colour = replace(two, cones=(two.cones[0], replace(two.cones[1], role="colour")))
    justified = replace(two.cones[0].sensors[0], justified="left")
    left = replace(two, cones=(replace(two.cones[0], sensors=(justified,)), two.cones[1]))
    for other, sentence in (
        (colour, "h1 of heads are colour heads"),
        (replace(two, timing="syntopic"), "is syntopic"),
        (left, "left-justified"),
        (propose_image(two).rig, r"has a \[virtual_image\]"),
    ):
        with pytest.raises(ProposalError, match=sentence):
            propose_image(other)
