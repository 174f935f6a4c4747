"""Positions by RTKLIB EX (the fork demo5), with those of event marks in `<name>_events.pos`.

Run: `python -m tests.support.rtklib_ex CONF OUT ROVER BASE NAV`. Its functions are those of
rnx2rtkp, called from a process of their own: they hold global state.
"""

from __future__ import annotations

import importlib
import sys
from typing import Any


def main(conf: str, out: str, *inputs: str) -> int:
    rtklib: Any = importlib.import_module("pyrtklib5")
    processing, solution, files = rtklib.prcopt_t(), rtklib.solopt_t(), rtklib.filopt_t()
    rtklib.resetsysopts()
    if rtklib.loadopts(conf, rtklib.sysopts.ptr) != 1:
        return 1
    rtklib.getsysopts(processing, solution, files)
    whole = rtklib.gtime_t()
    status = rtklib.postpos(
        whole, whole, 0.0, 0.0, processing, solution, files, list(inputs), len(inputs), out, "", ""
    )
    return int(status)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
