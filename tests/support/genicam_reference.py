"""Registers behind the reference implementation of GenApi, which is the package `genicam`."""

from __future__ import annotations

from typing import Any

import pytest

from sim_hw.gige.described_registers import SparseMemory

genapi = pytest.importorskip("genicam.genapi", reason="needs the genicam package (x86-64)")


# The package states no types.
class Port(genapi.AbstractPort):  # type: ignore[misc]
    """The registers, as the reference implementation reads them."""

    def __init__(self, memory: SparseMemory) -> None:
        super().__init__()
        self._memory = memory

    def read(self, address: int, length: int) -> bytes:
        return self._memory.read(address, length)

    def write(self, address: int, value: Any) -> None:
        self._memory.write(address, bytes(value))

    def is_open(self) -> bool:
        return True

    def get_access_mode(self) -> Any:
        return genapi.EAccessMode.RW
