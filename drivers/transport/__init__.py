"""Serial ports, TCP and UDP: opening, time-outs and reconnecting."""
