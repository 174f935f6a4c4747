"""Regions that are less sharp: half of the windows first, all where these are suspicious."""

from __future__ import annotations

import numpy as np
import pytest

from processing.quality import local_sharpness
from processing.quality.common_windows import WINDOWS, CommonWindows, _centres
from processing.quality.local_sharpness import LocalBlur, local_blur_figures
from processing.rig import find_rig

RIG = find_rig("ultracam-x-mini")


def _windows(every: int) -> CommonWindows:
    none = np.zeros((0, 0))
    return CommonWindows(
        names=(),
        pan=np.zeros(0, np.bool_),
        place=none,
        mean=none,
        noise=none,
        noise_reduced=none,
        near=none,
        far=none,
        curved=none,
        fine=none,
        every=every,
        finer=lambda: _windows(1),
    )


@pytest.mark.parametrize(
    ("colour", "pan", "every"), [(0.05, 0.2, 2), (0.07, 0.2, 1), (0.05, 0.4, 1), (-0.1, -0.4, 2)]
)
def test_all_windows_are_measured_where_half_of_them_are_suspicious(
    monkeypatch: pytest.MonkeyPatch, colour: float, pan: float, every: int
) -> None:
    def blurs(ground: CommonWindows) -> tuple[LocalBlur, ...]:
        region = (0.0, 0.0, 0.5, 0.5)
        share = 1.0 if ground.every == 2 else 0.5
        return (
            LocalBlur("R", False, share * colour, region, "rows"),
            LocalBlur("SU11", True, share * pan, region, "rows"),
        )

    monkeypatch.setattr(local_sharpness, "_local_blurs", blurs)
    found = local_blur_figures(RIG, _windows(2))
    share = 1.0 if every == 2 else 0.5
    assert found.colour_blur_deficit == pytest.approx(share * colour)
    assert found.pan_blur_deficit == pytest.approx(share * pan)


def test_half_of_the_windows_lie_as_on_a_chessboard_among_all() -> None:
    image = RIG.virtual_image
    assert image is not None
    every, half = ({tuple(place) for place in _centres(image, step)} for step in (1, 2))
    columns, rows = WINDOWS
    assert len(every) == columns * rows and len(half) == len(every) // 2 and half < every
    pitch = np.array([image.width_px / columns, image.height_px / rows])
    number = np.rint(np.array(sorted(half)) / pitch - 0.5).astype(int)
    assert not (number.sum(axis=1) % 2).any()
