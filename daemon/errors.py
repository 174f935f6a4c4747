"""The family of errors of this package.

Every message is one sentence for the crew: what was found, where, and what would be right.
"""


class DaemonError(Exception):
    """Root of what the daemon raises on purpose."""
