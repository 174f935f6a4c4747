"""Cases of the search: drawn by seed, run through the pipeline, and evaluated."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np

from benchmarks.silent_errors.exposure_faults import EXPOSURE_FAULTS
from benchmarks.silent_errors.exposures import healthy, remeasured
from benchmarks.silent_errors.faults import FAULTS
from benchmarks.silent_errors.frame_faults import FRAME_FAULTS
from benchmarks.silent_errors.limits import LIMITS
from benchmarks.silent_errors.truth import CleanImage, Found, compare, image_of
from processing.quality.figures import QualityFigures
from processing.quality.figures.circumstances import EstimatedDcFigures
from processing.quality.figures.image import (
    BalanceFigures,
    BlockFigures,
    ClippingFigures,
    ContentFigures,
    DarkFrameFigures,
    DefectLineFigures,
    IdentityFigures,
    LineOrderFigures,
    LocalBlurFigures,
    OtherGroundFigures,
    RelativeSharpnessFigures,
    RepeatedLineFigures,
    ResponseFigures,
    SignalStepFigures,
    UnreadFigures,
    WordFormatFigures,
)
from processing.quality.figures.stitching import (
    DisplacedSensorFigures,
    DisplacementFigures,
    HeadScaleFigures,
    LayerFigures,
    MisreadProbeFigures,
    PlatformFigures,
    SlipFigures,
)
from processing.quality.report import Flag, QualityReport, Thresholds, Verdict

LATER: Final = ("frame-part", *FRAME_FAULTS, *EXPOSURE_FAULTS)
"""Kinds that were added last: the first cases of a seed stay what they were."""
NARROW: Final = ("stuck-column",)
"""Kinds that change less than a region that is compared: without a finding they are silent."""
EXPOSURES: Final = 2
"""Healthy exposures of a rig, over other ground and at other temperatures."""
SMALLEST, LARGEST = 0.5, 4.0
COVERED: Final = 2.15
"""True RMS error over stated sigma: the 99.9 % point of the datum's four parameters."""
RADIANCE: Final = 0.08
"""What the radiance of a region of a good image may be off by (docs/explanation/validity.md)."""
BAND_PX: Final = 0.5
DETAIL: Final = 0.5
"""Of the fine detail of the same image without a fault."""
BLANK: Final = 0.02
"""Share of a head's part of the image without data, beyond that of the image without a fault."""
WIDEST: Final = 3.0
"""Stated sigma over true error, above which a widened sigma states nothing."""


@dataclass(frozen=True)
class Case:
    """One wrong input: kind, rig, exposure, size as a share of the published limit."""

    number: int
    kind: str
    rig: str
    exposure: int
    share: float
    seed: int

    @property
    def size(self) -> float:
        return self.share * LIMITS[self.kind].by_rig[self.rig]

    @property
    def above(self) -> bool:
        """Whether it is to be found: sizes of counted things are at least one."""
        return self.share >= 1.0 or not LIMITS[self.kind].unit


def draw(
    count: int, seed: int, *, rigs: Sequence[str] = (), kinds: Sequence[str] = ()
) -> list[Case]:
    """Cases by seed: every kind with every rig that has it in turn, all else by chance."""
    random = np.random.default_rng([seed, 23])
    pairs = [
        (kind, rig) for kind, limit in LIMITS.items() if kind not in LATER for rig in limit.by_rig
    ]
    order = [pairs[i] for i in random.permutation(len(pairs))]
    order += [(kind, rig) for kind in LATER for rig in LIMITS[kind].by_rig]
    every = itertools.islice(itertools.cycle(order), count)
    cases = [
        Case(
            number=number,
            kind=kind,
            rig=rig,
            exposure=int(random.integers(0, EXPOSURES)),
            share=float(SMALLEST * (LARGEST / SMALLEST) ** random.uniform()),
            seed=seed * 100_000 + number,
        )
        for number, (kind, rig) in enumerate(every)
    ]
    return [c for c in cases if (not rigs or c.rig in rigs) and (not kinds or c.kind in kinds)]


@dataclass(frozen=True)
class Outcome:
    """What became of a case, ready for JSON.

    `result` is `found`, `right` (no finding, and the image is right), `covered` (below the
    limit, places are within what is stated), `silent` (wrong beyond what is stated, and good) or
    `misled` (found, but only correct frames are named).
    """

    number: int
    kind: str
    rig: str
    share: float
    size: float
    description: str
    above: bool
    verdict: str
    flags: str
    named: dict[str, str]
    result: str
    error_px: float | None
    stated_px: float | None
    over_sigma: float | None
    worst: float | None
    worst_of: str
    worst_limit: float | None
    squares: float | None
    rank: int
    freedom: float | None
    band_px: float
    radiance: float
    radiance_of: str
    detail: float
    blank: float
    blank_of: str


def run(case: Case) -> Outcome:
    """Plant, process and evaluate one case."""
    emulated = remeasured(case.rig, case.exposure, case.seed)
    fault = FAULTS[case.kind](emulated, case.size, np.random.default_rng([case.seed, 29]))
    product = fault.emulated.process()
    report = product.report
    found = compare(fault.emulated, product, clean_image(case.rig, case.exposure))
    over = None
    if found.error_px is not None and found.stated_px:
        over = found.error_px / found.stated_px
    named = named_causes(report)
    result = _result(case, report, found, over, named, fault.true_causes)
    whitened = found.normalised
    return Outcome(
        number=case.number,
        kind=case.kind,
        rig=case.rig,
        share=case.share,
        size=case.size,
        description=fault.description,
        above=case.above,
        verdict=report.verdict.value,
        flags=", ".join(str(flag.name) for flag in report.flags),
        named={what: ", ".join(sorted(names)) for what, names in named.items()},
        result=result,
        over_sigma=over,
        squares=None if whitened is None else float(np.sum(whitened.whitened**2)),
        rank=0 if whitened is None else len(whitened.whitened),
        **{
            f.name: getattr(found, f.name)
            for f in dataclasses.fields(found)
            if f.name != "normalised"
        },
    )


