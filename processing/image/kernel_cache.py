"""The cache of compiled kernels on disk: it yields only undamaged results of the present code.

Quirk: numba's own cache compares the source file of a kernel, not those of the kernels compiled
into it and of the constants it imports, so that after an upgrade kernels are loaded as they were
before. And it trusts what it reads: after a power failure a process ends with an error of the
reader, or computes with damaged machine code (numba 0.68, `numba.core.caching`). Upstream: the
first is documented, as a limitation of caching; no report of the second is known (2026-11-30).
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import itertools
import logging
import os
import pickle
import types
from collections.abc import Iterable, Iterator
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import Any, Final

import llvmlite
import numba
import numpy as np
from numba.core import caching, config
from numba.core.dispatcher import Dispatcher
from numba.core.extending import _Intrinsic
from numba.core.serialize import dumps

log = logging.getLogger(__name__)

_HEADER: Final = pickle.dumps("checksummed")  # where numba's own cache expects numba's version
_CHECKSUM_BYTES: Final = 32
_STAMP_BYTES: Final = 64
_SCALARS: Final = (bool, int, float, complex, str, bytes, type(None), type(...))
_Entries = dict[Any, tuple[str, bytes]]


class KernelCache(caching.FunctionCache):  # type: ignore[misc]  # numba has no types
    """The cache of one kernel."""

    def __init__(self, kernel: Dispatcher) -> None:
        super().__init__(kernel.py_func)
        self._cache_file = _KernelFiles(Path(self.cache_path), self._impl.filename_base, kernel)

    def holds(self, variants: Iterable[tuple[Any, ...]], codegen: Any) -> bool:
        """Whether all variants can be loaded.

        Args:
            variants: argument types of each.
            codegen: numba's code generator of the kernel's target.

        Returns:
            False where one is missing, damaged, or compiled from other code.
        """
        return self._cache_file.holds([self._index_key(types, codegen) for types in variants])

    def save_overload(self, sig: Any, data: Any) -> None:
        """Write a compiled variant; where that fails, the process goes on with what it has.

        Args:
            sig: its argument types.
            data: the compiled result of numba.
        """
        try:
            super().save_overload(sig, data)
        except OSError as error:
            log.warning("a compiled kernel could not be stored: %s", error)

    def remove_unused(self) -> None:
        """Remove files of this folder and this Python that belong to no kernel of this process."""
        self._cache_file.remove_unused()


class _KernelFiles:
    """Files of one kernel, in the place of numba's `IndexDataCacheFile`.

    The index (.nbi) has a SHA-256 sum of itself and the stamp of the code. It maps keys to names
    and SHA-256 sums of files (.nbc).
    """

    _bases: Final[dict[Path, set[str]]] = {}

    def __init__(self, folder: Path, base: str, kernel: Dispatcher) -> None:
        self._folder = folder
        self._base = base
        self._kernel = kernel
        self._stamp = b""
        self._bases.setdefault(folder, set()).add(base)

    def flush(self) -> None:
        """Empty the index."""
        with self._locked():
            self._write_index({})

    def load(self, key: Any) -> Any | None:
        """What was saved, or None if it is not there, of other code, or damaged."""
        content = self._content(self._entries().get(key))
        return None if content is None else pickle.loads(content)

    def holds(self, keys: Iterable[Any]) -> bool:
        """Whether `load` would yield something for each key."""
        entries = self._entries()
        return all(self._content(entries.get(key)) is not None for key in keys)

    def save(self, key: Any, data: Any) -> None:
        """Write a compiled variant, unless another process was faster."""
        content = dumps(data)
        with self._locked():
            if self.holds([key]):
                return
            entries = self._entries()
            taken = {name for other, (name, _) in entries.items() if other != key}
            numbered = (f"{self._base}.{number}.nbc" for number in itertools.count(1))
            name = next(name for name in numbered if name not in taken)
            _write(self._folder / name, content)
            self._write_index(entries | {key: (name, hashlib.sha256(content).digest())})

    def remove_unused(self) -> None:
        """Remove files of this folder and this Python that belong to no kernel of this process."""
        python = self._base.rpartition(".")[2]
        with self._locked():
            for path in self._folder.glob(f"*.{python}.*"):
                base = path.name.partition(f".{python}.")[0]
                if f"{base}.{python}" not in self._bases[self._folder]:
                    path.unlink(missing_ok=True)

    def _entries(self) -> _Entries:
        """Content of the index; empty if it is not there, of other code, or damaged."""
        try:
            content = (self._folder / f"{self._base}.nbi").read_bytes()
        except OSError:
            return {}
        content = content.removeprefix(_HEADER)
        checksum, content = content[:_CHECKSUM_BYTES], content[_CHECKSUM_BYTES:]
        if checksum != hashlib.sha256(content).digest():
            return {}
        if content[:_STAMP_BYTES] != self._present_stamp():
            return {}
        entries: _Entries = pickle.loads(content[_STAMP_BYTES:])
        return entries

    def _content(self, entry: tuple[str, bytes] | None) -> bytes | None:
        if entry is None:
            return None
        name, checksum = entry
        try:
            content = (self._folder / name).read_bytes()
        except OSError:
            return None
        return content if hashlib.sha256(content).digest() == checksum else None

    def _write_index(self, entries: _Entries) -> None:
        content = self._present_stamp() + dumps(entries)
        checksum = hashlib.sha256(content).digest()
        _write(self._folder / f"{self._base}.nbi", _HEADER + checksum + content)

    def _present_stamp(self) -> bytes:
        if not self._stamp:  # not before all that the kernel calls is defined
            self._stamp = code_stamp(self._kernel).encode()
        return self._stamp

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        """Let no other process change the folder meanwhile; then make sure of what is in it."""
        folder = os.open(self._folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(folder, fcntl.LOCK_EX)  # held as long as two files are written
            yield
            os.fsync(folder)
        finally:
            os.close(folder)


def _write(path: Path, content: bytes) -> None:
    """Write a file that is never seen in part."""
    part = path.with_name(f"{path.name}.part")
    with part.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)


def code_stamp(kernel: Dispatcher) -> str:
    """Hash of what the machine code of a kernel follows from, besides argument types and CPU.

    These are the byte code, constants and options of the kernel and of all kernels compiled into
    it, versions of the compiler's libraries, and the compiler's settings.

    Args:
        kernel: a compiled kernel.

    Returns:
        SHA-256, hexadecimal.

    Raises:
        TypeError: a kernel uses a global value of an unknown type.
    """
    versions = (numba.__version__, llvmlite.__version__, np.__version__)
    found = {kernel: _description(kernel)}
    waiting = [kernel]
    while waiting:
        below = found[waiting.pop()][1] - found.keys()
        found |= {one: _description(one) for one in below}
        waiting += below
    text = repr((compiler_settings(), versions, sorted(text for text, _ in found.values())))
    return hashlib.sha256(text.encode()).hexdigest()


def compiler_settings() -> tuple[Any, ...]:
    """What the environment may change of machine code, besides the processor compiled for.

    Returns:
        Level of optimization, loops and straight code as vectors, checks of bounds
        (NUMBA_OPT, NUMBA_LOOP_VECTORIZE, NUMBA_SLP_VECTORIZE, NUMBA_BOUNDSCHECK).
    """
    return config.OPT, config.LOOP_VECTORIZE, config.SLP_VECTORIZE, config.BOUNDSCHECK


@functools.cache
def _description(
    kernel: Dispatcher | _Intrinsic,
) -> tuple[str, AbstractSet[Dispatcher | _Intrinsic]]:
    """A text of one kernel's own code, values and options, and the kernels that it names."""
    function = _function_of(kernel)
    options = kernel.targetoptions if isinstance(kernel, Dispatcher) else {}
    values = list(_values(function))
    codes = [
        (code.co_code, code.co_names, code.co_varnames, [_text(one) for one in code.co_consts])
        for code in _codes(function.__code__)
    ]
    stated = sorted((name, _text(value)) for name, value in options.items())
    text = repr((_name(function), stated, codes, [_text(value) for value in values]))
    return text, {value for value in values if isinstance(value, (Dispatcher, _Intrinsic))}


