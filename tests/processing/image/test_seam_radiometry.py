"""Both sides of every seam, and interpolated defects, against light that is known."""

from __future__ import annotations

import pytest

from benchmarks.seam_radiometry import Defects, Seams, measure

Measured = tuple[list[Seams], list[Defects]]

pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Measured:
    """At a fifth of full scale, where noise weighs most, by the laboratory's calibration."""
    folder = tmp_path_factory.mktemp("seams")
    return measure(folder, levels=(0.2,), changes=(False,), own_contrast=False)


def test_heads_agree_along_the_entire_seam_to_two_parts_in_a_thousand(measured: Measured) -> None:
    for seams in measured[0]:
        assert seams.strips > 300, seams.scene
        assert seams.largest <= 0.2, seams.scene
        assert seams.rms < 1.3 * seams.noise, seams.scene


def test_interpolated_defects_are_within_the_noise_of_their_light(measured: Measured) -> None:
    for defects in measured[1]:
        assert defects.pixels > 5000
        assert defects.good_rms == pytest.approx(1.0, abs=0.02)
        assert defects.rms < 1.0, defects.scene
        assert defects.rms_of_contrast < 0.6
