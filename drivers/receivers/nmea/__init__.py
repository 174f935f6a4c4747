"""NMEA 0183 receivers: sentences into records, and the device on a line."""
