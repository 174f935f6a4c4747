"""Figures of the stitching: adjustment, displacements, platform, accuracy, bands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

from processing.quality.figures.group import FigureGroup, Key, Names


@dataclass(frozen=True)
class MethodFigures(FigureGroup):
    """How the image was made, and what was missing."""

    method: Annotated[str | None, "how the image was stitched: free, fixed"] = None
    missing_sensors: Annotated[Names, "sensors without a frame, comma separated"] = ()


@dataclass(frozen=True)
class AdjustmentFigures(FigureGroup):
    """The adjustment of one exposure."""

    sigma0: Annotated[float | None, "a posteriori standard deviation of unit weight"] = None
    sigma0_px: Annotated[float | None, "sigma0 as one P/P coordinate difference, PAN pixels"] = None
    sigma0_um: Annotated[float | None, "the same in um in the image plane"] = None
    redundancy: Annotated[float | None, "redundancy of the adjustment"] = None
    outliers: Annotated[int | None, "tie points rejected by data snooping"] = None
    undetermined: Annotated[
        Names,
        "sensors and cones the tie points did not place, held at calibration and TDM",
    ] = ()


@dataclass(frozen=True)
class TiePointFigures(FigureGroup):
    """Tie points that the adjustment used."""

    tie_points_pp: Annotated[int | None, "tie points between PAN sensors"] = None
    tie_points_pc: Annotated[int | None, "tie points between PAN and the colour master"] = None


@dataclass(frozen=True)
class PoorestOverlapFigures(FigureGroup):
    """The overlap of PAN sensors with the fewest tie points."""

    tie_points_min_overlap: Annotated[int | None, "tie points in the poorest overlap"] = None
    tie_points_min_overlap_name: Annotated[str | None, "which overlap that is"] = None


@dataclass(frozen=True)
class SaturatedOverlapFigures(FigureGroup):
    """Saturation in the poorest overlap, where its tie points are too few."""

    tie_points_min_overlap_burnt: Annotated[
        float | None,
        "share of matching windows there that hold saturated pixels, where points are too few",
    ] = None


@dataclass(frozen=True)
class GreenFigures(FigureGroup):
    """The colour master against PAN."""

    green_rms_px: Annotated[float | None, "residual of P/C tie points, colour pixels"] = None


@dataclass(frozen=True)
class BandFitFigures(FigureGroup):
    """Registration of the bands, by band."""

    points_by_band: Annotated[
        Mapping[str, int | None],
        "tie points of a band with green",
        Key("<band>_points"),
    ] = field(default_factory=dict)
    rms_px_by_band: Annotated[
        Mapping[str, float | None],
        "residual of a band to green, colour pixels",
        Key("<band>_rms_px"),
    ] = field(default_factory=dict)


@dataclass(frozen=True)
class BandShiftFigures(FigureGroup):
    """Displacement of the bands, by band."""

    shift_px_by_band: Annotated[
        Mapping[str, float | None],
        "largest displacement of raw pixels against the reference band, pixels",
        Key("<band>_shift_px"),
    ] = field(default_factory=dict)


@dataclass(frozen=True)
class PrecisionFigures(FigureGroup):
    """Stated accuracy of the stitched image."""

    stitched_sigma_px: Annotated[
        float | None,
        "standard deviation of a stitched point, RMS over PAN sensors, pixels",
    ] = None
    stitched_sigma_worst_px: Annotated[float | None, "the same of the worst PAN sensor"] = None
    stitched_sigma_worst_sensor: Annotated[str | None, "which sensor that is"] = None


@dataclass(frozen=True)
class DisplacedSensorFigures(FigureGroup):
    """The one displaced sensor, if there is one."""

    displaced_sensor: Annotated[str | None, "name of the one master sensor found displaced"] = None


@dataclass(frozen=True)
class DisplacementTestFigures(FigureGroup):
    """Test of the calibration against the stitching."""

    displacement_test: Annotated[
        float | None,
        "test statistic over its critical value; above one is significant",
    ] = None
    relative_displacements: Annotated[
        Names,
        "pairs of sensors of one cone found displaced against each other",
    ] = ()


@dataclass(frozen=True)
class DisplacementFigures(FigureGroup):
    """Size of a displacement, and what else explains it."""

    displacement_x_px: Annotated[
        float | None,
        "its displacement against calibration and TDM, PAN pixels, x right",
    ] = None
    displacement_y_px: Annotated[float | None, "the same, y up"] = None
    displacement_sigma_px: Annotated[
        float | None,
        "standard deviation of a coordinate of it",
    ] = None
    displaced_alternatives: Annotated[
        Names,
        "master sensors that explain the stitching nearly as well",
    ] = ()
    displaced_several: Annotated[
        int | None,
        "1 where one displaced sensor does not explain it all: several moved",
    ] = None


@dataclass(frozen=True)
class MisreadProbeFigures(FigureGroup):
    """A probe whose error explains the stitching."""

    misread_probe: Annotated[
        str | None,
        "probe of the master cone whose error explains the stitching as well as the "
        "displaced sensor; without one, better than any",
    ] = None
    misread_k: Annotated[float | None, "how much too high it reads then, K"] = None
    misread_sigma_k: Annotated[float | None, "standard deviation of that"] = None


@dataclass(frozen=True)
class PlatformFigures(FigureGroup):
    """Mountings or layers against the platform calibration."""

    platform_test: Annotated[
        float | None,
        "mountings of converging heads, or scale and rotation of the layers of the other "
        "cones, against the platform calibration: test statistic over its critical value; "
        "above one is significant",
    ] = None
    platform_shift_px: Annotated[
        float | None,
        "how far the head that turned most went by it, PAN pixels: of converging heads the "
        "farthest point of its frame, else its middle",
    ] = None
    platform_shift_head: Annotated[str | None, "which head that is"] = None
    platform_alternatives: Annotated[Names, "cones that explain them nearly as well"] = ()


@dataclass(frozen=True)
class HeadFitFigures(FigureGroup):
    """What remains between converging heads."""

    platform_residual_px: Annotated[
        float | None,
        "largest shift an affine transformation still finds between heads",
    ] = None


@dataclass(frozen=True)
class HeadScaleFigures(FigureGroup):
    """Scale of converging heads."""

    platform_scale_ppm: Annotated[
        float | None,
        "largest difference of scale between a converging head and its neighbours that its "
        "rotation does not explain",
    ] = None
    platform_scale_head: Annotated[str | None, "which head that is"] = None


@dataclass(frozen=True)
class LayerFigures(FigureGroup):
    """Layers of the other cones against the master cone."""

    platform_causes: Annotated[
        Names,
        "cones whose change explains the layers, comma separated; the master's name where "
        "all others changed alike",
    ] = ()
    platform_master_changed: Annotated[
        int | None,
        "1 where the master cone is among these: the image is not corrected",
    ] = None
    common_scale_ppm: Annotated[
        float | None,
        "change of scale that all layers share against calibration and drift",
    ] = None
    common_scale_sigma_ppm: Annotated[
        float | None,
        "standard deviation of that by calibration, drift and tie points",
    ] = None


@dataclass(frozen=True)
class SlipFigures(FigureGroup):
    """Bands of frames that were read out shifted."""

    slip_sensor: Annotated[
        str | None,
        "frame with a band of rows or columns that lies elsewhere than the rest",
    ] = None
    slip_alternatives: Annotated[
        Names,
        "frames that explain the same tie points nearly as well",
    ] = ()
    slip_cone: Annotated[str | None, "the cone of that frame"] = None
    slip_px: Annotated[float | None, "by how much it is shifted, PAN pixels"] = None
    slip_axis: Annotated[str | None, "rows or columns"] = None
    slip_first: Annotated[int | None, "first row or column of the band, raw pixels"] = None
    slip_last: Annotated[int | None, "last row or column of the band"] = None
    slip_sensors: Annotated[Names, "all frames with such a band, comma separated"] = ()


@dataclass(frozen=True)
class SupportFigures(FigureGroup):
    """Sensors that calibration helps to place."""

    resting_on_calibration: Annotated[
        Names,
        "PAN sensors that tie points place too poorly, supported",
    ] = ()
