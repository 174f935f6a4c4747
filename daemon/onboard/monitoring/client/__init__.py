"""The other side of the page: `syntopic monitor` and discovery."""
