"""Clock models, and the assignment of frames and marks to pulses."""
