"""The decorator of every compiled kernel: no option depends on who compiles it first.

Quirk: numba lets a function that does not state `fastmath` or `error_model` inherit both from the
caller for which it is compiled, and caches what results for all others. The same source then made
other pixels, by last bits, depending on the order of compilation (numba 0.62, `Flags`,
`inherit_if_not_set`). Upstream: no report known (2026-11-28).
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Set as AbstractSet
from typing import Any

# Here and nowhere else.
from numba import njit
from numba.core.dispatcher import Dispatcher

from processing.image.kernel_cache import KernelCache


def compiled_kernel(
    *,
    fastmath: bool | AbstractSet[str] = False,
    error_model: str = "python",
    **options: Any,
) -> Any:
    """Decorate a function that numba compiles, caches on disk and runs without the GIL.

    Args:
        fastmath: relaxations of floating-point arithmetic, by LLVM's names, or all or none.
        error_model: "python" raises at a division by zero, "numpy" yields an infinity.
        options: further options of `numba.njit`, such as `parallel` and `inline`.

    Returns:
        The decorator.

    Example (in a module; numba caches no function of an interactive session)::

        @compiled_kernel()
        def twice(x):
            return 2.0 * x
    """
    compiled = njit(nogil=True, fastmath=fastmath, error_model=error_model, **options)

    def decorated(function: Callable[..., Any]) -> Any:
        kernel = compiled(function)
        if isinstance(kernel, Dispatcher):  # not with NUMBA_DISABLE_JIT=1
            kernel._cache = KernelCache(kernel)  # type: ignore[attr-defined]
        return kernel

    return decorated
