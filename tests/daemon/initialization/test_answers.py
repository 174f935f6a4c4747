"""Answers in other units, out of range, or impossible together are refused with what would be
right."""

from __future__ import annotations

import pytest

from daemon.initialization.answers import (
    AnswerError,
    Arrangement,
    arrangement_problem,
    focal_length_mm,
    lengths,
    optics_problem,
    pixel_size_um,
)
from tests.daemon.initialization.heads import head


@pytest.mark.parametrize(
    ("text", "unit", "count", "expected"),
    [
        ("50", "mm", 1, (50.0,)),
        ("50 mm", "mm", 2, (50.0, 50.0)),
        ("0.05 m", "mm", 1, (50.0,)),
        ("5cm 51.5", "mm", 2, (50.0, 51.5)),
        ("0.00345 mm", "um", 1, (3.45,)),
        ("3450 nm", "um", 1, (3.45,)),
        ("5.5µm 4.4", "um", None, (5.5, 4.4)),
        (" 1e1 ", "mm", None, (10.0,)),
    ],
)
def test_lengths_are_read_with_their_units(
    text: str, unit: str, count: int | None, expected: tuple[float, ...]
) -> None:
    assert lengths(text, unit, count) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "count", "reason"),
    [
        ("5,5", 1, "decimal point"),
        ("50 51", 3, "one for each of 3"),
        ("", 1, "no value"),
        ("fifty", 1, "no number in mm"),
        ("50x", 1, "no number in mm"),
        ("50 km", 1, "no number in mm"),
        ("nan", 1, "no number in mm"),
        ("0x50", 1, "no number in mm"),
    ],
)
def test_what_is_no_length_is_refused(text: str, count: int, reason: str) -> None:
    with pytest.raises(AnswerError, match=reason):
        lengths(text, "mm", count)


@pytest.mark.parametrize(
    ("value", "meant"),
    [(0.05, "write 50"), (0.0238, "write 23.8"), (50_000.0, "write 50"), (-50.0, "outside")],
)
def test_a_focal_length_in_metres_or_micrometres_is_refused(value: float, meant: str) -> None:
    with pytest.raises(AnswerError, match=meant):
        focal_length_mm(value)


@pytest.mark.parametrize(
    ("value", "meant"),
    [(0.0055, "write 5.5"), (0.00345, "write 3.45"), (3450.0, "write 3.45"), (0.0, "outside")],
)
def test_a_pixel_size_in_mm_or_nm_is_refused(value: float, meant: str) -> None:
    with pytest.raises(AnswerError, match=meant):
        pixel_size_um(value)


@pytest.mark.parametrize("limit", [1.0, 2000.0])
def test_limits_belong_to_the_range(limit: float) -> None:
    assert focal_length_mm(limit) == limit


@pytest.mark.parametrize(("focal_mm", "pixel_um"), [(1.5, 7.2), (1900.0, 3.45)])
def test_values_that_make_no_camera_together_are_refused(focal_mm: float, pixel_um: float) -> None:
    problem = optics_problem(head(), focal_mm, pixel_um)
    assert problem is not None and "degrees; check focal length (mm) and pixel size" in problem


def test_a_sensor_larger_than_any_is_refused() -> None:
    problem = optics_problem(head(width_px=14_000), 100.0, 12.0)
    assert problem is not None and "sensor of 168 mm" in problem


def test_usual_optics_are_accepted() -> None:
    assert optics_problem(head(), 50.0, 5.5) is None
    assert optics_problem(head(width_px=14_204, height_px=10_652), 90.0, 3.76) is None


@pytest.mark.parametrize(
    ("arrangement", "counts"),
    [
        (Arrangement.SINGLE, [1]),
        (Arrangement.SIDE_BY_SIDE, [2, 3, 16]),
        (Arrangement.FORE_AFT, [2, 3, 16]),
        (Arrangement.NADIR_OBLIQUE, [2, 3, 4, 5]),
    ],
)
def test_an_arrangement_has_its_number_of_heads(
    arrangement: Arrangement, counts: list[int]
) -> None:
    accepted = [n for n in range(1, 17) if arrangement_problem(arrangement, n) is None]
    assert set(counts) <= set(accepted) and accepted[0] == counts[0] and accepted[-1] == counts[-1]
