"""The onboard service: when to expose, what is stored, who may watch and ask."""

import os

# Set before NumPy is loaded anywhere. The adjustment's matrices are small: a second BLAS thread
# only waits for the first. Threads that spin while they wait take the cores from those that work.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "passive")


class DaemonError(Exception):
    """Root of what the daemon raises on purpose.

    Every message is one sentence for the crew: what was found, where, and what would be right.
    """
