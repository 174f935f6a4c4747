"""Compilation of kernels in several processes, each kernel after those that it calls.

Which argument types a kernel is compiled for is in `kernel_variants.toml`, recorded by
`python -m benchmarks.kernel_variants`.
"""

from __future__ import annotations

import functools
import multiprocessing
import os
import re
import signal
import time
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing import connection
from pathlib import Path
from typing import Any, Final

from numba.core import sigutils
from numba.core.dispatcher import Dispatcher

from processing import ProcessingError

VARIANTS_FILE: Final = Path(__file__).with_name("kernel_variants.toml")
COMPILATION_TIMEOUT_S: Final = 600.0
_LITERAL: Final = re.compile(r"Literal\[int\]\((\d+)\)")
_ARRAY: Final = re.compile(r"Array\((\w+), (\d), '([CFA])', False, aligned=True\)")
_SLICES: Final = {
    "C": lambda n: [":"] * (n - 1) + ["::1"],
    "F": lambda n: ["::1"] + [":"] * (n - 1),
    "A": lambda n: [":"] * n,
}

Progress = Callable[[str, float, float], None]
"""Called with the last kernel compiled, the seconds of those compiled, and the seconds of all."""


class KernelCompilationError(ProcessingError):
    """A kernel could not be compiled; the message names it."""


@dataclass(frozen=True)
class KernelVariants:
    """Argument types that a kernel is compiled for, and the processor time that takes, s."""

    signatures: tuple[str, ...]
    seconds: float


def signature_text(arguments: tuple[Any, ...]) -> str:
    """Argument types in numba's notation.

    Args:
        arguments: numba's types of one variant.

    Returns:
        Text as in `kernel_variants.toml`.

    Example:
        >>> from numba import types
        >>> signature_text((types.float32[:, ::1], types.literal(4)))
        '(float32[:, ::1], literal(4))'
    """
    text = _LITERAL.sub(r"literal(\1)", repr(arguments))
    text = _ARRAY.sub(lambda m: f"{m[1]}[{', '.join(_SLICES[m[3]](int(m[2])))}]", text)
    return re.sub(r"\bbool\b", "boolean", text)


def argument_types(text: str) -> tuple[Any, ...]:
    """Inverse of `signature_text`.

    Args:
        text: such as "(float32[:, ::1], literal(4))".

    Returns:
        Numba's types.
    """
    found: tuple[Any, ...] = sigutils.normalize_signature(text)[0]
    return found


def recorded_variants(path: Path = VARIANTS_FILE) -> dict[str, KernelVariants]:
    """Read the table of variants.

    Args:
        path: a file like `kernel_variants.toml`.

    Returns:
        Variants by "module.function".
    """
    content = tomllib.loads(path.read_text("utf-8"))
    return {
        name: KernelVariants(tuple(entry["variants"]), float(entry["seconds"]))
        for name, entry in content.items()
    }


def _is_cached(kernel: Any, signatures: Sequence[str]) -> bool:
    """Whether the cache on disk holds variants of the present code, undamaged."""
    variants = [argument_types(text) for text in signatures]
    holds: bool = kernel._cache.holds(variants, kernel.targetctx.codegen())
    return holds


def missing_variants(
    kernels: Mapping[str, Any], table: Mapping[str, KernelVariants]
) -> dict[str, KernelVariants]:
    """Kernels of which the cache does not hold every recorded variant, current and undamaged.

    Args:
        kernels: dispatchers by "module.function".
        table: the recorded variants.

    Returns:
        Their entries of the table.
    """
    return {
        name: entry
        for name, entry in table.items()
        if name in kernels and not _is_cached(kernels[name], entry.signatures)
    }


