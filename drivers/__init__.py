"""Drivers of real devices behind small protocols, one package per device family.

`drivers.contract` defines what a device is and what it yields. No driver imports the daemon.
"""


class DriverError(Exception):
    """Root of what the drivers raise on purpose."""
