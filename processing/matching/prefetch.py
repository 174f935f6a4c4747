"""Prefetching of memory that is needed next, during other computations.

A patch is some hundred lines of cache that lie rows apart, which no hardware predicts.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel

Array = NDArray[Any]

_LINE_BYTES = 64


@intrinsic
def _fetch(typing_context: Any, array: Any, row: Any, column: Any) -> Any:
    """Bring the line of cache that holds an element of a (h, w) array; it need not exist."""

    def lower(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = signature.args[0]
        view = context.make_array(kind)(context, builder, arguments[0])
        strides = builder.extract_value(view.strides, 0), builder.extract_value(view.strides, 1)
        offset = builder.add(
            builder.mul(arguments[1], strides[0]), builder.mul(arguments[2], strides[1])
        )
        base = builder.ptrtoint(view.data, offset.type)
        place = builder.inttoptr(builder.add(base, offset), ir.IntType(8).as_pointer())
        int32 = ir.IntType(32)
        prefetch = builder.module.declare_intrinsic(
            "llvm.prefetch",
            [place.type],
            ir.FunctionType(ir.VoidType(), [place.type, int32, int32, int32]),
        )
        builder.call(prefetch, [place, int32(0), int32(3), int32(1)])
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp), lower


@compiled_kernel()
def fetch_ahead(frame: Array, column: int, row: int, columns: int, rows: int) -> None:
    """Begin to bring a box of a frame into the cache; it may lie beyond the frame.

    Args:
        frame: (h, w), rows contiguous.
        column: first column of the box.
        row: first row of the box.
        columns: width of the box, px.
        rows: height of the box, px.
    """
    step = _LINE_BYTES // frame.itemsize
    for r in range(row, row + rows):
        for c in range(column, column + columns, step):
            _fetch(frame, r, c)
        _fetch(frame, r, column + columns - 1)