def compile_recorded(
    kernels: Mapping[str, Any],
    *,
    progress: Progress | None = None,
    processes: int | None = None,
    table: Mapping[str, KernelVariants] | None = None,
) -> int:
    """Compile the recorded variants that the cache does not hold.

    Args:
        kernels: dispatchers by "module.function".
        progress: called after each kernel.
        processes: None takes the cores of this process, and no more than the order permits.
        table: None takes the recorded one.

    Returns:
        The number of variants compiled.

    Raises:
        KernelCompilationError: a kernel could not be compiled, or its process ended.
    """
    missing = missing_variants(kernels, recorded_variants() if table is None else table)
    if not missing:
        return 0
    for kernel in kernels.values():
        kernel._cache.remove_unused()
    callees = {name: _callees(kernels, name) & missing.keys() for name in missing}
    chains = _longest_chains(missing, callees)
    total_s = sum(entry.seconds for entry in missing.values())
    if processes is None:
        useful = int(total_s / max(chains.values())) + 1
        processes = min(len(os.sched_getaffinity(0)), useful)
    waiting = sorted(missing, key=lambda name: -chains[name])
    compiled, done_s, done = 0, 0.0, set[str]()
    with _Pool(processes) as pool:
        while len(done) < len(missing):
            for worker in pool.idle:
                name = next((n for n in waiting if callees[n] <= done), None)
                if name is None:
                    break
                waiting.remove(name)
                pool.start(worker, name, missing[name])
            name, count = pool.result()
            done.add(name)
            compiled += count
            done_s += missing[name].seconds
            if progress is not None:
                progress(name, done_s, total_s)
    return compiled


def _callees(kernels: Mapping[str, Any], name: str) -> set[str]:
    """Other kernels that a kernel calls by their global name."""
    function = kernels[name].py_func
    names = {id(kernel): other for other, kernel in kernels.items()}
    used = (function.__globals__.get(word) for word in function.__code__.co_names)
    found = {names[id(one)] for one in used if isinstance(one, Dispatcher) and id(one) in names}
    return found - {name}


def _longest_chains(
    table: Mapping[str, KernelVariants], callees: Mapping[str, set[str]]
) -> dict[str, float]:
    """Seconds of each kernel and of its longest chain of callers, which wait for it."""
    callers = {name: {n for n, below in callees.items() if name in below} for name in table}

    @functools.cache
    def seconds(name: str) -> float:
        return table[name].seconds + max((seconds(above) for above in callers[name]), default=0.0)

    return {name: seconds(name) for name in table}


class _Pool:
    """Processes that compile one kernel at a time; those at work are killed on leaving."""

    def __init__(self, processes: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.idle: list[connection.Connection] = []
        self._busy: dict[connection.Connection, tuple[str, float]] = {}
        self._processes = []
        for number in range(processes):
            ours, theirs = context.Pipe()
            process = context.Process(
                target=_serve, args=(theirs,), name=f"compiler-{number}", daemon=True
            )
            process.start()
            theirs.close()
            self.idle.append(ours)
            self._processes.append(process)

    def __enter__(self) -> _Pool:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes:
            process.kill()
            process.join()

    def start(self, worker: connection.Connection, name: str, entry: KernelVariants) -> None:
        """Give an idle process a kernel."""
        self.idle = [one for one in self.idle if one is not worker]
        self._busy[worker] = (name, time.monotonic() + COMPILATION_TIMEOUT_S)
        worker.send((name, entry.signatures))

    def result(self) -> tuple[str, int]:
        """The next kernel that is compiled, and how many variants that took.

        Raises:
            KernelCompilationError: it failed, its process ended, or it took too long.
        """
        limit_s = min(limit for _, limit in self._busy.values()) - time.monotonic()
        ready = connection.wait(list(self._busy), max(limit_s, 0.0))
        if not ready:
            name = min(self._busy.values(), key=lambda work: work[1])[0]
            raise KernelCompilationError(
                f"{name} was not compiled within {COMPILATION_TIMEOUT_S:.0f} s"
            )
        worker = ready[0]
        assert isinstance(worker, connection.Connection)
        name, _ = self._busy.pop(worker)
        try:
            answer: int | str = worker.recv()
        except (EOFError, ConnectionError):
            raise KernelCompilationError(
                f"the process that compiled {name} ended; check the free memory"
            ) from None
        if isinstance(answer, str):
            raise KernelCompilationError(f"{name} cannot be compiled: {answer}")
        self.idle.append(worker)
        return name, answer


def _serve(requests: connection.Connection) -> None:
    """Compile what is requested until the other end is closed."""
    from processing.pipelines.kernel_compilation import kernels

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    found = kernels()
    while True:
        try:
            name, signatures = requests.recv()
        except EOFError:
            return
        kernel = found[name]
        before = sum(kernel.stats.cache_misses.values())
        try:
            for text in signatures:
                kernel.compile(argument_types(text))
        except Exception as error:  # noqa: BLE001 - named with its kernel by the other side
            requests.send(f"{type(error).__name__}: {error}")
            continue
        if not _is_cached(kernel, signatures):
            folder = kernel._cache.cache_path
            requests.send(f"{folder} could not be written; check the free space and its owner")
            continue
        requests.send(sum(kernel.stats.cache_misses.values()) - before)
