"""Detection of the device at a port: its protocol, its baud rate, and the settings it needs."""
