"""Real devices behind small protocols, one room per device family.

`drivers.contract` says what a device is and what it yields; nothing here knows the daemon.
"""
