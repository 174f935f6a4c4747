"""Random numbers by purpose: everything random in the emulated world follows from one seed."""

from __future__ import annotations

import zlib

import numpy as np


def random_stream(seed: int, *labels: str | int) -> np.random.Generator:
    """A stream of random numbers of its own for each purpose, so that one draw moves no other."""
    keys = [zlib.crc32(str(label).encode()) for label in labels]
    return np.random.default_rng([seed, *keys])
