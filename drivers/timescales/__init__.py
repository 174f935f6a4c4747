"""GPS time, UTC with leap seconds, and the monotonic clock."""
