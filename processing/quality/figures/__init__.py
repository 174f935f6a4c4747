"""Figures of the quality report: their types, documented names, and form in quality.json."""

from processing.quality.figures import circumstances, image, stitching
from processing.quality.figures.group import (
    Figure,
    FigureGroup,
    QualityFigures,
    documented_figures,
)

FIGURES = documented_figures()
"""The meaning of every figure by its name; `<band>` and `<cone>` stand for theirs."""

__all__ = [
    "FIGURES",
    "Figure",
    "FigureGroup",
    "QualityFigures",
    "circumstances",
    "image",
    "stitching",
]
