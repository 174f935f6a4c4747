"""A pytest plugin, `-p benchmarks.executed_lines`: which lines of which modules tests execute.

Writes a JSON object, lines by path, to the file that `EXECUTED_LINES` names. It watches the main
thread in files below the folder that `WATCHED` names.
"""

from __future__ import annotations

import json
import os
import sys
from collections import defaultdict
from pathlib import Path
from types import FrameType
from typing import Any

_watched = os.environ.get("WATCHED", "")
_lines: defaultdict[str, set[int]] = defaultdict(set)


def pytest_configure() -> None:
    """Watch from before the first import of what is tested."""
    sys.settrace(_at_call)


def pytest_sessionfinish() -> None:
    """Write what was found."""
    sys.settrace(None)
    found = {os.path.relpath(path): sorted(lines) for path, lines in _lines.items()}
    Path(os.environ["EXECUTED_LINES"]).write_text(json.dumps(found))


def _at_call(frame: FrameType, event: str, argument: Any) -> Any:
    return _at_line if frame.f_code.co_filename.startswith(_watched) else None


def _at_line(frame: FrameType, event: str, argument: Any) -> Any:
    _lines[frame.f_code.co_filename].add(frame.f_lineno)
    return _at_line
