"""What there is to see and how it is seen: flight, ground, true camera, light, truth."""
