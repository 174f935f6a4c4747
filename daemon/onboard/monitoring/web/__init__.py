"""The operator's page and its HTTP and WebSocket interface."""
