"""Mutations of `processing` that alter no outcome, for `benchmarks.mutation_sample`.

Each is named as that module prints it, without its line; the value is why no outcome differs.
"""

from __future__ import annotations

_ANY_SIZE = "numpy takes any negative size as the one to be computed"
_SAME_LENGTHS = "both sequences are made of the same one just above"
_NEVER_EXACTLY = "a measured real number is never at its limit exactly"
_ZERO_EITHER_WAY = "where it is zero, zero is taken either way"
_OVERWRITTEN = "every reader comes after the first look has written it"
EQUIVALENT: dict[str, str] = {
    "processing/geometry/terrain_rays.py: "
    "over = point[:, 2] - model.at(point[:, :2]): 2 -> 3": "heights are read at columns 0 and 1",
    "processing/geometry/terrain_rays.py: "
    "middle = np.where(good, (near + far) / 2.0, 0.0): 0.0 -> 1.0": "only good rays are taken over",
    "processing/geometry/terrain_rays.py: "
    "under = above(middle) <= 0.0: <= -> <": "the bisection converges to the same point",
    "processing/geometry/terrain_rays.py: "
    "_HALVINGS: Final = 30: 30 -> 60": "30 halvings of any step are below a micrometre",
    "processing/geometry/terrain_rays.py: "
    "first = np.where(down, np.maximum((top - centre_m[2]) / unit[:, 2], 0.0), np.nan): / -> *": (
        "the search starts earlier, still above all ground"
    ),
    "processing/mosaic/precision.py: "
    "variance = np.sum((datum @ of_datum) * datum, axis=1).reshape(-1, 2): 1 -> 2": _ANY_SIZE,
    "processing/mosaic/precision.py: result[probe] = moved.reshape(-1): 1 -> 2": _ANY_SIZE,
    "processing/mosaic/precision.py: "
    "for i, (s, cone) in enumerate(zip(sensors, cones, strict=True)):: True -> False": (
        _SAME_LENGTHS
    ),
    "processing/mosaic/uncertainty_contribution.py: "
    "left = (_moved_px(mosaic, others) - _places(others) @ part).reshape(-1, 2): 1 -> 2": _ANY_SIZE,
    "processing/mosaic/uncertainty_contribution.py: "
    "for part, weight in zip(parts, weights, strict=True):: True -> False": _SAME_LENGTHS,
    "processing/mosaic/uncertainty_contribution.py: "
    "weights.append(float(np.prod(1.0 / (np.sum(left**2, axis=1) + MIN_DISPLACEMENT_PX**2)))): 1.0 -> 1.5": (
        "only ratios of weights count, and all are products of equally many factors"
    ),
    "processing/mosaic/weights.py: misclosure=(b - a).T.reshape(-1),: 1 -> 2": _ANY_SIZE,
    "processing/mosaic/weights.py: misclosure=-group.difference.T.reshape(-1),: 1 -> 2": _ANY_SIZE,
    "processing/mosaic/weights.py: "
    "typical[kind] = float(np.median(sigmas)) if len(sigmas) else 1.0: 1.0 -> 1.5": (
        "a class without points divides nothing by it"
    ),
    "processing/mosaic/weights.py: "
    "every = [n.ravel() for n, g in zip(normalised, groups, strict=True) if g.kind == kind]: "
    "True -> False": _SAME_LENGTHS,
    "processing/mosaic/weights.py: "
    "for w, group in zip(normalised, groups, strict=True):: True -> False": _SAME_LENGTHS,
    "processing/geometry/topology.py: _RIGS: Final = 8: 8 -> 9": "size of a cache",
    "processing/geometry/topology.py: rounded = round(exact or 0.0): 0.0 -> 1.0": (
        "without an exact ratio the result is None whatever is rounded"
    ),
    "processing/mosaic/readout_slips.py: "
    "for (band, sign), (every, _) in zip(banded, own, strict=True):: True -> False": (
        "both sequences have the two sides of a pair"
    ),
    "processing/mosaic/layers.py: if statistic > limit:: > -> >=": _NEVER_EXACTLY,
    "processing/mosaic/flight_series.py: np.concatenate([(k * sigma) ** 2 "
    "for k, sigma in zip(known, sigmas, strict=True)]): True -> False": _SAME_LENGTHS,
    "processing/mosaic/flight_series.py: "
    "drifts = [s.drift for s, mine in zip(sensors, own, strict=True) if mine]: True -> False": (
        _SAME_LENGTHS
    ),
    "processing/bundle/unknowns.py: "
    "head_offset=np.array([h.offset_m for h in heads]).reshape(-1, 3),: 1 -> 2": _ANY_SIZE,
    "processing/bundle/gauss_newton.py: "
    "rows = plain.rows(run.state, derivatives=False): False -> True": (
        "derivatives are not read here"
    ),
    "processing/bundle/gauss_newton.py: "
    "size = np.sqrt(size / 2.0) / max(float(unit), 1e-12): 1e-12 -> 1.5e-12": (
        "residuals of a trillionth of their sigmas are rounding errors"
    ),
    "processing/quality/signal_steps.py: "
    "common = np.where(low > 0.0, low, np.where(high < 0.0, high, 0.0)): > -> >=": _ZERO_EITHER_WAY,
    "processing/quality/signal_steps.py: "
    "common = np.where(low > 0.0, low, np.where(high < 0.0, high, 0.0)): < -> <=": _ZERO_EITHER_WAY,
    "processing/quality/signal_steps.py: "
    "shared = np.abs(middle) * (np.abs(common) > 0.5 * np.abs(middle)): > -> >=": _NEVER_EXACTLY,
    "processing/quality/signal_steps.py: "
    "steps = shared > np.maximum(MIN_STEP, noise): > -> >=": _NEVER_EXACTLY,
    "processing/quality/relative_sharpness.py: "
    "for of_a, of_b in zip(*shares, strict=True):: True -> False": (
        "both sequences have two directions"
    ),
    "processing/quality/relative_sharpness.py: "
    "if max(detail_a, detail_b) > MIN_DETAIL:: > -> >=": _NEVER_EXACTLY,
} | {
    f"processing/mosaic/weights.py: {name} = field(default_factory=lambda: "
    f"np.empty({shape})): {change}": _OVERWRITTEN
    for name, shape, change in (
        ("difference: Array", "(0, 2)", "0 -> 1"),
        ("difference: Array", "(0, 2)", "2 -> 3"),
        ("redundancy: Array", "(0, 2)", "0 -> 1"),
        ("redundancy: Array", "(0, 2)", "2 -> 3"),
        ("factor: Array", "0", "0 -> 1"),
    )
}
