"""Output on a terminal: tables, progress, and text that is safe to print."""
