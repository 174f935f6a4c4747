"""What a flight decides, without processes: open exposures, ledger, phases, latches, events."""
