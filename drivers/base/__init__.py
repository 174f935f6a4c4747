"""What all drivers share: life cycle, settings, registry and throttled messages."""
