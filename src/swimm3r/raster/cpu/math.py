"""Scalar functions that LLVM can vectorize across pixels, and the flags the kernels need for that.

libm's exp2 and log2 are calls and stop the vectorizer, so both are polynomials here
(docs/derivations/raster-kernels.md), good to 3e-7 with float32's rounding. `contract` and the no-NaN flags are on
everywhere, but `reassoc` only for the sums of the adjoint: both passes must round alike to take the same decisions.
"""

from typing import Any, no_type_check

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

FLAGS = {"nnan", "ninf", "nsz", "arcp", "contract"}
inlined = njit(fastmath=FLAGS, error_model="numpy", forceinline=True)
"""For what ends up inside a kernel; not cached by itself. Inlined without exception: a call that is left would run the
function's own code in the process that compiles it, and the kernel's copy, rounded otherwise, where Numba's cache is
read."""

MAGIC = np.float32(12582912.0)  # 1.5 * 2^23: adding it leaves the rounded integer in the low bits
LOWEST_EXPONENT = np.float32(-80.0)  # deeper would be denormal after a product, which costs a microcode assist
MANTISSA_SHIFT = np.int32(23)
TWO_THIRDS = np.int32(0x3F2AAAAB)  # mantissas are taken from [2/3, 4/3), centerd on 1
ONE = np.float32(1.0)

# 2^f on [-1/2, 1/2]
E5, E4, E3, E2, E1 = (
    np.float32(v) for v in (1.340041625e-3, 9.666372967e-3, 5.550333232e-2, 2.402234895e-1, 6.931471955e-1)
)
# log2(1 + r) / r on [-1/3, 1/3], highest power first
L8, L7, L6, L5, L4, L3, L2, L1, L0 = (
    np.float32(v)
    for v in (
        2.082414621e-1, -2.222219405e-1, 2.005869670e-1, -2.367863729e-1, 2.887955120e-1, -3.607895776e-1,
        4.808941010e-1, -7.213465411e-1, 1.442695053,
    )
)  # fmt: skip


@no_type_check
@intrinsic
def bits(typingctx: Any, x: Any) -> Any:
    """The bit pattern of a float32."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.IntType(32))

    return types.int32(types.float32), generate


@no_type_check
@intrinsic
def from_bits(typingctx: Any, i: Any) -> Any:
    """The float32 of a bit pattern."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.FloatType())

    return types.float32(types.int32), generate


@no_type_check
@intrinsic
def prefetch(typingctx: Any, array: Any, row: Any) -> Any:
    """Ask for one row of a float32 matrix ahead of its use."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        columns = builder.extract_value(args[0], 5)  # of (meminfo, parent, items, item size, data, shape, strides)
        columns = builder.extract_value(columns, 1)
        address = builder.gep(data, [builder.mul(builder.sext(args[1], columns.type), columns)])
        byte_pointer, i32 = ir.IntType(8).as_pointer(), ir.IntType(32)
        name = "llvm.prefetch.p0"
        function = builder.module.globals.get(name) or ir.Function(
            builder.module, ir.FunctionType(ir.VoidType(), [byte_pointer, i32, i32, i32]), name
        )
        builder.call(function, [builder.bitcast(address, byte_pointer), i32(0), i32(3), i32(1)])
        return context.get_dummy_value()

    return types.void(array, types.int32), generate


@no_type_check
@intrinsic
def full_width_vectors(typingctx: Any) -> Any:
    """Let LLVM use 512-bit registers in the function that calls this; by itself it holds back on many CPUs."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        # llvmlite's own `add` knows the attributes without a value only
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.void(), generate


@no_type_check
@intrinsic
def any_positive(typingctx: Any, array: Any, first: Any) -> Any:
    """Return whether any of the 16 values of a float32 array from `first` on is above 0."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        sixteen = ir.VectorType(ir.FloatType(), 16)
        address = builder.bitcast(builder.gep(data, [args[1]]), sixteen.as_pointer())
        above = builder.fcmp_ordered(">", builder.load(address, align=4), ir.Constant(sixteen, [0.0] * 16))
        return builder.icmp_unsigned("!=", builder.bitcast(above, ir.IntType(16)), ir.IntType(16)(0))

    return types.boolean(array, types.uintp), generate


@no_type_check
@intrinsic
def lowest_bit(typingctx: Any, i: Any) -> Any:
    """Place of the lowest bit that is set in an int32 other than 0."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.IntType(1)(1))

    return types.int32(types.int32), generate


@no_type_check
@inlined
def minimum(a, b):
    """Smaller of two."""
    return a if a < b else b


@no_type_check
@inlined
def maximum(a, b):
    """Larger of two."""
    return a if a > b else b


@no_type_check
@inlined
def select(condition, a, b):
    """a where the condition holds, else b."""
    return a if condition else b


@no_type_check
@inlined
def vec3(x, y, z):
    """Three channels."""
    return x, y, z


@no_type_check
@inlined
def ordered(x):
    """An integer of each float32 that sorts as the floats do: LLVM has no vectors for the least of floats."""
    i = bits(x)
    return np.int32(i ^ ((i >> np.int32(31)) & np.int32(0x7FFFFFFF)))


@no_type_check
@inlined
def disordered(i):
    """The float32 of such an integer."""
    return from_bits(np.int32(i ^ ((i >> np.int32(31)) & np.int32(0x7FFFFFFF))))


@no_type_check
@inlined
def exp2_near_zero(x):
    """2^x for |x| <= 1/2."""
    x2 = x * x
    return ((E5 * x + E4) * x2 + (E3 * x + E2)) * x2 + (E1 * x + ONE)


@no_type_check
@inlined
def exp2(x):
    """2^x for x < 127."""
    x = maximum(x, LOWEST_EXPONENT)
    shifted = x + MAGIC
    power = exp2_near_zero(x - (shifted - MAGIC))  # kept by LLVM because `reassoc` is off
    return from_bits(np.int32(bits(power) + np.int32(bits(shifted) << MANTISSA_SHIFT)))


@no_type_check
@inlined
def log2(x):
    """log2 x for positive normal x."""
    i = bits(x)
    exponent = np.int32(np.int32(i - TWO_THIRDS) >> MANTISSA_SHIFT)
    r = from_bits(np.int32(i - np.int32(exponent << MANTISSA_SHIFT))) - ONE
    r2 = r * r
    r4 = r2 * r2
    low = (L3 * r + L2) * r2 + (L1 * r + L0)
    high = (L7 * r + L6) * r2 + (L5 * r + L4)
    series = (L8 * r4 + high) * r4 + low
    return np.float32(exponent) + r * series
