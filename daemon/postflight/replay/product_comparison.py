"""Process records and images of a flight again and compare them with those on disk.

Nothing is written. What the flight decided about an exposure's images, that they were made late, is
taken from the log; everything else is computed.
"""

from __future__ import annotations

import hashlib
import tokenize
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from daemon import DaemonError
from daemon.configuration.model import PlanSection, ProcessingSection
from daemon.mission.canonical_json import RecordError, canonical_bytes, parse_record, sha256_hex
from daemon.mission.exposure import Exposure, exposure_bytes
from daemon.mission.layout import Mission
from daemon.mission.store.level0 import refuse_decompression_bomb, tiff_errors
from daemon.mission.store.level0_folder import EXPOSURE_FILE, load_level0
from daemon.orientation.exterior_orientation import mount_of
from daemon.orientation.ground_model import ground_of
from daemon.planning.overlaps import overlaps_of
from daemon.postflight.replay.flight_replay import ReplayResult
from daemon.products.exposure_products import FlightGeometry, make_products
from daemon.products.pipeline_pool import PipelinePool
from daemon.products.processing_threads import configure_threads
from daemon.products.processor import Processor, processor_for
from processing.image.accelerator.devices import with_same_pixels
from processing.quality.report import Flag
from processing.rig import Rig

ARRAYS_MAX_NBYTES = 256_000_000
UNTIMED = frozenset({"timings_s", "duration_s"})
"""Keys of quality.json that say how long things took."""

Progress = Callable[[int], None]


def compare_records(mission: Mission, out: ReplayResult) -> None:
    """The canonical JSON of every record, byte for byte, each quoting the one replayed before."""
    head: str | None = None
    for exposure in out.records:
        path = mission.level0(exposure.number) / EXPOSURE_FILE
        name = f"L0/{path.parent.name}/{EXPOSURE_FILE}"
        try:
            data = path.read_bytes()
            flown = parse_record(data, name)
        except (OSError, RecordError) as error:
            out.compare("exposure records", agrees=False, sentence=f"{name}: {error}")
            continue
        quoted = head or str(flown.get("previous_sha256", ""))
        again = exposure_bytes(replace(exposure, previous_sha256=quoted))
        head = sha256_hex(again)
        keys = _differing(flown, parse_record(again, name))
        sentence = f"{name}: differs in {', '.join(keys) or 'its form'}"
        out.compare("exposure records", agrees=again == data, sentence=sentence)


def compare_products(
    mission: Mission,
    rig: Rig,
    processing: ProcessingSection,
    plan: PlanSection,
    out: ReplayResult,
    *,
    radiometry: Path | None,
    parallel: int,
    only: Sequence[int] = (),
    progress: Progress = lambda _done: None,
) -> None:
    """The images of every exposure that has some, made again with so many exposures in work.

    Args:
        processing, plan: as flown. Pixels of an accelerator that is not here are computed by the
            processor.
        out: records replayed before; takes in the comparison.
        radiometry: folder of radiometric calibrations; None takes those of the mission.
        parallel: exposures processed at a time.
        only: numbers of the exposures that are compared; empty takes all.
    """
    configure_threads()
    device = with_same_pixels(processing.device)
    processing = processing.model_copy(update={"device": device})
    processor = processor_for(rig, mission, processing, radiometry)
    processor.warm_up()
    mount, _ = mount_of(mission)
    geometry = FlightGeometry(mount, plan, ground_of(rig, mount, plan))
    overlaps = overlaps_of(mission, rig, out.records)
    chosen = [
        exposure
        for exposure in out.records
        if (not only or exposure.number in only) and mission.level2(exposure.number).is_dir()
    ]

    def again(exposure: Exposure, free: Processor) -> dict[str, str]:
        frames, _ = load_level0(mission.level0(exposure.number), rig)
        flags = Flag.PROCESSING_BEHIND if out.deferred.get(exposure.number) else Flag(0)
        products = make_products(
            free, geometry, exposure, frames, flags, overlaps.of(exposure.number)
        )
        files = products.contents.items()
        return {name: content_hash(name, b"".join(parts)) for name, parts in files}

    working = PipelinePool[Processor](processor, parallel)
    results = [working.submit(partial(again, exposure)) for exposure in chosen]
    for exposure, result in zip(chosen, results, strict=True):
        name = f"L2/{mission.level2(exposure.number).name}"
        try:
            found = result.result()
        except (OSError, ValueError, ArithmeticError, DaemonError) as error:
            out.compare("images", agrees=False, sentence=f"{name}: not made again: {error}")
            continue
        flown = _hashes_on_disk(mission.level2(exposure.number))
        for file in sorted(flown.keys() | found.keys()):
            sentence = f"{name}/{file}: differs with {parallel} in work"
            what = f"{file}, {parallel} in work"
            out.compare(what, agrees=flown.get(file) == found.get(file), sentence=sentence)
        progress(exposure.number)
    working.end()


def content_hash(name: str, data: bytes) -> str:
    """SHA-256 of a file's content: decoded pixels and arrays, canonical JSON without durations."""
    digest = hashlib.sha256()
    if name.endswith(".tif"):
        with tifffile.TiffFile(BytesIO(data)) as tiff:
            refuse_decompression_bomb(tiff.pages[0], Path(name))
            pixels = tiff.pages[0].asarray()
        digest.update(f"{pixels.dtype} {pixels.shape}".encode())
        digest.update(np.ascontiguousarray(pixels).data)
    elif name.endswith(".npz"):
        with np.load(BytesIO(data), allow_pickle=False) as arrays:
            announced = sum(member.file_size for member in arrays.zip.infolist())
            if announced > ARRAYS_MAX_NBYTES:
                raise ValueError(f"{name} announces {announced} bytes")
            for key in sorted(arrays):
                array = np.ascontiguousarray(arrays[key])
                digest.update(f"{key} {array.dtype} {array.shape}".encode())
                digest.update(array.tobytes())
    elif name.endswith(".json"):
        content = parse_record(data, name)
        compared = {key: value for key, value in content.items() if key not in UNTIMED}
        digest.update(canonical_bytes(compared))
    else:
        digest.update(data)
    return digest.hexdigest()


def _hashes_on_disk(folder: Path) -> dict[str, str]:
    found = {}
    damaged = (EOFError, SyntaxError, tokenize.TokenError, zipfile.BadZipFile)
    faults: tuple[type[Exception], ...] = (OSError, *damaged, *tiff_errors())
    for path in folder.iterdir():
        try:
            found[path.name] = content_hash(path.name, path.read_bytes())
        except faults:
            found[path.name] = "unreadable"
    return found


def _differing(flown: Mapping[str, Any], again: Mapping[str, Any]) -> list[str]:
    return sorted(key for key in flown.keys() | again.keys() if flown.get(key) != again.get(key))
