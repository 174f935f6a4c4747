"""Record the argument types that each kernel is compiled for, and the time that takes.

`python -m benchmarks.kernel_variants` compiles into an empty cache and writes
`processing/pipelines/kernel_variants.toml`. Run it after a kernel, or how it is called, has
changed.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from numba.core import event

from processing.pipelines.kernel_compilation import compile_for, kernels
from processing.pipelines.parallel_compilation import (
    VARIANTS_FILE,
    KernelVariants,
    signature_text,
)
from processing.rig import find_rig

RIGS = ("ultracam-x-mini", "midas-mini")
"""Together they call every variant that the shipped rigs call."""

_IN_EMPTY_CACHE = "in-empty-cache"


# numba states no types.
class _Recorder(event.Listener):  # type: ignore[misc]
    """Argument types by kernel, and the processor time without that of other kernels, s."""

    def __init__(self) -> None:
        self.names = {id(kernel): name for name, kernel in kernels().items()}
        self.signatures: dict[str, set[str]] = {}
        self.seconds: dict[str, float] = {}
        self._began: list[float] = []
        self._inner: list[float] = [0.0]

    def on_start(self, event: Any) -> None:
        if id(event.data["dispatcher"]) in self.names:
            self._began.append(time.process_time())
            self._inner.append(0.0)

    def on_end(self, event: Any) -> None:
        name = self.names.get(id(event.data["dispatcher"]))
        if name is None:
            return
        spent = time.process_time() - self._began.pop()
        own = spent - self._inner.pop()
        self._inner[-1] += spent
        self.signatures.setdefault(name, set()).add(signature_text(event.data["args"]))
        self.seconds[name] = self.seconds.get(name, 0.0) + own


def record() -> dict[str, KernelVariants]:
    """Compile for the rigs into the cache of this process, which is empty."""
    listener = _Recorder()
    event.register("numba:compile", listener)
    for rig in RIGS:
        compile_for(find_rig(rig), processes=0)
    return {
        name: KernelVariants(tuple(sorted(found)), round(listener.seconds[name], 2))
        for name, found in sorted(listener.signatures.items())
    }


def as_toml(table: dict[str, KernelVariants]) -> str:
    """The file that `recorded_variants` reads."""
    lines = ["# Written by `python -m benchmarks.kernel_variants`: processor seconds, and types."]
    for name, entry in table.items():
        listed = ",\n    ".join(f'"{signature}"' for signature in entry.signatures)
        listed = f"\n    {listed},\n" if len(entry.signatures) > 1 else listed
        lines += ["", f'["{name}"]', f"seconds = {entry.seconds}", f"variants = [{listed}]"]
    return "\n".join(lines) + "\n"


def main() -> int:
    if sys.argv[1:] != [_IN_EMPTY_CACHE]:
        with TemporaryDirectory(prefix="syntopic-kernels-") as cache:
            command = [sys.executable, "-m", "benchmarks.kernel_variants", _IN_EMPTY_CACHE]
            variables = os.environ | {"NUMBA_CACHE_DIR": cache}
            return subprocess.run(command, env=variables, check=False).returncode
    table = record()
    Path(VARIANTS_FILE).write_text(as_toml(table), "utf-8")
    seconds = sum(entry.seconds for entry in table.values())
    count = sum(len(entry.signatures) for entry in table.values())
    print(f"{count} variants of {len(table)} kernels, {seconds:.0f} s of processor time")
    return 0


if __name__ == "__main__":
    sys.exit(main())
