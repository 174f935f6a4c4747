"""The emulated ground's colour: real aerial imagery laid out over a flight line.

Radiances of four bands and their panchromatic mix as a lens of stated sharpness delivers them,
kept on disk and mapped into every process. Near infrared is emulated from red, green and blue: the
shipped photographs have none.

A scene has its own axes: column to the right of the first line, row against the flight, so that a
line flown north is a map with north up. Samples are about one PAN ground sampling distance apart.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_hw import SimulatorError
from sim_hw.world import quilting, spline
from sim_hw.world.ground_types import GROUNDS
from sim_hw.world.seeding import random_stream

Band = NDArray[np.uint16]

SHIPPED = ("IMG_9419.jpg", "IMG_9420.jpg")
COLOURS = ("red", "green", "blue", "nir")
PAN_MIX = {"red": 0.30, "green": 0.35, "blue": 0.20, "nir": 0.15}
"""Share of each band in the panchromatic signal: a silicon CCD behind a 450-850 nm filter."""
UNIT = 48000
"""Radiance 1 in a source picture, which is white: 99.5 % of a band lie below."""
WHITE_PERCENTILE = 99.5
FORMAT = 1
BLOCK_ROWS = 1024
COLOUR_STEP = 2
"""Colour bands are kept at every second sample where colour pixels have three or more."""
WIDE_COLOUR_RATIO = 3
TONE_EXPONENT = 1.8
"""Radiance from stored level: less than the 2.2 of a display, for cameras deepen their shadows."""
SOURCE_REDUCTION = 0.75
"""The shipped photographs are soft at the pixel; three quarters of their size is what they hold."""
LENS_OF_SOURCE_PX = 0.8
"""The blur left in a photograph, taken out before our own lens puts its own in."""


class SceneError(SimulatorError, ValueError):
    """A scene is not available; the message gives the reason and the remedy."""


@dataclass(frozen=True)
class SceneSettings:
    """What makes a scene: equal settings give equal samples.

    `psf_px` is the standard deviation of lens and pixel aperture, in pixels of the head that
    looks; `colour_ratio` is the size of a colour pixel in PAN pixels; `ground` is a name of
    `grounds.GROUNDS`.
    """

    seed: int
    width_px: int
    height_px: int
    sample_m: float
    colour_ratio: float
    psf_px: float = 0.55
    file: str | None = None
    ground: str = "landscape"

    @property
    def colour_step(self) -> int:
        """Samples between those kept of the colour bands; finer detail than this is blurred."""
        return COLOUR_STEP if self.colour_ratio >= WIDE_COLOUR_RATIO else 1

    @property
    def key(self) -> str:
        """Name of the scene in a cache."""
        facts: dict[str, object] = {"format": FORMAT, **asdict(self)}
        if self.file is None:
            if self.ground == "landscape":
                # The shipped picture does not depend on what a sample is called in metres.
                del facts["ground"], facts["sample_m"]
        else:
            del facts["ground"]
            status = Path(self.file).stat()
            facts["file_state"] = [status.st_size, status.st_mtime_ns]
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Scene:
    """Bands by name ("pan", "red", ...), each the coefficients of a spline, (rows, columns).

    `step` is the distance of a band's samples: 1 for PAN, `SceneSettings.colour_step` for colour.
    """

    settings: SceneSettings
    bands: Mapping[str, Band]
    patches: int
    reused_patches: int

    def step(self, band: str) -> int:
        return 1 if band == "pan" else self.settings.colour_step


def open_scene(settings: SceneSettings, cache: Path) -> Scene:
    """Map a scene from the cache folder, building it first where it is not there.

    Raises:
        SceneError: the file given is none we can read.
    """
    folder = cache / f"scene-{settings.key}"
    if not (folder / "scene.json").exists():
        _build(settings, folder)
    facts = json.loads((folder / "scene.json").read_text())
    bands = {name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in ("pan", *COLOURS)}
    return Scene(
        settings=settings,
        bands=bands,
        patches=int(facts["patches"]),
        reused_patches=int(facts["reused_patches"]),
    )


def _build(settings: SceneSettings, folder: Path) -> None:
    folder.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=".scene-", dir=folder.parent))
    try:
        patches, reused = 0, 0
        if settings.file is not None:
            canvas = read_geotiff(Path(settings.file), settings)
        else:
            ground = GROUNDS[settings.ground]
            canvas = np.zeros((settings.height_px, settings.width_px, len(COLOURS)), np.uint16)
            if ground.over_land:
                canvas, patches, reused = _quilted(settings)
            random = random_stream(settings.seed, "ground")
            canvas = ground.paint(canvas, settings.sample_m, random)
        _store_bands(canvas, settings, work)
        (work / "scene.json").write_text(
            json.dumps({**asdict(settings), "patches": patches, "reused_patches": reused})
        )
        if not folder.exists():
            work.chmod(0o755)
            work.rename(folder)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _quilted(settings: SceneSettings) -> tuple[quilting.Picture, int, int]:
    """A landscape of the shipped photographs, its patches, and those used again."""
    sources = [radiance(path) for path in shipped_pictures()]
    size = {"height_px": settings.height_px, "width_px": settings.width_px}
    plan = quilting.plan_land if GROUNDS[settings.ground].arranged else quilting.plan_quilt
    quilt = plan(sources, **size, random=random_stream(settings.seed, "quilt"))
    return quilting.assemble(sources, quilt, **size), sum(map(len, quilt.rows)), quilt.reused


def shipped_pictures() -> list[Path]:
    """The photographs, in the source tree or in the distribution `syntopic-scenes`.

    Raises:
        SceneError: neither is there.
    """
    folder = Path(__file__).parents[1] / "scenes"
    if not folder.is_dir():
        spec = importlib.util.find_spec("syntopic_scenes")
        if spec is None or not spec.submodule_search_locations:
            raise SceneError(
                "the photographs of the emulated ground are not installed. "
                "Run: pip install syntopic-scenes"
            )
        folder = Path(spec.submodule_search_locations[0])
    return [folder / name for name in SHIPPED]


def radiance(path: Path) -> quilting.Picture:
    """Read a photograph as linear radiances red, green, blue and emulated near infrared."""
    encoded = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if encoded is None:
        raise SceneError(f"{path}: not a picture that can be read")
    return bands_of_photograph(cv2.cvtColor(encoded, cv2.COLOR_BGR2RGB))


def bands_of_photograph(rgb: NDArray[np.uint8]) -> quilting.Picture:
    """Undo the display curve, reduce, take out blur, add NIR, scale white to `UNIT`."""
    linear = cv2.LUT(rgb, ((np.arange(256) / 255.0) ** TONE_EXPONENT).astype(np.float32))
    reduction = {"fx": SOURCE_REDUCTION, "fy": SOURCE_REDUCTION}
    linear = cv2.resize(linear, None, **reduction, interpolation=cv2.INTER_AREA)
    linear = 2 * linear - cv2.GaussianBlur(linear, (0, 0), LENS_OF_SOURCE_PX)
    return scaled(np.dstack([linear, emulated_nir(linear)]))


def emulated_nir(rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """A near infrared that looks like one: like red on soil and concrete, bright on vegetation.

    Made from the other three bands, so it holds no information of its own.
    """
    red, green, blue = (np.ascontiguousarray(rgb[..., i]) for i in range(3))
    excess_green = (2 * green - red - blue) / (red + green + blue + 0.02)
    vegetation = np.clip(excess_green * 4.0, 0.0, 1.0)
    soil = 0.9 * red + 0.2 * green
    return np.asarray(soil + vegetation * (2.5 * green + 0.02), dtype=np.float32)


def scaled(linear: NDArray[np.float32]) -> quilting.Picture:
    """Radiances (height, width, bands) with the white of every band at `UNIT`."""
    white = np.percentile(linear[::8, ::8], WHITE_PERCENTILE, axis=(0, 1))
    factor = (UNIT / np.maximum(white, 1e-6)).astype(np.float32)
    return np.asarray(np.clip(linear * factor, 0, 65535), dtype=np.uint16)


def _store_bands(canvas: quilting.Picture, settings: SceneSettings, folder: Path) -> None:
    """Write the bands as the lens delivers them, block by block."""
    height, width = canvas.shape[:2]
    pan = _new_band(folder / "pan.npy", height, width)
    step = settings.colour_step
    small = (-(-height // step), -(-width // step))
    colours = [_new_band(folder / f"{name}.npy", *small) for name in COLOURS]
    sigma_pan = settings.psf_px
    sigma_colour = settings.psf_px * settings.colour_ratio
    halo = step * (spline.REACH + int(np.ceil(2 * sigma_colour)))
    mix = np.array([[PAN_MIX[name] for name in COLOURS]], dtype=np.float32)
    for start in range(0, height, BLOCK_ROWS):
        stop = min(start + BLOCK_ROWS, height)
        low, high = max(0, start - halo), min(height, stop + halo)
        block = canvas[low:high].astype(np.float32) / np.float32(UNIT)
        grey = spline.coefficients(cv2.transform(block, mix), sigma_pan)
        pan[start:stop] = spline.stored(grey[start - low : stop - low])
        soft = _blurred(block, sigma_colour)[::step, ::step]
        skip, place = (start - low) // step, start // step
        rows = -(-(stop - start) // step)
        for i, band in enumerate(colours):
            smooth = spline.coefficients(np.ascontiguousarray(soft[..., i]))
            band[place : place + rows] = spline.stored(smooth[skip : skip + rows])
    for band in (pan, *colours):
        band.flush()


def _new_band(
    path: Path, height: int, width: int
) -> np.memmap[tuple[int, ...], np.dtype[np.uint16]]:
    return np.lib.format.open_memmap(path, mode="w+", dtype=np.uint16, shape=(height, width))


def _blurred(picture: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    if sigma <= 0:
        return picture
    size = 2 * int(np.ceil(4 * sigma)) + 1
    return np.asarray(cv2.GaussianBlur(picture, (size, size), sigma), dtype=np.float32)


def read_geotiff(path: Path, settings: SceneSettings) -> quilting.Picture:
    """Read a scene from a raster with square pixels in metres, resampled to the scene's samples.

    One band is taken for all, three are red, green, blue, a fourth is near infrared.

    Raises:
        SceneError: rasterio is missing, or the file does not fit.
    """
    try:
        import rasterio
    except ImportError as error:
        raise SceneError(
            f"{path}: GeoTIFF files need rasterio, which cannot be loaded ({error}). Run: pip "
            "install 'syntopic[geotiff]'"
        ) from error
    try:
        with rasterio.open(path) as raster:
            if raster.crs is None or not raster.crs.is_projected:
                raise SceneError(f"{path}: has no projected coordinate system; give one in metres")
            pixel_m = abs(raster.transform.a) * raster.crs.linear_units_factor[1]
            scale = pixel_m / settings.sample_m
            shape = (round(raster.height * scale), round(raster.width * scale))
            count = min(raster.count, 4)
            stack = raster.read(list(range(1, count + 1)), out_shape=(count, *shape))
    except rasterio.errors.RasterioIOError as error:
        raise SceneError(f"{path}: cannot be read as a raster ({error})") from error
    return _scene_of_stack(stack, settings)


def _scene_of_stack(stack: NDArray[np.generic], settings: SceneSettings) -> quilting.Picture:
    """The middle of a band stack (bands, rows, columns), cut to the scene's size."""
    rows, columns = stack.shape[1:]
    height, width = min(settings.height_px, rows), min(settings.width_px, columns)
    top, left = (rows - height) // 2, (columns - width) // 2
    cut = stack[:, top : top + height, left : left + width].astype(np.float32)
    picture = np.ascontiguousarray(np.moveaxis(cut, 0, -1))
    if picture.shape[2] < 3:
        picture = np.repeat(picture[..., :1], 3, axis=2)
    picture /= max(float(picture.max()), 1.0)
    if picture.shape[2] == 3:
        picture = np.dstack([picture, emulated_nir(picture)])
    return scaled(picture)


def describe(scene: Scene) -> Sequence[str]:
    """Sentences about a scene for the person who starts the emulator."""
    settings = scene.settings
    rows, columns = scene.bands["pan"].shape
    size = f"scene of {columns} x {rows} samples of {settings.sample_m:.3f} m"
    if settings.file is not None:
        return (f"{size} from {settings.file}",)
    sentences = [f"{size} from {scene.patches} patches of the shipped photographs"]
    if scene.reused_patches:
        sentences.append(
            f"{scene.reused_patches} patches are used more than once: the photographs are too "
            "small for this line; give a GeoTIFF for one that never repeats"
        )
    return sentences