def _function_of(kernel: Dispatcher | _Intrinsic) -> types.FunctionType:
    function: Any = kernel.py_func if isinstance(kernel, Dispatcher) else kernel._defn
    assert isinstance(function, types.FunctionType)
    return function


def _values(function: types.FunctionType) -> Iterator[Any]:
    """Global, enclosed and default values that a function uses."""
    for code in _codes(function.__code__):
        yield from (function.__globals__.get(name) for name in code.co_names)
    yield from (cell.cell_contents for cell in function.__closure__ or ())
    yield from function.__defaults__ or ()


def _codes(code: types.CodeType) -> Iterator[types.CodeType]:
    """A function's code and that of all functions in it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _codes(constant)


def _text(value: Any) -> str:
    """A text that is the same in every process and changes with the value."""
    if isinstance(value, _SCALARS):
        return repr(value)
    if isinstance(value, np.generic):
        return f"{value.dtype} {value.item()!r}"
    if isinstance(value, tuple):
        return repr([_text(one) for one in value])
    if isinstance(value, (set, frozenset)):
        return repr(sorted(_text(one) for one in value))
    if isinstance(value, (Dispatcher, _Intrinsic)):
        return _name(_function_of(value))
    if isinstance(value, types.ModuleType):
        return value.__name__
    if isinstance(value, types.CodeType):
        return value.co_name
    if callable(value):  # a type or function of a library
        return _name(value)
    raise TypeError(f"a kernel uses a global value of {type(value)}")


def _name(function: Any) -> str:
    return f"{getattr(function, '__module__', None)}.{function.__qualname__}"
