"""GNSS and INS receivers: framing, decoding and navigation."""
