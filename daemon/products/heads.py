"""Level-2 of a rig whose heads look apart: an image of every head in strict perspective.

What they are is made by `processing.perspective`; here they get their files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.configuration import PlanSection
from daemon.disk.level0 import tiff_parts
from daemon.disk.level2 import jpeg_bytes, write_folder
from daemon.disk.mission import Mission
from daemon.disk.records import canonical_bytes
from daemon.exposure import Exposure
from daemon.products.conditions import conditions_of
from processing.perspective import HeadPipeline, HeadsProduct
from processing.quality.report import Flag, as_json

_TILE_PX = 480
_RGB = ("red", "green", "blue")


def process_heads(
    pipeline: HeadPipeline,
    mission: Mission,
    plan: PlanSection,
    exposure: Exposure,
    frames: Mapping[str, NDArray[np.uint16]],
) -> tuple[dict[str, Any], HeadsProduct]:
    """Run one exposure and write its Level-2 folder: `<cone>.tif`, quick look, report.

    Returns:
        The content of quality.json, and the product.
    """
    product = pipeline.process(frames, conditions_of(exposure, pipeline.rig, plan, Flag(0)))
    report = as_json(product.report)
    report["exposure"] = exposure.number
    report["timings_s"] = {stage: round(s, 4) for stage, s in product.timings_s.items()}
    contents: dict[str, Sequence[bytes | memoryview]] = {}
    for name, head in product.heads.items():
        about = {
            "bands": list(head.bands),
            "exposure": exposure.number,
            "cone": name,
            "f_mm": head.image.f_mm,
            "pitch_um": head.image.pitch_um,
            "geometry": "strict perspective, principal point at the centre",
        }
        contents[f"{name}.tif"] = tiff_parts(list(head.bands.values()), about)
    if product.heads:
        contents["quicklook.jpg"] = [jpeg_bytes(_side_by_side(product))]
    contents["quality.json"] = [canonical_bytes(report)]
    write_folder(mission.level2(exposure.number), contents)
    return report, product


def _side_by_side(product: HeadsProduct) -> NDArray[np.uint8]:
    """All heads in a row, each in its own stretch, in the order of the rig."""
    tiles = []
    for head in product.heads.values():
        planes = [head.bands[b] for b in _RGB] if set(_RGB) <= set(head.bands) else []
        planes = planes or [next(iter(head.bands.values()))] * 3
        step = max(1, planes[0].shape[1] // _TILE_PX)
        small = np.stack([p[::step, ::step] for p in planes], axis=-1).astype(np.float32)
        seen = small[small > 0.0]
        low, high = np.percentile(seen, (1.0, 99.0)) if seen.size else (0.0, 1.0)
        unit = np.clip((small - low) / max(float(high - low), 1.0), 0.0, 1.0)
        tiles.append((255.0 * unit**0.7).astype(np.uint8))
    height = max(tile.shape[0] for tile in tiles)
    padded = [np.pad(t, ((0, height - t.shape[0]), (0, 4), (0, 0))) for t in tiles]
    return np.ascontiguousarray(np.concatenate(padded, axis=1))
