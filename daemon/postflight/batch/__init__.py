"""One action for every exposure of a mission: in process, in processes, on a cluster."""
