"""`python -m benchmarks.matching_phases`: matching over all sub-pixel phases, in x and in y.

Band-limited textures are moved exactly, in the frequency domain, exposed with photon noise, read
noise and converter, and matched as Level-1 words. Reported are the mean error of every phase,
blunders left out, and the predicted sigma against the true one.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from daemon.cli.benchmark.measurement import machine
from daemon.postflight.plots import COLOURS, legend, level_line, svg_of, titles
from processing.matching.patches import INTERPOLATION, match_patches
from processing.matching.tie_points import TiePointSettings

Array = NDArray[np.float64]
Pixels = NDArray[np.uint16]

FULL_SCALE_DN = 4095
BLACK_DN = 64.0
ELECTRONS_PER_DN = 20.0
READ_NOISE_E = 30.0
"""As the UltraCam rig files have them."""
LEVEL1_COUNTS_PER_DN = 8
RATIO = 3
COLOUR_LEVEL = 0.7
"""Green's signal against PAN's."""
BLUNDER_SIGMAS = 5.0


@dataclass(frozen=True)
class Case:
    """`level` of full scale, `contrast` the texture's standard deviation over its level, `cutoff`
    cycles per PAN pixel, `blur` standard deviation of what the second image is softer by, in its
    own pixels. `ratio` is 1 for P/P; for P/C everything is in green pixels."""

    ratio: int
    level: float
    contrast: float
    cutoff: float
    blur: float


_LIGHT = ((0.05, 0.15), (0.2, 0.15), (0.5, 0.15), (0.5, 0.03))
_SHARPNESS = {1: ((0.3, 0.0), (0.3, 0.4)), RATIO: ((0.3, 0.0), (0.3, 0.3), (0.3, 0.6), (0.12, 0.3))}
CASES = tuple(
    Case(ratio, level, contrast, cutoff, blur)
    for ratio, sharpness in _SHARPNESS.items()
    for level, contrast in _LIGHT
    for cutoff, blur in sharpness
)


@dataclass(frozen=True)
class Found:
    """Errors of one case: `phases` (p, 2), `means` (p, 2) and `counts` (p,) of each phase; the true
    and the predicted sigma of all, and the share of errors inside three predicted ones."""

    case: Case
    phases: Array
    means: Array
    counts: Array
    true_sigma: float
    predicted_sigma: float
    inside_3: float
    accepted: float

    @property
    def largest_mean(self) -> float:
        return float(np.abs(self.means).max())

    @property
    def noise_of_means(self) -> float:
        """What chance alone leaves in the mean of one phase."""
        return self.true_sigma / float(np.sqrt(self.counts.mean()))

    @property
    def bias(self) -> float:
        """Root mean square of the means, less what chance leaves in them."""
        square = float(np.mean(self.means**2)) - self.noise_of_means**2
        return float(np.sqrt(max(square, 0.0)))


class Texture:
    """A periodic texture, standard deviation one, nothing above its cutoff."""

    def __init__(self, size: int, random: np.random.Generator, cutoff: float) -> None:
        self.size = size
        self._fx = np.fft.rfftfreq(size)[None, :]
        self._fy = np.fft.fftfreq(size)[:, None]
        frequency = np.hypot(self._fx, self._fy)
        amplitude = np.exp(-((frequency / cutoff) ** 4)) / np.maximum(frequency, 8.0 / size)
        amplitude[0, 0] = 0.0
        amplitude[(np.abs(self._fx) == 0.5) | (np.abs(self._fy) == 0.5)] = 0.0
        spectrum = np.fft.rfft2(random.normal(size=(size, size))) * amplitude
        self._spectrum = spectrum / np.fft.irfft2(spectrum, s=(size, size)).std()

    def moved(self, dx: float, dy: float, blur: float = 0.0) -> Array:
        """Its content moved right and down and blurred, exactly."""
        phase_ramp = np.exp(-2j * np.pi * (self._fx * dx + self._fy * dy))
        soft = np.exp(-2.0 * (np.pi * blur) ** 2 * (self._fx**2 + self._fy**2))
        return np.asarray(
            np.fft.irfft2(self._spectrum * phase_ramp * soft, s=(self.size, self.size))
        )


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.matching_phases")
    parser.add_argument("--phases", type=int, default=8, help="along each axis")
    parser.add_argument("--size", type=int, default=1500, help="PAN pixels of a texture's side")
    parser.add_argument("--drawing", type=Path, help="where to draw means over phase (SVG)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    results = [run(case, phases=options.phases, size=options.size) for case in CASES]
    if options.drawing is not None:
        options.drawing.write_text(drawing(results), encoding="utf-8")
    if options.json:
        print(json.dumps({"machine": machine(), "cases": [_as_json(found) for found in results]}))
        return
    print(
        "| pair | level | contrast | cutoff | blur | points a phase | largest mean | by chance "
        "| bias | true sigma | predicted | in 3 sigma |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for f in results:
        c = f.case
        print(
            f"| {'P/P' if c.ratio == 1 else 'P/C'} | {c.level:.0%} | {c.contrast:.0%} "
            f"| {c.cutoff:g} | {c.blur:g} | {f.counts.mean():.0f} | {f.largest_mean:.4f} "
            f"| {f.noise_of_means:.4f} | {f.bias:.4f} | {f.true_sigma:.4f} "
            f"| {f.predicted_sigma / f.true_sigma:.2f} x | {f.inside_3:.2%} |"
        )


def run(case: Case, *, phases: int, size: int, seed: int = 1) -> Found:
    """Match one texture with itself at phases x phases shifts."""
    random = np.random.default_rng(seed)
    settings = TiePointSettings()
    texture = Texture(size, random, case.cutoff)
    window = settings.window_pp_px if case.ratio == 1 else settings.window_pc_px
    largest = settings.max_sigma_pp_px if case.ratio == 1 else settings.max_sigma_pc_px
    first = np.arange(26, size // case.ratio - 26, window + 3)
    at_b = np.array([(c, r) for r in first for c in first], dtype=np.int64)
    # One pixel off on purpose: the centre box need not lie on green's raster.
    at_a = case.ratio * at_b + (np.array([1, -1]) if case.ratio > 1 else 0)
    steps = np.arange(phases) / phases
    grid = np.array([(x, y) for y in steps for x in steps])
    errors, sigmas, means, counts = [], [], [], []
    for phase_x, phase_y in grid:
        dx, dy = case.ratio * phase_x + 1.0, case.ratio * phase_y - 1.0
        other = texture.moved(dx, dy, case.blur * case.ratio)
        if case.ratio > 1:
            other = _box_means(other, case.ratio)
        level_b = case.level * (COLOUR_LEVEL if case.ratio > 1 else 1.0)
        a = expose_texture(texture.moved(0.0, 0.0), case.level, case.contrast, random)
        b = expose_texture(other, level_b, case.contrast, random)
        limits = np.array([0, b.shape[1] - 1, 0, b.shape[0] - 1], dtype=np.int64)
        search = settings.search_pp_px if case.ratio == 1 else settings.search_pc_px
        found = match_patches(
            a, b, at_a, at_b, limits, case.ratio, window // 2, search, True, INTERPOLATION
        )
        good = (
            (found[:, 7] > 0.0)
            & (found[:, 4] <= largest)
            & (found[:, 5] >= settings.min_correlation)
            & (found[:, 6] >= settings.min_peak_margin)
        )
        # Pixel c of the coarser image has its centre at ratio c + (ratio - 1) / 2 of the finer.
        true = (found[good, :2] + (dx, dy) - (case.ratio - 1) / 2.0) / case.ratio
        error, sigma = found[good, 2:4] - true, found[good, 4]
        clean = _without_blunders(error)
        errors.append(error[clean])
        sigmas.append(sigma[clean])
        means.append(error[clean].mean(axis=0))
        counts.append(int(clean.sum()))
    error, sigma = np.concatenate(errors), np.concatenate(sigmas)
    return Found(
        case=case,
        phases=grid,
        means=np.array(means),
        counts=np.array(counts, np.float64),
        true_sigma=float(np.sqrt(np.mean(error**2))),
        predicted_sigma=float(np.sqrt(np.mean(sigma**2))),
        inside_3=float(np.mean(np.abs(error) < 3.0 * sigma[:, None])),
        accepted=float(np.mean(counts)) / len(at_a),
    )


def expose_texture(
    texture: Array, level: float, contrast: float, random: np.random.Generator
) -> Pixels:
    """Level-1 words of a texture as a sensor with the photon-transfer curve of the rigs sees it."""
    electrons = np.maximum(level * FULL_SCALE_DN * (1.0 + contrast * texture), 0.0)
    electrons *= ELECTRONS_PER_DN
    noise = np.sqrt(electrons + READ_NOISE_E**2) * random.standard_normal(texture.shape)
    dn = np.clip(np.rint(BLACK_DN + (electrons + noise) / ELECTRONS_PER_DN), 0, FULL_SCALE_DN)
    pixels = np.maximum((dn - BLACK_DN) * LEVEL1_COUNTS_PER_DN, 2.0).astype(np.uint16) & 0xFFFE
    return np.asarray(pixels | (dn >= FULL_SCALE_DN))


def drawing(results: Sequence[Found]) -> str:
    """Mean errors in x over the phase in x, every phase in y a dot; a colour for each kind."""

    def draw(figure: Figure) -> None:
        plot = figure.subplots()
        for ratio, colour, label in ((1, COLOURS[0], "P/P"), (RATIO, COLOURS[1], "P/C")):
            some = [f for f in results if f.case.ratio == ratio and f.case.contrast > 0.1]
            phases = np.concatenate([found.phases.T.ravel() for found in some])
            means = np.concatenate([found.means.T.ravel() for found in some])
            plot.plot(phases, means, "o", color=colour, markersize=4, fillstyle="none", label=label)
        level_line(plot, 0.01, "0.01 px")
        level_line(plot, -0.01, "")
        plot.set(xlim=(0.0, 1.0), ylim=(-0.012, 0.012))
        title = "Mean error of matching over sub-pixel phase (same in x and y), own pixels"
        titles(plot, title, "phase", "mean error, px")
        legend(figure, plot)

    return svg_of(draw)


def _without_blunders(error: Array) -> NDArray[np.bool_]:
    off = np.abs(error - np.median(error, axis=0))
    return np.asarray((off < BLUNDER_SIGMAS * 1.4826 * np.median(off, axis=0)).all(axis=1))


def _box_means(image: Array, ratio: int) -> Array:
    rows, columns = image.shape[0] // ratio, image.shape[1] // ratio
    boxes = image[: rows * ratio, : columns * ratio].reshape(rows, ratio, columns, ratio)
    return np.asarray(boxes.mean(axis=(1, 3)))


def _as_json(found: Found) -> dict[str, object]:
    return {
        **asdict(found.case),
        "largest_mean": found.largest_mean,
        "bias": found.bias,
        "true_sigma": found.true_sigma,
        "predicted_sigma": found.predicted_sigma,
        "inside_3": found.inside_3,
        "accepted": found.accepted,
    }


if __name__ == "__main__":
    main()