def _result(
    case: Case,
    report: QualityReport,
    found: Found,
    over: float | None,
    named: Mapping[str, frozenset[str]],
    true_causes: frozenset[str],
) -> str:
    if any(not (names & true_causes) for names in named.values()):
        return "misled"
    if report.verdict is not Verdict.GOOD:
        return "found"
    placed = over is None or over <= COVERED
    if found.worst is not None and found.worst_limit is not None:
        placed = placed and found.worst <= found.worst_limit
    shown = found.radiance <= RADIANCE and found.band_px <= BAND_PX
    shown = shown and found.detail >= DETAIL and found.blank <= BLANK
    shown = shown and case.kind not in NARROW
    if not placed or (case.above and not shown):
        return "silent"
    return "right" if case.above else "covered"


def named_causes(report: QualityReport) -> dict[str, frozenset[str]]:
    """Who is named as a cause, by what he is accused of; alternatives among them."""
    figures = report.figures
    displaced = figures.of(DisplacedSensorFigures).displaced_sensor
    slip, platform = figures.of(SlipFigures), figures.of(PlatformFigures)
    other_ground = figures.of(ContentFigures).mismatched_sensors
    displacement, misread = figures.of(DisplacementFigures), figures.of(MisreadProbeFigures)
    part = figures.of(OtherGroundFigures)
    found = {
        "part": _names(_one(part.other_ground_sensor), part.other_ground_alternatives),
        "displaced": _names(_one(displaced), displacement.displaced_alternatives),
        "slip": _names(slip.slip_sensors, slip.slip_alternatives),
        "ground": _names(other_ground, figures.of(ContentFigures).mismatched_alternatives),
        "dark": _names(figures.of(DarkFrameFigures).dark_sensors),
        "words": _names(figures.of(WordFormatFigures).word_format_sensors),
        "bits": _names(figures.of(WordFormatFigures).constant_bits_sensors),
        "order": _names(_one(figures.of(LineOrderFigures).line_order_sensor)),
        "temperature": _names(figures.of(EstimatedDcFigures).dc_disagreement),
        "misread": _names(_one(misread.misread_probe)),
    }
    identity = figures.of(IdentityFigures)
    found["exchanged"] = _names(identity.exchanged_frames, identity.exchanged_from)
    # Of frames of other ground, signal and sharpness are not evaluated.
    if not other_ground:
        found |= _signal_causes(figures)
    if Flag.CALIBRATION_EXPIRED in report.flags:
        causes, other = figures.of(LayerFigures).platform_causes, platform.platform_alternatives
        scaled = _one(figures.of(HeadScaleFigures).platform_scale_head)
        found["platform"] = _names(causes, other) or _names(
            _one(platform.platform_shift_head), other, scaled
        )
    return {what: names for what, names in found.items() if names}


def _signal_causes(figures: QualityFigures) -> dict[str, frozenset[str]]:
    """Who is named for signal or sharpness."""
    limits = Thresholds()
    block, local = figures.of(BlockFigures), figures.of(LocalBlurFigures)
    clipping, unread = figures.of(ClippingFigures), figures.of(UnreadFigures)
    relative, balance = figures.of(RelativeSharpnessFigures), figures.of(BalanceFigures)
    response = figures.of(ResponseFigures)
    found = {
        "gain": _names(_one(balance.gain_outlier), balance.gain_outlier_alternatives),
        "blur": _names(_one(relative.blurred_sensor)),
        "noise": _names(_one(relative.noisy_sensor)),
        "line": _names(_one(figures.of(DefectLineFigures).defect_line_sensor)),
        "step": _names(_one(figures.of(SignalStepFigures).signal_step_sensor)),
        "response": _names(_one(response.response_sensor), response.response_alternatives),
        "repeated": _names(_one(figures.of(RepeatedLineFigures).repeated_lines_sensor)),
    }
    if abs(block.block_step or 0.0) > limits.block_step:
        found["block"] = _names(_one(block.block_sensor))
    if (clipping.clipped_fraction or 0.0) > limits.clipped_fraction:
        found["clipped"] = _names(clipping.clipped_sensors)
    if (unread.unread_worst_fraction or 0.0) > limits.unread_fraction:
        found["unread"] = _names(_one(unread.unread_worst_sensor))
    if (local.pan_blur_deficit or 0.0) > limits.pan_blur_deficit:
        found["pan blur"] = _names(_one(local.pan_blur_sensor))
    if (local.colour_blur_deficit or 0.0) > limits.colour_blur_deficit:
        found["colour blur"] = _names(_one(local.colour_blur_sensor))
    return found


def _one(name: str | None) -> tuple[str, ...]:
    return () if name is None else (name,)


def _names(first: Sequence[str], *others: Sequence[str]) -> frozenset[str]:
    """All names, if there is a first one."""
    return frozenset(first).union(*others) if first else frozenset()


@cache
def clean_image(rig: str, number: int) -> CleanImage:
    """What the image of a healthy exposure shows."""
    emulated = healthy(rig, number)
    return image_of(emulated, emulated.process())


def by_exposure(cases: Sequence[Case]) -> Iterator[Case]:
    """The cases, those of one exposure together: it is rendered once."""
    yield from sorted(cases, key=lambda c: (c.rig, c.exposure, c.number))
