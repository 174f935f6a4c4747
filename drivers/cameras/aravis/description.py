"""Description of a GenICam head for a new configuration: size, format and trigger of its frames."""

from __future__ import annotations

import gc
from typing import Any, Final

from drivers.cameras.aravis.camera_access import endless_features, local_interface, open_camera
from drivers.cameras.aravis.discovery import FoundHead
from drivers.cameras.aravis.feature_access import FeatureError, Features
from drivers.cameras.aravis.formats import pattern_and_bits, usual_format
from drivers.cameras.aravis.gvcp import is_ip_address
from drivers.cameras.aravis.library import OPENING, aravis_error, message_of
from drivers.cameras.head_description import HeadDescription
from drivers.contract import DeviceError

FILTER_ARRAYS: Final = {"RG": "RGGB", "BG": "BGGR", "GR": "GRBG", "GB": "GBRG"}


def describe(head: FoundHead) -> HeadDescription:
    """Open a head, read its size and formats, and release it; nothing is written to it.

    Args:
        head: as the discovery found it; model and serial number may be empty.

    Returns:
        The head as it is set now.

    Raises:
        DeviceError: it does not answer, another program controls it, or it has no usable format.
    """
    name = f"head {head.model or 'without model'} at {head.address}"
    with OPENING:
        is_address = is_ip_address(head.address)
        interface = local_interface(name, head.address) if is_address else ""
        camera = open_camera(name, interface, head.address)
        try:
            return _described(name, head, camera)
        except (FeatureError, aravis_error()) as error:
            raise DeviceError(
                f"{name}: its properties cannot be read ({message_of(error)}); check power and "
                "cable, then try again"
            ) from None
        finally:
            del camera
            gc.collect()


def _described(name: str, head: FoundHead, camera: Any) -> HeadDescription:
    device = camera.get_device()
    if camera.is_gv_device() and not device.is_controller():
        raise DeviceError(f"{name}: another program controls the head; end that program")
    features = Features(device, endless_features(name, device))
    pixel_format = usual_format(features.entries("PixelFormat"), features.text("PixelColorFilter"))
    if pixel_format is None:
        raise DeviceError(
            f"{name}: it has no pixel format of 8 to 16 bits, monochrome or Bayer; it cannot be "
            "used"
        )
    pattern, bits = pattern_and_bits(pixel_format)
    serial = head.serial or _text(camera.get_device_serial_number())
    width, height = (int(features.get(key)) for key in ("Width", "Height"))
    return HeadDescription(
        driver="aravis",
        model=head.model or _text(camera.get_model_name()),
        serial=serial,
        place=head.address,
        width_px=width,
        height_px=height,
        pixel_format=pixel_format,
        bits=bits,
        filter_array=FILTER_ARRAYS.get(pattern, "none"),
        full_width_px=_whole(features, "SensorWidth"),
        full_height_px=_whole(features, "SensorHeight"),
        settings={
            "address": head.address,
            **({"serial": serial} if serial else {}),
            "pixel_format": pixel_format,
            "width_px": width,
            "height_px": height,
        },
    )


def _text(answer: object) -> str:
    return "".join(c if c.isprintable() else "?" for c in str(answer or ""))


def _whole(features: Features, name: str) -> int:
    value = features.number(name) if features.is_available(name) else None
    return int(value or 0)
