"""The drivers, by kind and name.

The service validates configurations with this registry, and the capture process creates devices
with it. Importing or querying it loads no hardware library.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Final

from drivers.base.settings import Configured
from drivers.contract import DeviceError

_DRIVER_PATHS: Final[Mapping[str, Mapping[str, str]]] = {
    "head": {
        "aravis": "drivers.cameras.aravis.aravis_head:AravisHead",
        "folder": "drivers.cameras.folder.folder_head:FolderHead",
        "v4l2": "drivers.cameras.v4l2.v4l2_head:V4l2Head",
    },
    "trigger": {
        "pulse-bus": "drivers.triggers.pulse_bus:PulseBusTrigger",
        "software": "drivers.triggers.software:SoftwareTrigger",
        "gige-action": "drivers.cameras.aravis.action_trigger:ActionTrigger",
    },
    "thermometer": {
        "modbus-rtu": "drivers.thermometers.modbus_rtu.thermometer:ModbusThermometer",
        "ascii-line": "drivers.thermometers.ascii_line.thermometer:AsciiLineThermometer",
        "host": "drivers.thermometers.host.thermometer:HostThermometer",
    },
    "pps": {
        "kernel": "drivers.triggers.pps.device:PpsDevice",
    },
    "navigator": {
        "ublox": "drivers.receivers.ublox.navigator:UbloxNavigator",
        "gpsd": "drivers.receivers.gpsd.navigator:GpsdNavigator",
        "nmea": "drivers.receivers.nmea.navigator:NmeaNavigator",
        "novatel": "drivers.receivers.novatel.navigator:NovatelNavigator",
        "septentrio": "drivers.receivers.septentrio.navigator:SeptentrioNavigator",
        "sbg": "drivers.receivers.sbg.navigator:SbgNavigator",
        "vectornav": "drivers.receivers.vectornav.navigator:VectornavNavigator",
        "xsens": "drivers.receivers.xsens.navigator:XsensNavigator",
        "applanix": "drivers.receivers.applanix.navigator:ApplanixNavigator",
        "gsof": "drivers.receivers.gsof.navigator:GsofNavigator",
        "mavlink": "drivers.receivers.mavlink.navigator:MavlinkNavigator",
    },
}


_EXTRAS: Final[Mapping[str, tuple[str, ...]]] = {
    "aravis": ("aravis",),
    "gige-action": ("aravis",),
    "mavlink": ("mavlink",),
}


def extras_of(kind: str, driver_name: str) -> tuple[str, ...]:
    """The optional libraries that a driver needs.

    Args:
        kind: kind of the device.
        driver_name: name of the driver.

    Returns:
        Their names in `drivers.base.extras`; empty for an unknown driver.
    """
    return _EXTRAS.get(driver_name, ()) if driver_name in _DRIVER_PATHS.get(kind, {}) else ()


def kinds() -> Mapping[str, tuple[str, ...]]:
    """The kinds of devices and their drivers.

    Returns:
        Names of the drivers by kind.
    """
    return {kind: tuple(driver_paths) for kind, driver_paths in _DRIVER_PATHS.items()}


def driver_for(kind: str, driver_name: str) -> type[Configured]:
    """The class of a driver.

    Every class is created with `(name, settings)`; a head also with `memory=` (FrameMemory), the
    software trigger with `heads=` (heads by output).

    Args:
        kind: kind of the device.
        driver_name: name of the driver.

    Returns:
        The class; its module is loaded.

    Raises:
        DeviceError: no such kind or driver; the message lists the known ones.
    """
    if kind not in _DRIVER_PATHS:
        raise DeviceError(f"kind is {kind!r}; one of {', '.join(_DRIVER_PATHS)}")
    driver_paths = _DRIVER_PATHS[kind]
    if driver_name not in driver_paths:
        raise DeviceError(f"driver is {driver_name!r}; a {kind} has {', '.join(driver_paths)}")
    module, _, attribute = driver_paths[driver_name].partition(":")
    driver: type[Configured] = getattr(importlib.import_module(module), attribute)
    return driver


def problems(kind: str, driver_name: str, settings: Mapping[str, object]) -> list[str]:
    """The errors in the settings of a device.

    Args:
        kind: kind of the device.
        driver_name: name of the driver.
        settings: the driver's own keys only, without the names of the device and the driver.

    Returns:
        One sentence for each error; empty if there are none.
    """
    try:
        driver = driver_for(kind, driver_name)
    except DeviceError as error:
        return [str(error)]
    return driver.problems(settings)
