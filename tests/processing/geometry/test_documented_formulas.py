"""The formulas of docs/reference/formats.md, written again from the page alone, against the
code."""

import math
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from processing.geometry.placement import nominal_placements, vip_mm_from_raw, vip_px_from_mm
from processing.rig import ThermalDrift, VirtualImage, load_rig, shipped_rigs

PAGE = Path(__file__).parents[3] / "docs/reference/formats.md"
DC_K, CONE_DC_K = 8.0, 10.0
PIXEL, SHIFTS = (300.0, 200.0), 13


@pytest.fixture(scope="module")
def section():
    return PAGE.read_text().split("## From a pixel to the virtual image\n")[1].split("\n## ")[0]


@pytest.fixture(scope="module")
def example(section):
    return tomllib.loads(re.search(r"```toml\n(.*?)```", section, re.DOTALL)[1])


def from_the_page(example, pixel, shifts):
    """Steps 1 to 8, as on the page: a list of (x, y)."""
    w, h, p, big_w, big_h = 1248, 832, 0.036, 4872, 3192
    sensor, drift, lens = example["sensor"], example["drift"], example["lens"]
    c, r = pixel
    r -= sensor["tdi_row_sign"] * shifts / 2
    u = ((c - (w - 1) / 2) * p, ((h - 1) / 2 - r) * p)
    a = sensor["rotation_rad"] + 1e-6 * drift["rotation_urad_per_k"] * DC_K
    m = sensor["scale"] * (1 + 1e-6 * drift["scale_ppm_per_k"] * DC_K)
    v = (
        m * (u[0] * math.cos(a) - u[1] * math.sin(a)),
        m * (u[0] * math.sin(a) + u[1] * math.cos(a)),
    )
    k = 1 + 1e-6 * (sensor["skew_x_ppm_per_mm"] * v[0] + sensor["skew_y_ppm_per_mm"] * v[1])
    x = sensor["x_mm"] + 1e-3 * drift["x_um_per_k"] * DC_K + v[0] * k
    y = sensor["y_mm"] + 1e-3 * drift["y_um_per_k"] * DC_K + v[1] * k
    r2, f = x * x + y * y, lens["f_mm"]
    radial = lens["k1"] * r2 + lens["k2"] * r2**2 + lens["k3"] * r2**3 + lens["df_mm"] / f
    p1, p2 = lens["p1"], lens["p2"]
    delta = (
        lens["dx0_mm"] + x * radial + (r2 + 2 * x * x) * p1 + 2 * x * y * p2 + x * lens["b1"]
        + y * lens["b2"],
        lens["dy0_mm"] + y * radial + 2 * x * y * p1 + (r2 + 2 * y * y) * p2,
    )  # fmt: skip
    i = (x + delta[0], y + delta[1])
    g = tuple(value / (1 + 1e-6 * lens["f_ppm_per_k"] * CONE_DC_K) for value in i)
    ray = np.array([*g, -f])
    for axis, angle in reversed(list(enumerate(example["cone"]["rotation_rad"]))):
        s, t = math.sin(angle), math.cos(angle)
        one, two = [(1, 2), (2, 0), (0, 1)][axis]
        rotated = ray.copy()
        rotated[one], rotated[two] = t * ray[one] - s * ray[two], s * ray[one] + t * ray[two]
        ray = rotated
    o = (100.0 * ray[0] / -ray[2], 100.0 * ray[1] / -ray[2])
    pixels = (o[0] / p + (big_w - 1) / 2, (big_h - 1) / 2 - o[1] / p)
    return [u, v, (x, y), delta, i, g, o, pixels]


def test_the_example_of_the_page_follows_from_its_formulas(section, example):
    printed = re.findall(r"\| (-?\d+\.\d{6}), (-?\d+\.\d{6}) \|$", section, re.MULTILINE)
    steps = from_the_page(example, PIXEL, SHIFTS)
    assert len(printed) == len(steps) == 8
    for (x, y), step in zip(printed, steps, strict=True):
        assert (float(x), float(y)) == pytest.approx(step, abs=6e-7)


@pytest.mark.parametrize("shifts", [0, 12, 13])
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("pixel", [PIXEL, (0.0, 0.0), (1247.0, 831.0)])
def test_the_pipeline_places_pixels_as_the_page_states(example, shifts, sign, pixel):
    rig = load_rig(shipped_rigs()["ultracam-x-mini"])
    example = {**example, "sensor": {**example["sensor"], "tdi_row_sign": sign}}
    cone = next(c for c in rig.cones if c.role == "pan" and c.name != rig.master_cone)
    table = example["sensor"]
    sensor = replace(
        cone.sensors[0],
        **table,
        width_px=1248,
        height_px=832,
        pitch_um=36.0,
        drift=ThermalDrift(**example["drift"]),
        probe="own",
        calibration_c=20.0,
    )
    lens = replace(cone.lens, **example["lens"], residual_grid=None)
    rotation = tuple(example["cone"]["rotation_rad"])
    cone = replace(
        cone, sensors=(sensor,), lens=lens, rotation_rad=rotation, probe="cone", calibration_c=30.0
    )
    image = VirtualImage(4872, 3192, 36.0, 100.0, colour_ratio=1.0)
    cones = tuple(cone if c.name == cone.name else c for c in rig.cones)
    rig = replace(rig, cones=cones, virtual_image=image)
    temperatures = {"own": 20.0 + DC_K, "cone": 30.0 + CONE_DC_K}
    placement = nominal_placements(rig, temperatures, {sensor.name: shifts})[sensor.name]
    placed = vip_px_from_mm(image, vip_mm_from_raw(placement, np.array([pixel])))[0]
    assert placed == pytest.approx(from_the_page(example, pixel, shifts)[-1], abs=1e-8)
