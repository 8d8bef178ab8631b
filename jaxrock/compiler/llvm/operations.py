"""Emit JAX's operations on scalars in LLVM IR: vectors of lanes in, one vector out. Needs llvmlite.

Each operation is a function of the emitter, the equation of the jaxpr, and the operands.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from llvmlite import ir

from jaxrock.compiler.jaxpr.form_fma import form_fma
from jaxrock.compiler.primitive.macro import IMPLEMENTATIONS

_BOOL = np.dtype(bool)


class Unsupported(Exception):
    """A jaxpr contains an operation that this backend does not implement."""


def is_float(x) -> bool:
    """Return whether a vector holds floating-point numbers."""
    return isinstance(x.type.element, (ir.DoubleType, ir.FloatType))


def _is_flag(x) -> bool:
    return x.type.element == ir.IntType(1)


def _arithmetic(of_floats: str, of_integers: str):
    def operation(e, _, x, y):
        return getattr(e.b, of_floats if is_float(x) else of_integers)(x, y)

    return operation


def _quotient(of_rest: bool):
    """Return the operation `rem` or `div`; integers follow JAX for a zero divisor and for overflow."""

    def operation(e, equation, x, y):
        if is_float(x):
            return e.each("fmod", x, y) if of_rest else e.b.fdiv(x, y)
        limits = np.iinfo(equation.invars[0].aval.dtype)
        zero, one, least = (e.constant_of(k, x.type) for k in (0, 1, limits.min))
        none = e.b.icmp_signed("==", y, zero)
        huge = e.b.and_(e.b.icmp_signed("==", x, least), e.b.icmp_signed("==", y, e.b.neg(one)))
        # Without the select the processor would trap, even for a lane that is finished.
        divisor = e.b.select(e.b.or_(none, huge), one, y)
        result = e.b.srem(x, divisor) if of_rest else e.b.sdiv(x, divisor)
        return e.b.select(none, x if of_rest else e.b.neg(one), result)

    return operation


def _compare(sign: str):
    def operation(e, _, x, y):
        if is_float(x):
            return e.b.fcmp_unordered(sign, x, y) if sign == "!=" else e.b.fcmp_ordered(sign, x, y)
        return (e.b.icmp_unsigned if _is_flag(x) else e.b.icmp_signed)(sign, x, y)

    return operation


def _is_a_number(x) -> bool:
    """Return whether a vector is constant and holds no NaN."""
    return isinstance(x, ir.Constant) and not any(math.isnan(number.constant) for number in x.constant)


def _extremum(sign: str):
    def operation(e, _, x, y):
        if _is_flag(x):
            return e.b.or_(x, y) if sign == ">" else e.b.and_(x, y)
        if not is_float(x):
            return e.b.select(e.b.icmp_signed(sign, x, y), x, y)
        # NaN propagates from either operand. The ordered comparison and its select are one instruction, which returns
        # the second operand if either is NaN; the last line adds NaN of the first.
        if isinstance(y, ir.Constant):
            x, y = y, x
        first = e.b.select(e.b.fcmp_ordered(sign, x, y), x, y)
        return first if _is_a_number(x) else e.b.select(e.b.fcmp_unordered("uno", x, x), x, first)

    return operation


def _negative(e, _, x):
    return e.b.fneg(x) if is_float(x) else e.b.neg(x)


def _size(e, _, x):
    return e.intrinsic("fabs", x) if is_float(x) else e.b.select(e.b.icmp_signed("<", x, e.b.neg(x)), e.b.neg(x), x)


def _sign(e, equation, x):
    zero, one = (e.constant(c, equation.invars[0].aval.dtype) for c in (0, 1))
    if not is_float(x):
        minus = e.b.select(e.b.icmp_signed("<", x, zero), e.b.neg(one), zero)
        return e.b.select(e.b.icmp_signed(">", x, zero), one, minus)
    # Zeros keep their sign, and NaN stays NaN.
    is_other = e.b.or_(e.b.fcmp_ordered("<", x, zero), e.b.fcmp_ordered(">", x, zero))
    return e.b.select(is_other, e.intrinsic("copysign", one, x), x)


def _positive_power(e, x, exponent: int):
    if exponent == 1:
        return x
    half = _positive_power(e, x, exponent // 2)
    square = e.b.fmul(half, half)
    return e.b.fmul(square, x) if exponent % 2 else square


def _power(e, equation, x):
    exponent = equation.params["y"]
    if not is_float(x):
        raise Unsupported(f"power {exponent} of whole numbers")
    if exponent == 0:
        return e.constant(1, equation.invars[0].aval.dtype)
    power = _positive_power(e, x, abs(exponent))
    return power if exponent > 0 else e.b.fdiv(e.constant(1, equation.invars[0].aval.dtype), power)


def _convert(e, equation, x):
    old, new = equation.invars[0].aval.dtype, np.dtype(equation.params["new_dtype"])
    if old == new:
        return x
    kind, b = e.vector(new), e.b
    if new == _BOOL:
        return _compare("!=")(e, equation, x, e.constant(0, old))
    if old == _BOOL:
        return b.uitofp(x, kind) if new.kind == "f" else b.zext(x, kind)
    if old.kind == new.kind == "f":
        return b.fpext(x, kind) if new.itemsize > old.itemsize else b.fptrunc(x, kind)
    if old.kind == new.kind == "i":
        return b.sext(x, kind) if new.itemsize > old.itemsize else b.trunc(x, kind)
    return b.sitofp(x, kind) if new.kind == "f" else _to_integer(e, x, np.iinfo(new), old, kind)


def _to_integer(e, x, limits, dtype, kind):
    """Emit the conversion to an integer as in JAX: towards zero, saturating, and NaN becomes zero."""
    low, high = (e.constant(limit, dtype) for limit in (limits.min, limits.max))
    inside = e.b.and_(e.b.fcmp_ordered(">=", x, low), e.b.fcmp_ordered("<", x, high))
    whole = e.b.fptosi(e.b.select(inside, x, e.constant(0, dtype)), kind)
    limited = e.b.select(
        e.b.fcmp_ordered("<", x, low), e.constant_of(limits.min, kind), e.constant_of(limits.max, kind)
    )
    known = e.b.fcmp_ordered("ord", x, x)
    return e.b.select(inside, whole, e.b.select(known, limited, e.constant_of(0, kind)))


def _shift(name: str):
    """Return a shift that is defined for any number of bits; LLVM leaves it undefined from the width on.

    Then, and for negative numbers of bits, an arithmetic right shift leaves the sign, and a left shift leaves zero.
    """

    def operation(e, _, x, y):
        width = x.type.element.width
        inside = e.b.icmp_unsigned("<", y, e.constant_of(width, y.type))
        if name == "ashr":
            return e.b.ashr(x, e.b.select(inside, y, e.constant_of(width - 1, y.type)))
        return e.b.select(inside, e.b.shl(x, y), e.constant_of(0, x.type))

    return operation


def _choose(e, _, which, *cases):
    if _is_flag(which):
        return e.b.select(which, cases[1], cases[0])
    found = cases[0]
    for place, case in enumerate(cases[1:], 1):
        found = e.b.select(e.b.icmp_signed(">=", which, e.constant_of(place, which.type)), case, found)
    return found


def _next(e, equation, x, y):
    """Emit `nextafter`: the next floating-point number from x towards y."""
    dtype = equation.invars[0].aval.dtype
    zero, least = e.constant(0, dtype), e.constant(np.finfo(dtype).smallest_subnormal, dtype)
    bits = e.b.bitcast(x, e.vector(np.dtype(f"i{dtype.itemsize}")))
    one = e.constant_of(1, bits.type)
    grows = e.b.xor(e.b.fcmp_ordered("<", x, y), e.b.fcmp_ordered("<", x, zero))
    moved = e.b.bitcast(e.b.select(grows, e.b.add(bits, one), e.b.sub(bits, one)), x.type)
    moved = e.b.select(e.b.fcmp_ordered("==", x, zero), e.intrinsic("copysign", least, y), moved)
    moved = e.b.select(e.b.fcmp_ordered("==", x, y), y, moved)
    return e.b.select(e.b.fcmp_unordered("uno", x, y), e.b.fadd(x, y), moved)


def _any_power(e, equation, x, y):
    """Emit x^y: by the C library's `pow`, or by exp(y log x) for a constant y that is no integer.

    The relative rounding error of the latter grows with |y log x|.
    """
    if not is_float(y) or not isinstance(y, ir.Constant):
        return e.each("pow", x, y) if is_float(y) else e.each("pow", x, e.b.sitofp(y, x.type))
    exponent = y.constant[0].constant
    if not math.isfinite(exponent) or exponent == round(exponent) or not {"exp", "log"} <= set(IMPLEMENTATIONS):
        return e.each("pow", x, y)
    exponential, logarithm = IMPLEMENTATIONS["exp"], IMPLEMENTATIONS["log"]
    return _by(lambda x, y: exponential(y * logarithm(jnp.where(x == -jnp.inf, jnp.inf, x))))(e, equation, x, y)


def _round(e, equation, x):
    to_even = equation.params["rounding_method"] == jax.lax.RoundingMethod.TO_NEAREST_EVEN
    return e.intrinsic("rint" if to_even else "round", x)


def _is_finite(e, equation, x):
    return e.b.fcmp_ordered("<", e.intrinsic("fabs", x), e.constant(math.inf, equation.invars[0].aval.dtype))


def _by(function: Callable):
    """Return an operation composed of others, as one call of a scalar library function per lane would be slow."""

    def operation(e, equation, *values):
        like = [jax.ShapeDtypeStruct((), v.aval.dtype) for v in equation.invars]
        (result,) = e.run(form_fma(jax.make_jaxpr(function)(*like)), list(values), None)
        return result

    return operation


def multiply_add(e, x, y, z):
    """Emit x y + z of floating-point numbers, rounded once if the processor has that instruction."""
    return e.intrinsic("fmuladd", x, y, z)


def _polynomial(e, equation, x, *coefficients):
    """Emit `polynomial` of JAX 0.12 and later, which interpolants use; coefficients start at the lowest degree."""
    *lower, found = coefficients
    for each in reversed(lower):
        found = multiply_add(e, found, x, each)
    return found


def _multiply_add(e, equation, x, y, z):
    """Emit a product and a sum that `form_fma` has joined."""
    x = e.b.fneg(x) if equation.params["minus"] else x
    return multiply_add(e, x, y, e.b.fneg(z) if equation.params["less"] else z)


OPERATIONS: dict[str, Callable] = {
    "add": _arithmetic("fadd", "add"),
    "add_any": _arithmetic("fadd", "add"),
    "sub": _arithmetic("fsub", "sub"),
    "mul": _arithmetic("fmul", "mul"),
    "div": _quotient(of_rest=False),
    "rem": _quotient(of_rest=True),
    "min": _extremum("<"),
    "max": _extremum(">"),
    "clamp": lambda e, q, low, x, high: _extremum("<")(e, q, _extremum(">")(e, q, x, low), high),
    "neg": _negative,
    "abs": _size,
    "sign": _sign,
    "square": lambda e, q, x: _arithmetic("fmul", "mul")(e, q, x, x),
    "macro_multiply_add": _multiply_add,
    "integer_pow": _power,
    "pow": _any_power,
    "polynomial": _polynomial,
    "nextafter": _next,
    "sqrt": lambda e, _, x: e.intrinsic("sqrt", x),
    "rsqrt": lambda e, q, x: e.b.fdiv(e.constant(1, q.invars[0].aval.dtype), e.intrinsic("sqrt", x)),
    "floor": lambda e, _, x: e.intrinsic("floor", x),
    "ceil": lambda e, _, x: e.intrinsic("ceil", x),
    "round": _round,
    "is_finite": _is_finite,
    "one_minus_square": _by(lambda x: (1 - x) * (1 + x)),  # JAX 0.11 and later, in derivatives
    "lt": _compare("<"),
    "le": _compare("<="),
    "gt": _compare(">"),
    "ge": _compare(">="),
    "eq": _compare("=="),
    "ne": _compare("!="),
    "and": lambda e, _, x, y: e.b.and_(x, y),
    "or": lambda e, _, x, y: e.b.or_(x, y),
    "xor": lambda e, _, x, y: e.b.xor(x, y),
    "not": lambda e, _, x: e.b.not_(x),
    "shift_left": _shift("shl"),
    "shift_right_arithmetic": _shift("ashr"),
    "select_n": _choose,
    "convert_element_type": _convert,
    "materialize": lambda e, _, value, witness: value,  # a register value is never recomputed
    "supports_divergence": lambda e, *_: e.constant(True, bool),
    "opaque_one": lambda e, q, _: e.constant(1, q.outvars[0].aval.dtype),
    "bitcast_convert_type": lambda e, q, x: e.b.bitcast(x, e.vector(q.params["new_dtype"])),
}

# Operations that return their operand unchanged.
NOTHING = ("stop_gradient", "stop_gradient_of_tree", "custom_tangent", "copy", "divergent", "reshard", "pvary", "pcast")


OPERATIONS |= dict.fromkeys(NOTHING, lambda e, _, x: x)


# Reductions along axes of an array, each by its operation on two elements.
SUMS = {"reduce_" + name: OPERATIONS[name] for name in ("min", "max", "and", "or")} | {"reduce_sum": OPERATIONS["add"]}


def operation_of(name: str) -> Callable | None:
    """Return the function that emits an operation of JAX; None if this backend does not implement it."""
    if name not in OPERATIONS and name in IMPLEMENTATIONS:
        OPERATIONS[name] = _by(IMPLEMENTATIONS[name])
    return OPERATIONS.get(name)
