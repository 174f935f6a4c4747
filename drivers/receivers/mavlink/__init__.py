"""MAVLink autopilots: messages into records, and the device on a line or network."""
