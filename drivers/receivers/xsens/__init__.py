"""Xsens MTi inertial units: MTData2 messages into records, and the device on a line."""
