"""u-blox receivers: framing and decoding of UBX without I/O, and the device on a serial line."""
