"""`service.toml`: its model, and all that is wrong with it at once."""
