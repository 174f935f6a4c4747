"""Published detection limits: from which size on a wrong input does not pass as good.

The table of docs/explanation/validity.md is made from these: `python -m benchmarks.silent_errors
--limits`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

X, L, DMC, MIDAS = "ultracam-x-mini", "ultracam-l-mini", "dmc-mini", "midas-mini"
STITCHED = (X, L, DMC)
EVERY = (*STITCHED, MIDAS)


@dataclass(frozen=True)
class Limit:
    """From which size on a kind of wrong input is found, by rig.

    A rig that is not in `by_rig` cannot see it in one exposure, or has no such part. `unit` is
    empty where there is no size: it is always found.
    """

    description: str
    unit: str
    by_rig: Mapping[str, float]


def _same_limit(rigs: tuple[str, ...], limit: float) -> Mapping[str, float]:
    return dict.fromkeys(rigs, limit)


LIMITS: Final[Mapping[str, Limit]] = {
    "principal-distance": Limit(
        "principal distance of a cone", "ppm", {X: 300.0, L: 300.0, DMC: 200.0}
    ),
    "cone-turned": Limit("a cone turned about one axis", "urad", {X: 150.0, L: 150.0, DMC: 200.0}),
    "sensor-displaced": Limit("a sensor of a cone of several displaced", "px", {X: 0.3}),
    "sensor-rotated": Limit("a sensor of a cone of several rotated", "urad", {X: 500.0}),
    "slip": Limit(
        "lines of any frame, at its ends too, shifted by 1 to 4 px", "lines",
        _same_limit(STITCHED, 80.0),
    ),
    "blur": Limit("a PAN head blurred", "px (sigma)", _same_limit(STITCHED, 1.0)),
    "blur-region": Limit(
        "a quarter of a PAN frame blurred", "px (sigma)", _same_limit(STITCHED, 1.5)
    ),
    "blur-band": Limit("a colour head blurred", "px (sigma)", {X: 2.5, L: 1.5, DMC: 2.5}),
    "smear": Limit("a PAN head smeared along or across", "px", _same_limit(STITCHED, 4.0)),
    "gain-step": Limit("signal of a PAN frame from one line on", "%", _same_limit(EVERY, 8.0)),
    "gain-step-colour": Limit(
        "signal of a colour frame from one line on", "%", {X: 16.5, L: 8.0, DMC: 16.5}
    ),
    "banding": Limit("lines of a PAN frame brighter, 8 to 40 in turn", "%",
                     _same_limit(EVERY, 5.5)),
    "banding-colour": Limit(
        "lines of a colour frame brighter, 8 to 40 in turn", "%", {X: 8.0, L: 5.5, DMC: 5.5}
    ),
    "block-offset": Limit("a block of a PAN frame brighter", "DN", {X: 160.0, L: 80.0, DMC: 80.0}),
    "block-offset-colour": Limit(
        "a block of a colour frame brighter", "DN", _same_limit(STITCHED, 160.0)
    ),
    "clipping": Limit(
        "pixels of a PAN head clipped below full scale", "%", _same_limit(STITCHED, 2.0)
    ),
    "exposure-pan": Limit("exposure time of a PAN head", "%", _same_limit((X, DMC), 8.0)),
    "exposure-stated": Limit("exposure time stated of a PAN head", "%", _same_limit((X,), 8.0)),
    "exposure-colour": Limit("exposure time of a colour head, wrong in the record", "%", {}),
    "exposure-unknown": Limit(
        "exposure time of a colour head halved and not in the record",
        "",
        _same_limit(STITCHED, 1.0),
    ),
    "probes-all": Limit("all probes alike", "K", {X: 2.0}),
    "probe-one": Limit("one probe of a PAN cone", "K", {X: 2.0, L: 8.0, DMC: 8.0}),
    "stale": Limit("age of all temperatures, at 0.02 K/s", "s", _same_limit(STITCHED, 30.0)),
    "tdi": Limit("TDI count of a cone", "shifts", _same_limit((X, DMC), 1.0)),
    "half-frame": Limit("lines of a frame not read out", "%", _same_limit(EVERY, 2.0)),
    "wrong-unit": Limit(
        "rig file of another unit: f 500 ppm, angles 300 urad, places 2 px", "times",
        _same_limit(STITCHED, 1.0),
    ),
    "bands-swapped": Limit("frames of two colour heads swapped", "", _same_limit((X, DMC), 1.0)),
    "frames-swapped": Limit("frames of two PAN heads swapped", "", _same_limit(STITCHED, 1.0)),
    "heads-swapped": Limit(
        "frames of two heads of one size swapped, or serials", "", _same_limit((X, DMC, MIDAS), 1.0)
    ),
    "frame-other": Limit("a frame of another exposure", "", _same_limit(STITCHED, 1.0)),
    "frame-turned": Limit("a frame turned by 180 degrees", "", _same_limit(STITCHED, 1.0)),
    "frame-mirrored": Limit("a frame mirrored", "", _same_limit(STITCHED, 1.0)),
    "frame-part": Limit(
        "a sixteenth of a frame other than near infrared of another exposure", "",
        _same_limit(STITCHED, 1.0),
    ),
    "words": Limit("words left-justified or byte-swapped", "", _same_limit(EVERY, 1.0)),
    "frame-lost": Limit("a frame lost", "", _same_limit(EVERY, 1.0)),
    "exposure-half": Limit(
        "a PAN head exposed half as long, not stated", "", _same_limit(STITCHED, 1.0)
    ),
    "row-inserted": Limit(
        "one row twice, the rest of the frame one row further on; 40 rows from its ends", "",
        _same_limit(STITCHED, 1.0),
    ),
    "stuck-column": Limit("a column stuck at one value", "", _same_limit(EVERY, 1.0)),
    "gain-step-oblique": Limit(
        "signal of a PAN frame beyond a line at an angle", "%", {}
    ),
    "gain-step-oblique-colour": Limit(
        "signal of a colour frame beyond a line at an angle", "%", {}
    ),
    "vignetting": Limit(
        "corners of a PAN frame darker: another lens", "%", _same_limit(STITCHED, 20.0)
    ),
    "smear-varying": Limit(
        "a PAN head smeared, growing from row to row up to", "px", _same_limit(STITCHED, 6.0)
    ),
    "rows-stale": Limit(
        "last rows of a PAN frame of another exposure", "%", _same_limit(STITCHED, 20.0)
    ),
    "frame-copied": Limit(
        "the frame of another head of the same size", "", _same_limit(EVERY, 1.0)
    ),
    "frame-flipped": Limit(
        "a frame flipped, last row first", "", _same_limit(STITCHED, 1.0)
    ),
    "dark-head": Limit("a head without light", "", _same_limit(EVERY, 1.0)),
    "block-repeated": Limit(
        "a block of rows of a frame sent twice", "rows", _same_limit(EVERY, 4.0)
    ),
    "tdi-lost": Limit("a record without TDI counts", "", _same_limit(STITCHED, 1.0)),
    "group-other": Limit(
        "all PAN or all colour frames of another exposure", "", _same_limit(STITCHED, 1.0)
    ),
    "offset-pan": Limit(
        "an offset of a whole PAN frame (of 12 bits)", "DN", _same_limit(STITCHED, 50.0)
    ),
    "tone-pan": Limit(
        "another exponent of the tone curve of a PAN head", "%", _same_limit(STITCHED, 15.0)
    ),
    "slope-pan": Limit(
        "signal of a PAN frame that changes slowly along rows or columns", "%",
        {X: 15.0, L: 25.0, DMC: 15.0},
    ),
}  # fmt: skip


def table() -> str:
    """The limits in Markdown."""
    lines = [
        "| kind | wrong input | unit | " + " | ".join(f"`{rig}`" for rig in EVERY) + " |",
        "|---|---|---|" + "---|" * len(EVERY),
    ]
    for name, limit in LIMITS.items():
        cells = [
            "–" if rig not in limit.by_rig else f"{limit.by_rig[rig]:g}" if limit.unit else "always"
            for rig in EVERY
        ]
        lines.append(
            f"| `{name}` | {limit.description} | {limit.unit} | " + " | ".join(cells) + " |"
        )
    return "\n".join(lines)
