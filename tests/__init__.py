"""Tests mirror the four packages; with one BLAS thread, as the service has it."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
