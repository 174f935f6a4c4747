"""The record of a received frame: its status, times and settings.

Buffers are received in `drivers.cameras.aravis.stream`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from drivers.cameras.aravis.camera import AravisCamera, ClockLatch, FrameGeometry
from drivers.cameras.aravis.stream import ReceivedFrame
from drivers.contract import Frame, FrameStatus

NOT_FRAMES: Final = ("aborted", "cleared", "filling", "unknown")
"""Status of buffers that are returned empty when a stream ends."""


def frame_status(geometry: FrameGeometry, received: ReceivedFrame) -> FrameStatus | None:
    """The status of a returned buffer.

    Args:
        geometry: configured size and format.
        received: the buffer.

    Returns:
        COMPLETE, INCOMPLETE or CORRUPT; None if the buffer contains no frame at all.
    """
    if received.reason in NOT_FRAMES:
        return None
    if received.reason == "size-mismatch":
        return FrameStatus.CORRUPT
    if received.reason != "success":
        return FrameStatus.INCOMPLETE
    found = (received.width_px, received.height_px, received.pixel_format_code)
    configured = (geometry.width_px, geometry.height_px, geometry.pixel_format_code)
    return FrameStatus.COMPLETE if found == configured else FrameStatus.CORRUPT


def frame_record(
    head: str,
    camera: AravisCamera,
    received: ReceivedFrame,
    status: FrameStatus,
    *,
    latch: ClockLatch | None,
    temperature_c: float | None,
    mono_ns: int,
) -> Frame:
    """The record of a frame: chunk data where the head sent them, else what is known otherwise.

    Args:
        head: name of the head.
        camera: the opened head.
        received: the buffer.
        status: the result of `frame_status`.
        latch: last reading of the head's clock; None without.
        temperature_c: last reading of the head's thermometer, degC; None without.
        mono_ns: arrival on CLOCK_MONOTONIC, ns.

    Returns:
        The record; its pixels are in slot `received.slot`.
    """
    geometry = camera.geometry
    if received.chunk_timestamp is not None:
        device_ns: int | None = camera.ns_from_ticks(received.chunk_timestamp)
    else:
        device_ns = received.leader_ns or None
    exposure_us = received.chunk_exposure_us
    return Frame(
        head=head,
        slot=received.slot,
        status=status,
        frame_id=received.frame_id if received.chunk_frame_id is None else received.chunk_frame_id,
        counter=received.chunk_counter,
        width_px=geometry.width_px if received.width_px is None else received.width_px,
        height_px=geometry.height_px if received.height_px is None else received.height_px,
        pixel_format=geometry.pixel_format
        if received.pixel_format_code in (None, geometry.pixel_format_code)
        else f"0x{received.pixel_format_code:08x}",
        device_ns=device_ns,
        device_clock_ns=None if latch is None else latch.device_clock_ns,
        device_clock_mono_ns=None if latch is None else latch.mono_ns,
        latch_sigma_ns=None if latch is None else latch.sigma_ns,
        mono_ns=mono_ns,
        exposure_time_us=camera.exposure_time_us if exposure_us is None else exposure_us,
        temperature_c=temperature_c
        if received.chunk_temperature_c is None
        else received.chunk_temperature_c,
        settings=_exposure_settings(camera, received),
    )


def _exposure_settings(
    camera: AravisCamera, received: ReceivedFrame
) -> Mapping[str, float | int | str]:
    """The head's settings, updated with the chunk data of this frame."""
    found = dict(camera.settings_of(received.chunk_exposure_us))
    if received.chunk_exposure_us is not None:
        found["ExposureTime"] = received.chunk_exposure_us
    if received.chunk_gain is not None:
        found.update(camera.reported_gain(received.chunk_gain))
    return found
