"""The emulated world: flight, ground, true camera, light, truth."""
