"""The cache of compiled kernels: what is of other code or damaged is compiled again."""

from __future__ import annotations

import importlib
import logging
import pickle
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numba import types
from numba.core import caching
from numba.core.extending import intrinsic

from processing.image import kernel_cache
from processing.image.compiled_kernel import compiled_kernel
from processing.image.kernel_cache import _KernelFiles, code_stamp

CALLEE = """from processing.image.compiled_kernel import compiled_kernel

OFFSET = 0.25


@compiled_kernel()
def scaled(x):
    return 0.5 * x
"""
CALLER = """import numpy as np

from callee import OFFSET, scaled
from processing.image.compiled_kernel import compiled_kernel


@compiled_kernel()
def shifted(x):
    return scaled(x) + OFFSET
"""
Load = Callable[[], Any]


@pytest.fixture
def load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Load]:
    """Imports the caller as a process of its own would."""
    (tmp_path / "callee.py").write_text(CALLEE)
    (tmp_path / "caller.py").write_text(CALLER)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)

    def loaded() -> Any:
        for name in ("callee", "caller"):
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        return importlib.import_module("caller").shifted

    yield loaded
    for name in ("callee", "caller"):
        sys.modules.pop(name, None)


def is_stored(kernel: Any) -> bool:
    found: bool = kernel._cache.holds([(types.float64,)], kernel.targetctx.codegen())
    return found


def misses(kernel: Any) -> int:
    return sum(kernel.stats.cache_misses.values())


def test_a_kernel_is_loaded_while_its_code_is_the_same(load: Load, tmp_path: Path) -> None:
    assert load()(4.0) == 2.25
    (tmp_path / "callee.py").write_text(CALLEE + "\n# A remark changes nothing.\n")
    kernel = load()
    assert is_stored(kernel)
    assert kernel(4.0) == 2.25 and misses(kernel) == 0


@pytest.mark.parametrize(
    ("before", "after", "result"),
    [
        ("0.5 * x", "8.5 * x", 34.25),
        ("0.5 * x", "x - x / 4.0", 3.25),
        ("OFFSET = 0.25", "OFFSET = 0.75", 2.75),
        ("OFFSET = 0.25", "OFFSET = np.float32(0.75)", 2.75),
        ("compiled_kernel()", "compiled_kernel(fastmath=True)", 2.25),
    ],
)
def test_a_kernel_is_compiled_again_when_another_file_changed(
    load: Load, tmp_path: Path, before: str, after: str, result: float
) -> None:
    assert load()(4.0) == 2.25
    (tmp_path / "callee.py").write_text("import numpy as np\n" + CALLEE.replace(before, after))
    kernel = load()
    assert not is_stored(kernel)
    assert kernel(4.0) == result and misses(kernel) == 1
    assert is_stored(load())


def truncated(content: bytes) -> bytes:
    return content[: len(content) // 2]


def emptied(_: bytes) -> bytes:
    return b""


def flipped(content: bytes) -> bytes:
    """One bit of the last quarter."""
    place = 3 * len(content) // 4
    return content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :]


def zeroed(content: bytes) -> bytes:
    return bytes(len(content))


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
@pytest.mark.parametrize("damage", [truncated, emptied, flipped, zeroed, None])
def test_a_damaged_kernel_is_compiled_again(
    load: Load, tmp_path: Path, suffix: str, damage: Callable[[bytes], bytes] | None
) -> None:
    assert load()(4.0) == 2.25
    (path,) = (tmp_path / "cache").rglob(f"caller.*{suffix}")
    if damage is None:
        path.unlink()
    else:
        path.write_bytes(damage(path.read_bytes()))
    kernel = load()
    assert not is_stored(kernel)
    assert kernel(4.0) == 2.25 and misses(kernel) == 1
    assert is_stored(load())


def test_a_compiled_file_of_another_variant_is_not_loaded(load: Load, tmp_path: Path) -> None:
    kernel = load()
    assert kernel(4.0) == 2.25 and kernel(np.float32(4.0)) == 2.25
    first, second = sorted((tmp_path / "cache").rglob("caller.*.nbc"))
    first.write_bytes(second.read_bytes())
    kernel = load()
    assert kernel(4.0) == 2.25 and misses(kernel) == 1


def test_an_index_of_the_compiler_itself_and_ours_are_no_index_to_each_other(
    load: Load, tmp_path: Path
) -> None:
    kernel = load()
    kernel(4.0)
    (index,) = (tmp_path / "cache").rglob("caller.*.nbi")
    files = caching.IndexDataCacheFile(str(index.parent), index.name.removesuffix(".nbi"), "stamp")
    assert files._load_index() == {}
    files._save_index({"key": "name"})
    assert not is_stored(load())


def test_a_kernel_that_cannot_be_stored_is_computed_all_the_same(
    load: Load, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(kernel_cache, "_write", full)
    with caplog.at_level(logging.WARNING):
        assert load()(4.0) == 2.25
    assert "could not be stored: [Errno 28]" in caplog.text


def test_files_of_no_kernel_are_removed(load: Load, tmp_path: Path) -> None:
    load()(4.0)
    (used,) = (tmp_path / "cache").rglob("caller.*.nbi")
    renamed = used.with_name(used.name.replace("-7.", "-99."))
    assert renamed != used
    foreign = used.with_name("caller.shifted-7.py39.nbi")
    for path in (renamed, renamed.with_suffix(".1.nbc"), foreign):
        path.write_bytes(b"old")
    before = set(used.parent.iterdir())
    load()._cache.remove_unused()
    assert before - set(used.parent.iterdir()) == {renamed, renamed.with_suffix(".1.nbc")}


def test_processes_that_store_variants_at_once_lose_none(tmp_path: Path) -> None:
    @compiled_kernel()
    def kernel(x: float) -> float:
        return x

    def store(first: int) -> None:
        files = _KernelFiles(tmp_path, "kernel-1.py3", kernel)
        for key in range(first, first + 20):
            files.save(key, -key)

    threads = [threading.Thread(target=store, args=(first,)) for first in (0, 20, 40)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    files = _KernelFiles(tmp_path, "kernel-1.py3", kernel)
    assert [files.load(key) for key in range(60)] == [-key for key in range(60)]
    assert len(list(tmp_path.glob("*.nbc"))) == 60


def test_nothing_damaged_is_unpickled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = _KernelFiles(tmp_path, "kernel-1.py3", compiled_kernel()(truncated))
    files.save("key", 1)
    for path in tmp_path.iterdir():
        path.write_bytes(flipped(path.read_bytes()))
    monkeypatch.setattr(pickle, "loads", None)
    assert files.load("key") is None and not files.holds(["key"])


def test_a_stamp_covers_functions_that_emit_machine_code_and_enclosed_values() -> None:
    def stamp(offset: int) -> str:
        @intrinsic
        def emitted(typing_context: Any, value: Any) -> Any:
            def lower(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
                return arguments[offset]

            return value(value), lower

        @compiled_kernel()
        def kernel(x: float) -> Any:
            return emitted(x)

        return code_stamp(kernel)

    assert stamp(0) == stamp(0) != stamp(1)


def test_a_value_that_no_stamp_describes_is_refused() -> None:
    table: Any = ModuleType("table"), {"a": 1}

    @compiled_kernel()
    def kernel() -> Any:
        return table

    with pytest.raises(TypeError, match="global value of <class 'dict'>"):
        code_stamp(kernel)
