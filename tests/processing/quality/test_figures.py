"""Figures are typed in groups and keep their documented names in quality.json."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import fields
from typing import Any, get_args, get_type_hints

import pytest

from processing.quality.evaluation import evaluate
from processing.quality.figures import FIGURES, FigureGroup, QualityFigures
from processing.quality.figures.circumstances import DcFigures, GeometryFigures
from processing.quality.figures.group import Names, _field
from processing.quality.figures.image import BandLevelFigures, SharpnessFigures, UnreadFigures
from processing.quality.figures.stitching import (
    AdjustmentFigures,
    BandFitFigures,
    GreenFigures,
    PlatformFigures,
    PrecisionFigures,
    SlipFigures,
    TiePointFigures,
)
from processing.quality.report import as_json

KINDS = [kind for kind in FigureGroup.__subclasses__() if kind.__module__.startswith("processing.")]


def filled(kind: type[FigureGroup]) -> FigureGroup:
    """A group whose figures are all determined, each with a value of its own."""
    hints = get_type_hints(kind)
    values: dict[str, Any] = {}
    for number, field in enumerate(fields(kind)):
        hint = hints[field.name]
        if hint == Names:
            values[field.name] = (f"A{number}", "B")
        elif str in get_args(hint) and int not in get_args(hint) and len(get_args(hint)) == 2:
            values[field.name] = (
                f"text {number}" if type(None) in get_args(hint) else {"red": number}
            )
        elif type(None) in get_args(hint):
            values[field.name] = number if int in get_args(hint) else number + 0.5
        else:
            values[field.name] = {"red": number, "nir": None}
    return kind(**values)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_a_group_returns_from_json_as_it_was_written(kind: type[FigureGroup]) -> None:
    group = filled(kind)
    content = QualityFigures(group).as_json()
    assert content and None not in [content[name] for name in content if "nir" not in name]
    assert QualityFigures.from_json(content).groups == (group,)


def test_all_groups_together_return_from_json_as_they_were_written() -> None:
    figures = QualityFigures(*(filled(kind) for kind in KINDS))
    again = QualityFigures.from_json(figures.as_json())
    assert set(map(repr, again.groups)) == set(map(repr, figures.groups))


def test_every_figure_belongs_to_one_group_and_has_a_meaning() -> None:
    names = [name for kind in KINDS for name in kind().as_json()]
    assert [name for name, count in Counter(names).items() if count > 1] == []
    assert set(names) <= set(FIGURES) and all(FIGURES.values())


def test_a_group_that_was_not_looked_for_writes_nothing_and_one_without_result_null() -> None:
    content = QualityFigures(SharpnessFigures(), None, SlipFigures(slip_sensors=())).as_json()
    assert set(content.values()) == {None} and "sharpness" in content
    assert set(content) == {"sharpness", *(field.name for field in fields(SlipFigures))}
    assert QualityFigures(SharpnessFigures()).of(PrecisionFigures) == PrecisionFigures()


def test_names_are_comma_separated_and_figures_of_bands_and_cones_named_after_them() -> None:
    figures = QualityFigures(
        AdjustmentFigures(sigma0_px=0.05, undetermined=("SU00", "SU10")),
        DcFigures(dc_k=1.5, dc_k_by_cone={"0": 1.5, "G": None}),
        BandFitFigures({"red": 40}, {"red": 0.2}),
        BandLevelFigures({"nir": 0.8}),
    )
    content = figures.as_json()
    assert content["undetermined"] == "SU00, SU10"
    assert content["dc_k"] == 1.5 and content["dc_k_0"] == 1.5 and content["dc_k_G"] is None
    assert content["red_points"] == 40 and content["red_rms_px"] == 0.2
    assert content["nir_over_pan"] == 0.8


def test_a_figure_of_its_own_name_is_none_of_a_band() -> None:
    figures = QualityFigures.from_json({"green_rms_px": 0.1, "platform_shift_px": 2.0})
    assert figures.groups == (GreenFigures(0.1), PlatformFigures(platform_shift_px=2.0))


def test_a_later_group_replaces_one_of_its_type() -> None:
    figures = QualityFigures(SharpnessFigures(0.3), UnreadFigures(0.1, "A"), SharpnessFigures(0.4))
    assert figures.of(SharpnessFigures).sharpness == 0.4 and len(figures.groups) == 2


@pytest.mark.parametrize("value", ["wide", True, [1.0], {"a": 1}])
def test_a_value_of_another_type_is_not_determined(value: object) -> None:
    figures = QualityFigures.from_json({"tilt_deg": value, "crab_deg": 3, "tie_points_pp": 2.5})
    assert figures.of(GeometryFigures) == GeometryFigures(crab_deg=3)
    assert figures.of(TiePointFigures).tie_points_pp is None
    assert QualityFigures.from_json({"outliers": True}).of(AdjustmentFigures).outliers is None
    for names in (7, "", None):
        assert QualityFigures.from_json({"slip_sensors": names}).of(SlipFigures) == SlipFigures()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_is_none_in_the_report(value: float) -> None:
    given = QualityFigures(
        SharpnessFigures(value), DcFigures(value, {"0": value, "1": 2.0}), TiePointFigures(9, 9)
    )
    report = evaluate(given)
    assert report.figures.of(SharpnessFigures).sharpness is None
    assert as_json(report)["figures"] == {
        "sharpness": None,
        "dc_k": None,
        "dc_k_0": None,
        "dc_k_1": 2.0,
        "tie_points_pp": 9,
        "tie_points_pc": 9,
    }


def test_a_figure_without_a_meaning_is_refused() -> None:
    with pytest.raises(TypeError, match="width_px has no documented meaning"):
        _field("width_px", float)
