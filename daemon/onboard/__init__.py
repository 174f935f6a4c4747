"""What runs in the air: capture, flight logic, storage, pipeline, monitoring."""
