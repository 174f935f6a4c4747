"""NovAtel OEM7 and SPAN receivers: binary and ASCII logs into records, and the device on a line."""
