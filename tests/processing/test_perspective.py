"""Heads that look apart become strict perspectives: held against the emulator's own camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from processing.geometry.conditions import Conditions
from processing.pipelines.perspective import (
    HeadPipeline,
    HeadSettings,
    has_head_images,
    perspective_of,
    raw_of_perspective,
)
from processing.quality.figures.image import SignalStepFigures, UnreadFigures, WordFormatFigures
from processing.quality.figures.stitching import MethodFigures
from processing.quality.report import QualityReport
from processing.rig import Cone, Rig, find_rig
from sim_hw.world.true_camera import true_camera, undistorted


def distorting(name: str, size_mm: float) -> Rig:
    """Lenses that distort by so much at the corner, a principal point off by 50 um."""
    rig = find_rig(name)
    cones = []
    for cone in rig.cones:
        sensor = cone.sensors[0]
        edge = np.hypot(sensor.width_px, sensor.height_px) * sensor.pitch_mm / 2.0
        k1 = -size_mm / edge**3
        lens = replace(cone.lens, k1=k1, k2=-0.4 * k1 / edge**2, p1=2e-6, dx0_mm=0.02, df_mm=0.03)
        cones.append(replace(cone, lens=lens, sensors=(replace(sensor, x_mm=0.05, y_mm=-0.03),)))
    return replace(rig, cones=tuple(cones))


@pytest.mark.parametrize("name", ["midas", "midas-mini"])
def test_a_pixel_of_the_perspective_is_where_the_true_lens_put_it(name: str) -> None:
    rig = distorting(name, 0.1)
    camera = true_camera(rig, 1, displaced_px={})
    for cone in rig.cones:
        cone = rig.cone(cone.name)
        sensor = cone.sensors[0]
        image = perspective_of(cone)
        c, r = np.meshgrid(
            np.linspace(0, image.width_px - 1, 9), np.linspace(0, image.height_px - 1, 7)
        )
        at = np.stack([c.ravel(), r.ravel()], axis=1)
        raw = raw_of_perspective(cone, {}, at)
        measured = camera.layer_from_pixel(sensor, raw[:, 0], raw[:, 1], temperature_c=20.0)
        ideal = undistorted(cone.lens, measured)
        x = (at[:, 0] - (image.width_px - 1) / 2) * image.pitch_mm
        y = ((image.height_px - 1) / 2 - at[:, 1]) * image.pitch_mm
        # The place error that true_camera draws is zero for these heads.
        assert np.abs(ideal - np.stack([x, y], axis=1)).max() < 1e-4 * image.pitch_mm
        assert np.abs(raw - at).max() > 5.0, "a lens that distorts moves its pixels"


def test_what_lies_on_a_straight_line_in_the_perspective_does_so_after_resampling() -> None:
    rig = distorting("midas-mini", 0.1)
    cone = replace(
        rig.cone("7"),
        bands=("pan",),
        sensors=(replace(rig.cone("7").sensors[0], colour_filter_array="none", black_dn=0.0),),
    )
    single_cone_rig = replace(rig, cones=(cone,), master_cone="7", reference_cone="7")
    expected, found = _waves(cone, single_cone_rig)
    seen = found > 0
    assert seen.mean() > 0.95
    off = found[seen].astype(float) / 8.0 - expected[seen]
    # The steepest slope is 59 DN/px. Rounding of the frame alone leaves 0.29 DN.
    assert np.sqrt(np.mean(off**2)) < 0.009 * 59.0
    assert abs(off.mean()) < 0.2


def _waves(cone: Cone, rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Waves over the perspective, drawn through the lens by the emulator's own projection."""
    sensor, image = cone.sensors[0], perspective_of(cone)
    camera = true_camera(rig, 1, displaced_px={})
    c, r = np.meshgrid(np.arange(sensor.width_px) * 1.0, np.arange(sensor.height_px) * 1.0)
    ideal = undistorted(
        cone.lens, camera.layer_from_pixel(sensor, c, r, temperature_c=cone.calibration_c)
    )

    def wave(x_mm: np.ndarray, y_mm: np.ndarray) -> np.ndarray:
        return 2000.0 + 900.0 * np.sin(x_mm / 0.11) * np.cos(y_mm / 0.13)

    frame = np.round(wave(ideal[..., 0], ideal[..., 1])).astype(np.uint16)
    product = HeadPipeline(rig).process({sensor.name: frame}, Conditions())
    found = product.heads[cone.name].bands["pan"]
    x = (c - (image.width_px - 1) / 2) * image.pitch_mm
    y = ((image.height_px - 1) / 2 - r) * image.pitch_mm
    return wave(x, y), found


def test_only_rigs_whose_heads_have_diverging_axes_are_images_of_their_own() -> None:
    assert has_head_images(find_rig("midas"))
    assert not has_head_images(find_rig("rededge"))
    assert not has_head_images(find_rig("ultracam-x"))
    with pytest.raises(ValueError, match="there is no"):
        HeadPipeline(find_rig("ultracam-x"))


def test_a_missing_frame_leaves_the_other_heads_and_reports_it() -> None:
    rig = find_rig("midas-mini")
    frames = {
        s.name: np.full((s.height_px, s.width_px), 1000, np.uint16)
        for s in rig.sensors
        if s.name != "8"
    }
    product = HeadPipeline(rig).process(frames, Conditions())
    assert set(product.heads) == {"nadir", "5", "7", "19"}
    assert product.report.figures.of(MethodFigures).missing_sensors == ("8",)
    assert product.report.verdict.value != "good"
    for head in product.heads.values():
        assert list(head.bands) == ["red", "green", "blue"]


def _lit_heads(rig: Rig) -> dict[str, np.ndarray]:
    """Frames of even ground with noise, by sensor name."""
    random = np.random.default_rng(3)
    return {
        s.name: (900.0 + random.normal(0.0, 12.0, (s.height_px, s.width_px))).astype(np.uint16)
        for s in rig.sensors
    }


@pytest.mark.trust
def test_wrong_values_steps_and_unread_lines_of_a_head_are_named() -> None:
    rig = find_rig("midas-mini")
    pipeline, healthy = HeadPipeline(rig, settings=HeadSettings(threads=1)), _lit_heads(rig)
    assert pipeline.process(healthy, Conditions()).report.verdict.value == "good"

    def report(change: np.ndarray) -> QualityReport:
        return pipeline.process({**healthy, "8": change}, Conditions()).report

    swapped = report(healthy["8"].byteswap())
    assert swapped.verdict.value == "refly"
    assert swapped.figures.of(WordFormatFigures).word_format_sensors == ("8",)
    stepped = healthy["8"].copy()
    stepped[500:] += np.uint16(90)
    step = report(stepped)
    assert (
        step.verdict.value == "usable"
        and step.figures.of(SignalStepFigures).signal_step_sensor == "8"
    )
    assert abs(step.figures.of(SignalStepFigures).signal_step_at - 499) <= 1
    cut = healthy["8"].copy()
    cut[-30:] = 0
    unread = report(cut)
    assert (
        unread.verdict.value == "usable"
        and unread.figures.of(UnreadFigures).unread_worst_sensor == "8"
    )
    sentences = " ".join(finding.sentence for finding in unread.findings)
    assert "was not read out" in sentences and "signal changes" not in sentences
