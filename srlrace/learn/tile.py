"""The inner loop of a matrix product: a tile of the result stays in registers while its sums run.

Products of matrices as small as a policy's spend their time on loads, stores and calls. Here a tile of C = A B, some
rows of some registers, is held in registers; each term of its sums loads one row of B in whole registers and one number
of A per row, copied to all lanes, and adds their products. Tiles have 16 registers: more independent sums than two
multiply-add units of four cycles' latency need (8), and a load for every other multiply-add.

A sum runs in the order of its terms, whatever the addresses or the alignment: results are the same to the bit.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from srlrace.sim.compile import kernel
from srlrace.sim.vector import REGISTER_BYTES, intrinsic

LANES = REGISTER_BYTES // 4  # of float32
ROWS = 4  # every matrix has room for a multiple of this many rows
VECTORS = 4 if REGISTER_BYTES == 64 else 2  # AVX-512 has 32 registers, its predecessors 16


def _tile(rows: int, vectors: int) -> Any:
    """Return the intrinsic that computes `rows` rows of `vectors` registers; its arguments are those of `product`."""
    register = ir.VectorType(ir.FloatType(), LANES)
    to_all_lanes = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    cells = [(m, v) for m in range(rows) for v in range(vectors)]

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        memory = context.make_array(sig.args[0])(context, builder, args[0]).data
        c, c_row, start, start_row, a, a_row, a_term, b, b_term, terms = args[1:]
        kind = ir.FunctionType(register, [register] * 3)
        multiply_add = cgutils.get_or_insert_function(builder.module, kind, f"llvm.fmuladd.v{LANES}f32")

        def element(first: Any, stride: Any, k: Any, column: int = 0) -> Any:
            index = builder.add(first, builder.mul(stride, k if isinstance(k, ir.Value) else stride.type(k)))
            return builder.gep(memory, [builder.add(index, index.type(column))])

        def lanes(first: Any, stride: Any, k: Any, v: int) -> Any:
            return builder.bitcast(element(first, stride, k, v * LANES), register.as_pointer())

        sums = {cell: cgutils.alloca_once(builder, register) for cell in cells}
        for m, v in cells:
            builder.store(builder.load(lanes(start, start_row, m, v), align=4), sums[m, v])
        with cgutils.for_range(builder, terms) as loop:
            column = builder.add(a, builder.mul(a_term, loop.index))
            row = [builder.load(lanes(b, b_term, loop.index, v), align=4) for v in range(vectors)]
            for m in range(rows):
                number = builder.load(element(column, a_row, m))
                one = builder.insert_element(ir.Constant(register, ir.Undefined), number, ir.IntType(32)(0))
                copies = builder.shuffle_vector(one, one, to_all_lanes)
                for v in range(vectors):
                    builder.store(builder.call(multiply_add, [copies, row[v], builder.load(sums[m, v])]), sums[m, v])
        for m, v in cells:
            builder.store(builder.load(sums[m, v]), lanes(c, c_row, m, v), align=4)
        return context.get_dummy_value()

    def tile(typingctx: Any, memory, c, c_row, start, start_row, a, a_row, a_term, b, b_term, terms):
        return types.none(memory, *[types.intp] * 10), emit

    return intrinsic(tile)


_wide = _tile(ROWS, VECTORS)
_tall = _tile(ROWS * VECTORS, 1)
_small = _tile(ROWS, 1)


@kernel
def product(memory, c, c_row, start, start_row, a, a_row, a_term, b, b_term, terms, rows, width):
    """Compute C[m, n] = start[m, n] + sum over k < terms of A[m, k] B[k, n] for m < rows, n < width.

    All matrices lie in the float32 vector `memory`: `c`, `start`, `a`, `b` are the indices of their first elements,
    `_row` and `_term` the distances between neighbours of that index. A `start_row` of 0 is one row for all, such as a
    bias; start may be C itself. `rows` is rounded up to a multiple of ROWS, `width` of LANES: there must be room.
    """
    n = 0
    while n < width:
        many = width - n >= VECTORS * LANES
        m = 0
        while m < rows:
            to, origin, left, right = c + m * c_row + n, start + m * start_row + n, a + m * a_row, b + n
            if many:
                _wide(memory, to, c_row, origin, start_row, left, a_row, a_term, right, b_term, terms)
                m += ROWS
            elif rows - m >= ROWS * VECTORS:
                _tall(memory, to, c_row, origin, start_row, left, a_row, a_term, right, b_term, terms)
                m += ROWS * VECTORS
            else:
                _small(memory, to, c_row, origin, start_row, left, a_row, a_term, right, b_term, terms)
                m += ROWS
        n += VECTORS * LANES if many else LANES
