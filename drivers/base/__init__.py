"""Parts common to all drivers: life cycle, settings, registry and throttled events."""
