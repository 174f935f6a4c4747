"""The running service prints its events; a reader may close the pipe."""

from __future__ import annotations

import io
import sys

import pytest

from daemon.cli import run


class _ClosedPipe(io.StringIO):
    def write(self, text: str) -> int:
        raise BrokenPipeError(32, "Broken pipe")


def test_a_reader_that_has_gone_is_no_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", _ClosedPipe())
    for show in (run._print_json, run._print_line):
        show({"event": "ready", "mono_ns": "1", "absent": []})
