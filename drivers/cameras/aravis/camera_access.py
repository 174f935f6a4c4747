"""Opening a head through Aravis by its address alone, independent of discovery replies."""

from __future__ import annotations

from typing import Any, Final

from drivers.cameras.aravis.description_cycles import (
    DescriptionUnreadableError,
    features_with_cycles,
)
from drivers.cameras.aravis.library import (
    aravis,
    aravis_error,
    inet_address,
    message_of,
    stored_description,
)
from drivers.cameras.aravis.packet_filter import interface_towards
from drivers.contract import DeviceError

DEVICE_ERRORS: Final = "arv-device-error-quark"
"""Domain of the errors of Aravis' devices."""
ACCESS_DENIED: Final = "access-denied"
"""In the message of Aravis for the status GEV_STATUS_ACCESS_DENIED."""


class ControlDeniedError(DeviceError):
    """Another program controls the head."""


def local_interface(head_name: str, address: str) -> str:
    """The local interface towards a head.

    Args:
        head_name: name of the head, for the message.
        address: IPv4 address of the head.

    Returns:
        IPv4 address of the interface.

    Raises:
        DeviceError: no interface reaches the head.
    """
    try:
        return interface_towards(address)
    except OSError as error:
        raise DeviceError(
            f"{head_name}: no interface of this computer reaches it ({error}); check the network's "
            "settings and cable"
        ) from None


def open_camera(head_name: str, interface: str, address: str) -> Any:
    """Open a camera of Aravis.

    Args:
        head_name: name of the head, for the message.
        interface: IPv4 address of the local interface; empty to open by name.
        address: IPv4 address of the head, or its name.

    Returns:
        The camera of Aravis.

    Raises:
        ControlDeniedError: another program has exclusive access.
        DeviceError: it does not answer.
    """
    library, failed = aravis(), aravis_error()
    try:
        if not interface:
            return library.Camera.new(address)
        # Quirk: by name, Aravis opens the address of any discovery reply, also of a forged one. The
        # head is opened by its address. Upstream: no report known (2026-11-23).
        gio = inet_address()
        device = library.GvDevice.new(gio.new_from_string(interface), gio.new_from_string(address))
        return library.Camera.new_with_device(device)
    except failed as error:
        not_found = (DEVICE_ERRORS, int(library.DeviceError.GENICAM_NOT_FOUND))
        if (getattr(error, "domain", ""), getattr(error, "code", -1)) == not_found:
            raise DeviceError(unreadable_description(head_name, message_of(error))) from None
        if ACCESS_DENIED in message_of(error):
            raise ControlDeniedError(
                f"{head_name}: another program has exclusive access to the head; end that program"
            ) from None
        raise DeviceError(
            f"{head_name}: the head cannot be opened ({message_of(error)}); check power, cable and "
            "address"
        ) from None


def endless_features(head_name: str, device: Any) -> frozenset[str]:
    """Features of an opened head that refer to themselves and must not be evaluated.

    Args:
        head_name: name of the head, for the message.
        device: the device of Aravis.

    Returns:
        Names of features; empty if only Aravis can read the description.

    Raises:
        DeviceError: neither this program nor Aravis can read the description.
    """
    try:
        return features_with_cycles(stored_description(device).rstrip(b"\0"))
    except DescriptionUnreadableError as error:
        reason = str(error)
    if all(device.get_feature(name) is None for name in ("PixelFormat", "AcquisitionStart")):
        raise DeviceError(unreadable_description(head_name, reason))
    return frozenset()


def unreadable_description(head_name: str, reason: str) -> str:
    """The sentence for a head whose description of its features cannot be read.

    Args:
        head_name: name of the head.
        reason: what is wrong with it.

    Returns:
        A sentence with the remedy.
    """
    return (
        f"{head_name}: the head's GenICam description cannot be read ({reason}); update its "
        "firmware"
    )
