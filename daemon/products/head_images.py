"""Level-2 of a rig whose heads look apart: an image of every head in strict perspective.

What they are is made by `processing.pipelines.perspective`; here they get their files.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from daemon.mission.canonical_json import canonical_bytes
from daemon.mission.exposure import Exposure
from daemon.mission.store.level0 import tiff_parts
from daemon.mission.store.level2 import pictures, product_marks
from daemon.products.product_files import Contents, FramesRead, ProductFiles, report_json
from processing.geometry.conditions import Conditions
from processing.pipelines.perspective import HeadPipeline, HeadsProduct

_TILE_PX = 480
_RGB = ("red", "green", "blue")


def build_heads(
    pipeline: HeadPipeline,
    exposure: Exposure,
    frames: Mapping[str, NDArray[np.uint16]],
    conditions: Conditions,
    frames_read: FramesRead,
) -> ProductFiles:
    """Every head an image of its own (`daemon.products.processor`)."""
    product = pipeline.process(frames, conditions, frames_read=frames_read)
    report = report_json(product.report, exposure.number, product.timings_s, product.valid_area)
    report["heads"] = list(product.heads)
    contents: Contents = {}
    for name, head in product.heads.items():
        about = {
            "bands": list(head.bands),
            "exposure": exposure.number,
            "cone": name,
            "f_mm": head.image.f_mm,
            "pitch_um": head.image.pitch_um,
            "geometry": "strict perspective, principal point at the centre",
            **product_marks(report),
        }
        contents[f"{name}.tif"] = tiff_parts(list(head.bands.values()), about)
    if product.heads:
        contents |= pictures(_side_by_side(product), report)
    contents["quality.json"] = [canonical_bytes(report)]
    return report, contents


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
