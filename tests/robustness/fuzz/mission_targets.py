"""Readers of the files of a mission and of imported exposures."""

from __future__ import annotations

import contextlib
import json
from io import BytesIO

import numpy as np

from tests.robustness.fuzz.target import INPUT_MAX_SIZE, Target, scratch_file, scratch_folder


def exposure_record() -> Target:
    from daemon.mission.canonical_json import RecordError, parse_record
    from daemon.mission.exposure import capture_bytes, capture_from_json, exposure_bytes, from_json
    from tests.daemon.small_camera import capture_of, final_record

    def parse(data: bytes) -> object:
        content = parse_record(data, "exposure.json")
        with contextlib.suppress(RecordError):
            from_json(content)
        return capture_from_json(content)

    stored = capture_of(1)
    seeds = (capture_bytes(stored), exposure_bytes(final_record(stored)))
    return Target(parse, (RecordError,), seeds)


def quality_report() -> Target:
    from daemon.mission.canonical_json import RecordError
    from daemon.mission.store.level2 import read_report
    from processing.quality import valid_area

    def parse(data: bytes) -> object:
        report = read_report(scratch_file("quality.json", data).parent)
        return valid_area.from_json((report or {}).get("valid_area"))

    content = {
        "verdict": "usable",
        "findings": [{"flag": "BLUR", "sentence": "x", "verdict": "usable"}],
        "figures": {"sigma0_um": 0.2},
        "valid_area": {"columns": 4, "rows": 3, "gaps": {"pan": [[0, 0, 2, 1]]}},
    }
    return Target(parse, (RecordError,), (json.dumps(content).encode(),))


def stitch_record() -> Target:
    from daemon.mission.canonical_json import RecordError, parse_record
    from processing.mosaic.stitch_record import StitchRecordError, stitch_record_from_json

    return Target(
        lambda data: stitch_record_from_json(parse_record(data, "mosaic.json")),
        (RecordError, StitchRecordError),
        (
            b'{"format":1,"names":["a","b"],"values":[1,2],"covariance":[1,0,1],"rig":"r",'
            b'"calibration_id":"c","dc_k":{"1":0.5},"measured":["a"],"sigma0":1,"estimated_dc":[],'
            b'"height_m":900}',
        ),
    )


def flight_log() -> Target:
    from mcap.writer import CompressionType, Writer

    from daemon.mission.log.flight_log import read
    from daemon.mission.log.log_records import record_of

    def seed(compression: CompressionType) -> bytes:
        buffer = BytesIO()
        writer = Writer(buffer, compression=compression, chunk_size=200)
        writer.start()
        channel = writer.register_channel("event/x", "json", 0)
        for number in range(6):
            writer.add_message(channel, number, b'{"name":"x"}', number, number)
        writer.finish()
        return buffer.getvalue()

    def parse(data: bytes) -> object:
        return [record_of(message) for message in read(scratch_file("x.mcap", data))]

    kinds = (CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD)
    return Target(parse, (), tuple(seed(kind) for kind in kinds))


def chain() -> Target:
    from daemon.mission.verification.chain_file import first_line, read_history

    return Target(
        lambda data: read_history(scratch_file("chain.jsonl", data)), (), (first_line("a" * 64),)
    )


def _small_tiff(**options: object) -> bytes:
    import tifffile

    buffer = BytesIO()
    pixels = np.arange(16 * 24, dtype=np.uint16).reshape(16, 24)
    tifffile.imwrite(buffer, pixels, metadata=None, **options)
    return buffer.getvalue()


def _tiffs() -> tuple[bytes, ...]:
    return (
        _small_tiff(),
        _small_tiff(compression="zlib", predictor=True),
        _small_tiff(bigtiff=True, description='{"syntopic":1}'),
        _small_tiff(tile=(16, 16), compression="zlib"),
    )


def level0_tiff() -> Target:
    from daemon.mission.store.level0 import (
        RasterError,
        check_tiff,
        read_description,
        read_frame,
        read_tiff,
    )

    def parse(data: bytes) -> None:
        path = scratch_file("SU00.tif", data)
        read_description(path)
        for attempt in (
            lambda: read_tiff(path),
            lambda: read_tiff(path, plane=1),
            lambda: read_frame(path, width_px=24, height_px=16),
            lambda: check_tiff(path, width_px=24, height_px=16),
        ):
            try:
                attempt()
            except RasterError as error:
                str(error)

    return Target(parse, (), _tiffs())


def folder_frame() -> Target:
    from drivers.cameras.folder.frames import FrameFileError, read_frame

    return Target(
        lambda data: read_frame(scratch_file("a.tif", data), max_nbytes=1_000_000),
        (FrameFileError,),
        _tiffs(),
    )


def rededge_image() -> Target:
    from daemon.postflight.importers.multispectral_tags import ImagesError, read_image
    from tests.daemon.rededge_data import packet, write_tiff

    path = scratch_folder() / "seed.tif"
    write_tiff(path, packet())
    seeds = (path.read_bytes()[:INPUT_MAX_SIZE], *_tiffs())
    return Target(
        lambda data: read_image(scratch_file("IMG_0001_1.tif", data)), (ImagesError,), seeds
    )
