"""Who may read and command: tokens, roles, certificates and sockets."""
