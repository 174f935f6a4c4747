"""Client side of monitoring: `syntopic monitor` and discovery."""
