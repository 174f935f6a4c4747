"""Figures that need no pixels: time, temperature, motion, attitude, exposure times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

from processing.quality.figures.group import FigureGroup, Key, Names


@dataclass(frozen=True)
class DcFigures(FigureGroup):
    """Temperature against that of the calibration."""

    dc_k: Annotated[
        float | None,
        "temperature at exposure less that at calibration, mean of the PAN cones, K",
    ] = None
    dc_k_by_cone: Annotated[
        Mapping[str, float | None],
        "one cone's own dC, K",
        Key("dc_k_<cone>"),
    ] = field(default_factory=dict)


@dataclass(frozen=True)
class EstimatedDcFigures(FigureGroup):
    """The same by stitching."""

    dc_estimated_k: Annotated[
        float | None,
        "the same as the stitching sees it, cones of two or more CCDs, K",
    ] = None
    dc_estimated_sigma_k: Annotated[
        float | None,
        "standard deviation of that; null where it cannot be determined",
    ] = None
    dc_disagreement: Annotated[
        Names,
        "cones whose probes and stitching disagree, comma separated",
    ] = ()


@dataclass(frozen=True)
class ProjectionFigures(FigureGroup):
    """Projection of a virtual camera."""

    projection_height_m: Annotated[
        float | None,
        "height above ground a virtual camera projected its heads onto",
    ] = None
    head_parallax_px: Annotated[
        float | None,
        "parallax relief may leave between PAN heads after that, PAN pixels",
    ] = None


@dataclass(frozen=True)
class SmearFigures(FigureGroup):
    """Motion during exposure."""

    smear_along_px: Annotated[
        float | None,
        "motion during exposure along track that TDI left, worst PAN cone, pixels",
    ] = None
    smear_across_px: Annotated[float | None, "the same across track"] = None
    tdi_shifts_max: Annotated[
        int | None, "largest TDI count of a PAN sensor by the record; 0 also where it states none"
    ] = None


@dataclass(frozen=True)
class WorstHeadFigures(FigureGroup):
    """The head that moves most, without a virtual image."""

    smear_worst_head: Annotated[
        str | None,
        "without a virtual image: the head whose ground moves farthest; the way's length, "
        "where the head sees it longest, is smear_along_px",
    ] = None


@dataclass(frozen=True)
class GeometryFigures(FigureGroup):
    """Attitude, overlap, sun and GSD."""

    gsd_m: Annotated[float | None, "ground sampling distance of the virtual image"] = None
    tilt_deg: Annotated[float | None, "largest of roll and pitch"] = None
    crab_deg: Annotated[float | None, "angle between the image's along axis and the track"] = None
    forward_overlap: Annotated[
        float | None,
        "share of the ground seen that the image before it on the line saw, too",
    ] = None
    sidelap: Annotated[
        float | None,
        "share of it that images of the neighbouring line saw, the poorer side",
    ] = None
    sun_deg: Annotated[float | None, "elevation of the sun"] = None
    tdi_shifts: Annotated[int | None, "TDI shifts of the reference cone"] = None
    temperature_age_s: Annotated[float | None, "age of the oldest temperature used"] = None


@dataclass(frozen=True)
class ParallaxFigures(FigureGroup):
    """Relief between PAN and colour."""

    parallax_px: Annotated[
        float | None,
        "parallax relief may leave between PAN and the colour master, PAN pixels",
    ] = None


@dataclass(frozen=True)
class UnknownExposureFigures(FigureGroup):
    """Exposure times that the record does not state."""

    exposure_unknown_sensors: Annotated[
        Names,
        "colour frames whose exposure time the record does not state while it states "
        "others, comma separated",
    ] = ()


@dataclass(frozen=True)
class ImplausibleExposureFigures(FigureGroup):
    """Exposure times that cannot be."""

    exposure_implausible_sensors: Annotated[
        Names,
        "frames whose exposure time in the record cannot be and was taken as unknown, comma "
        "separated",
    ] = ()


@dataclass(frozen=True)
class ExposureScaleFigures(FigureGroup):
    """Levels corrected for an exposure time of their own."""

    exposure_scaled_sensor: Annotated[
        str | None,
        "frame whose level was corrected most for an exposure time other than that of the "
        "other cones",
    ] = None
    exposure_scale: Annotated[float | None, "what its signal was multiplied by"] = None


@dataclass(frozen=True)
class TimeFigures(FigureGroup):
    """Uncertainty of the exposure's time."""

    time_sigma_ns: Annotated[
        float | None,
        "standard deviation of the time of the least certain frame",
    ] = None
    time_error_px: Annotated[
        float | None,
        "way flown in that, speed x sigma, as a fraction of the GSD",
    ] = None
    time_sigma_receiver_ns: Annotated[float | None, "part of it: the receiver's event mark"] = None
    time_sigma_clock_ns: Annotated[
        float | None,
        "part of it: the host's clock, where there is no mark",
    ] = None
    time_sigma_trigger_ns: Annotated[
        float | None,
        "part of it: when the pulse was given, where there is no mark",
    ] = None
    time_sigma_delay_ns: Annotated[
        float | None,
        "part of it: how well the trigger unit keeps its delays",
    ] = None
    time_sigma_head_ns: Annotated[
        float | None,
        "part of it: from the head's trigger to its mid-exposure",
    ] = None
