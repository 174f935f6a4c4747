"""Thermometers on a Modbus RTU line: the frames of the protocol, and the device."""
