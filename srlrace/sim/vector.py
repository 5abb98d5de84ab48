"""SIMD values for numba kernels: arithmetic on several drones in one machine register.

LLVM's loop vectoriser gives up on loop bodies of several hundred operations, as an RK4 step is, and leaves them
scalar. Here a value *is* a vector of lanes (LLVM's ``<16 x float>``), so the equations are written once, with
+, -, *, /, sqrt, min and max, and every operation is one packed instruction. A lane's result never depends
on another lane: neither its value nor its being non-finite.

Plain numbers mix with vectors freely: they are converted to the vector's element type and copied to all lanes.
"""

from __future__ import annotations

import math
import operator
from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir
from numba import extending, types
from numba.core import cgutils
from numba.core.errors import TypingError
from numba.core.typeconv import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, lower_cast, models, register_model

intrinsic: Any = extending.intrinsic  # its functions are called without the typing context they declare


def register_bytes() -> int:
    """Width of the host's widest floating-point registers."""
    features = llvm.get_host_cpu_features()
    return 64 if features.get("avx512f") else 32 if features.get("avx") else 16


REGISTER_BYTES = register_bytes()


class VectorType(types.Type):
    """Numba type of a vector: `lanes` values of the float type `element`."""

    def __init__(self, element: types.Float) -> None:
        self.element = element
        self.lanes = 8 * REGISTER_BYTES // element.bitwidth
        super().__init__(name=f"vector<{self.lanes} x {element}>")

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        """Let numba accept plain numbers where a vector is expected."""
        return Conversion.safe if isinstance(other, types.Number) else None


@register_model(VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, vector: VectorType) -> None:
        super().__init__(manager, vector, ir.VectorType(manager.lookup(vector.element).get_value_type(), vector.lanes))


def _broadcast(builder: Any, value: Any, lanes: int) -> Any:
    one = builder.insert_element(ir.Constant(ir.VectorType(value.type, lanes), ir.Undefined), value, ir.IntType(32)(0))
    return builder.shuffle_vector(one, one, ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes))


def _suffix(vector: Any) -> str:
    """How LLVM's intrinsic functions spell a vector type."""
    return f"v{vector.count}f{32 if isinstance(vector.element, ir.FloatType) else 64}"


def _call(builder: Any, name: str, result: Any, args: Any) -> Any:
    kind = ir.FunctionType(result, [arg.type for arg in args])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), args)


@lower_cast(types.Number, VectorType)
def _number_to_vector(context: Any, builder: Any, source: Any, target: VectorType, value: Any) -> Any:
    return _broadcast(builder, context.cast(builder, value, source, target.element), target.lanes)


class _Arithmetic(AbstractTemplate):
    def generic(self, args: Any, keywords: Any) -> Any:
        vectors = [arg for arg in args if isinstance(arg, VectorType)]
        if not vectors or keywords or any(vector != vectors[0] for vector in vectors):
            return None
        return signature(vectors[0], *[vectors[0]] * len(args))


def _operation(function: Any, arity: int, emit: Any) -> None:
    """Let numba translate `function` of vectors with `emit(builder, *values)`."""
    infer_global(function)(type(f"_Vector_{function.__name__}", (_Arithmetic,), {}))

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return emit(builder, *args)

    lower_builtin(function, *[VectorType] * arity)(lower)


def _minimum(builder: Any, a: Any, b: Any) -> Any:
    # An ordered comparison is false where either is NaN, so the result is `b`: exactly the packed min instruction.
    return builder.select(builder.fcmp_ordered("<", a, b), a, b)


def _maximum(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered(">", a, b), a, b)


def _square_root(builder: Any, a: Any) -> Any:
    return _call(builder, f"llvm.sqrt.{_suffix(a.type)}", a.type, [a])


_operation(operator.add, 2, ir.IRBuilder.fadd)
_operation(operator.sub, 2, ir.IRBuilder.fsub)
_operation(operator.mul, 2, ir.IRBuilder.fmul)
_operation(operator.truediv, 2, ir.IRBuilder.fdiv)
_operation(operator.neg, 1, ir.IRBuilder.fneg)
_operation(min, 2, _minimum)
_operation(max, 2, _maximum)
_operation(math.sqrt, 1, _square_root)


def _vector_of(array: Any) -> VectorType:
    """Vector type for the elements of `array`, whose rows must lie packed in memory."""
    if not isinstance(array, types.Array) or array.layout != "C" or array.ndim != 2:
        raise TypingError(f"vectors are loaded from and stored to C-contiguous matrices, not {array}")
    if array.dtype not in (types.float32, types.float64):
        raise TypingError(f"vectors hold float32 or float64, not {array.dtype}")
    return VectorType(array.dtype)


def _address(context: Any, builder: Any, array_type: Any, array: Any, row: Any, column: Any, vector: Any) -> Any:
    view = context.make_array(array_type)(context, builder, array)
    width = builder.extract_value(view.shape, 1)
    element = builder.gep(view.data, [builder.add(builder.mul(row, width), column)])
    return builder.bitcast(element, vector.as_pointer())


def _mask(builder: Any, count: Any, lanes: int) -> Any:
    indices = ir.Constant(ir.VectorType(count.type, lanes), list(range(lanes)))
    return builder.icmp_signed("<", indices, _broadcast(builder, count, lanes))


@intrinsic
def lanes(typingctx: Any, array: Any) -> Any:
    """Lanes of a vector with the float type of `array`."""
    count = _vector_of(array).lanes
    return signature(types.intp, array), lambda context, builder, sig, args: context.get_constant(types.intp, count)


@intrinsic
def load(typingctx: Any, array: Any, row: Any, column: Any, count: Any) -> Any:
    """Vector of `array[row, column : column + lanes]`; lanes from `count` on are not read and hold 0."""
    vector = _vector_of(array)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value_type = context.get_value_type(vector)
        block, first_row, first_column, left = args
        pointer = _address(context, builder, sig.args[0], block, first_row, first_column, value_type)
        mask = _mask(builder, left, vector.lanes)
        align = ir.IntType(32)(vector.element.bitwidth // 8)
        zeros = ir.Constant(value_type, [0.0] * vector.lanes)
        return _call(builder, f"llvm.masked.load.{_suffix(value_type)}.p0", value_type, [pointer, align, mask, zeros])

    return signature(vector, array, types.intp, types.intp, types.intp), lower


@intrinsic
def store(typingctx: Any, array: Any, row: Any, column: Any, count: Any, value: Any) -> Any:
    """Write `value` to `array[row, column : column + lanes]`; lanes from `count` on are left alone."""
    if value != _vector_of(array):
        raise TypingError(f"cannot store {value} in {array}")

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        block, first_row, first_column, left, content = args
        value_type = content.type
        pointer = _address(context, builder, sig.args[0], block, first_row, first_column, value_type)
        mask = _mask(builder, left, value.lanes)
        align = ir.IntType(32)(value.element.bitwidth // 8)
        _call(builder, f"llvm.masked.store.{_suffix(value_type)}.p0", ir.VoidType(), [content, pointer, align, mask])
        return context.get_dummy_value()

    return signature(types.none, array, types.intp, types.intp, types.intp, value), lower
