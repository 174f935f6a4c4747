"""Settings of the pipeline and its result for one exposure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from processing.geometry.conditions import UsableTemperatures
from processing.geometry.virtual_camera import GroundPlane
from processing.image.balance import Balance
from processing.image.colour import BandRegistration, ColourSettings
from processing.image.kernels import DEFAULT_INTERPOLATION, Interpolation
from processing.matching.tie_points import TiePoints, TiePointSettings
from processing.mosaic.estimated_dc import EstimatedDc
from processing.mosaic.free_mosaic import Mosaic, MosaicSettings
from processing.mosaic.mounting import PlatformCheck
from processing.mosaic.precision import UncertaintyContribution
from processing.mosaic.stitching import Method
from processing.mosaic.validity import Validity
from processing.pipelines.exposure_pipeline import StageSettings
from processing.quality.report import QualityReport
from processing.quality.valid_area import ValidArea

Array = NDArray[Any]


@dataclass(frozen=True, kw_only=True)
class PipelineSettings(StageSettings):
    """How exposures are processed.

    `method` "fixed" is the earlier method, "pan-only" the experiment without the colour master:
    both are there to be compared with, not to be flown.

    `baselines` solves the fixed method with and without TDM from the same tie points as well, for
    comparison: their geometry only, nothing is resampled. `relief_fraction` is the terrain's height
    difference over the height above ground, for the weight of P/C points. `geometry` asks for the
    table of raw pixels behind the image.
    """

    method: Method = "free"
    use_drift: bool = True
    interpolation: Interpolation = DEFAULT_INTERPOLATION
    feather_px: int = 16
    baselines: bool = False
    geometry: bool = True
    relief_fraction: float = 0.01
    tie_points: TiePointSettings = field(default_factory=TiePointSettings)
    mosaic: MosaicSettings = field(default_factory=MosaicSettings)
    colour: ColourSettings = field(default_factory=ColourSettings)


@dataclass(frozen=True)
class Product:
    """Level-2 of one exposure and all that is known about it.

    The pixel arrays belong to the pipeline and hold until its next `process`.

    `pan` (H, W) uint16 is linear signal, `counts_per_dn` counts to the DN (8 for 12 bits), 0 no
    data. `valid` (H, W) uint8 is 0 without data, else 1 + the index into `sensors` of the sensor
    that contributes most; its highest bit marks saturation. `colour` holds the bands by name,
    (h, w) uint16 on the raster of `processing.image.lattice.colour_raster`. `quicklook` is (h, w,
    3) uint8. `valid_area` summarizes `valid`, and every band, in a few numbers.

    `geometry` is keyed by method ("free", "fixed", "fixed-no-tdm"), then `<sensor>.vip` (n, 2),
    `<sensor>.raw` (n, 2), `<sensor>.weight` (n,): which raw pixel serves which VIP pixel.
    `timings_s` are seconds by stage, in order.

    `mosaic` is what the image was made with; `free` the same by tie points alone, which differs
    where calibration had to support them; `equal_datum` that whose datum rests on all master
    sensors alike, which is `free` unless one was found displaced. `estimated_dc` is dC by
    stitching, cone by cone (none with the fixed method), `temperatures` what the placing used.
    `disturbance` is what the findings of the exposure add to its stated covariance.
    Of converging heads `platform` holds how they are mounted and whether as calibrated, `ground`
    the plane they were projected onto.
    """

    sensors: tuple[str, ...]
    pan: Array
    valid: Array
    colour: Mapping[str, Array]
    valid_area: ValidArea
    counts_per_dn: float
    quicklook: Array
    start: Mapping[str, Any]
    tie_points: TiePoints
    mosaic: Mosaic
    equal_datum: Mosaic
    free: Mosaic
    validity: Validity | None
    uncertainty_contribution: UncertaintyContribution
    estimated_dc: tuple[EstimatedDc, ...]
    platform: PlatformCheck | None
    ground: GroundPlane | None
    temperatures: UsableTemperatures
    balance: Balance
    bands: tuple[BandRegistration, ...]
    baselines: Mapping[str, Mosaic]
    geometry: Mapping[str, Mapping[str, Array]]
    report: QualityReport
    timings_s: Mapping[str, float]
