"""Elementary functions that vectorise; XLA's own, in double precision on CPUs, call a scalar function."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxrock._core.types import Real
from jaxrock.compiler import MacroPrimitive
from jaxrock.compiler.hints import select

# Coefficients in x^2 of sin(x)/x and cos(x): interpolation at Chebyshev points of x^2 in [0, 3.2], errors below 3e-17.
_SINE = (
    1.0,
    -0.16666666666666666,
    0.008333333333333333,
    -0.00019841269841269839,
    2.7557319223985147e-06,
    -2.505210838533317e-08,
    1.6059043826946672e-10,
    -7.647163154737474e-13,
    2.811435579172028e-15,
    -8.215574556373267e-18,
    1.8903369640628947e-20,
)

_COSINE = (
    1.0,
    -0.5,
    0.041666666666666664,
    -0.0013888888888888883,
    2.4801587301585594e-05,
    -2.755731922373684e-07,
    2.0876756965210064e-09,
    -1.1470744273496327e-11,
    4.779427587316425e-14,
    -1.5607589785470306e-16,
    3.95653834291857e-19,
)

# Coefficients of artanh(x)/x in x^2, |x| < 0.1725.
_LOGARITHM = tuple(1 / (2 * k + 1) for k in range(11))

# Coefficients of arctan(x)/x in x^2, |x| < tan(pi/8): interpolation as above, errors below 3e-18.
_ARCTANGENT = (
    1.0,
    -0.3333333333333312,
    0.1999999999994035,
    -0.14285714279197312,
    0.11111110742286896,
    -0.0909089673297879,
    0.0769204396500265,
    -0.06662936116136517,
    0.058467627400560856,
    -0.05034575594522044,
    0.03795171422296338,
    -0.017790395523288063,
)

# The first part has few significant digits, followed by zeros.
_LOGARITHM_OF_2 = (0.6931471803691238, 1.9082149292705877e-10)
_LOGARITHM_OF_2_IN_SINGLE = (0.693359375, -2.1219444005469057e-4)

# Coefficients of exp(x), |x| < 0.347.
_EXPONENTIAL = tuple(1 / math.factorial(k) for k in range(14))


def _horner(coefficients: tuple[float, ...], x: Real) -> Real:
    total = jnp.full_like(x, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        total = total * x + c
    return total


def sine_cosine(x: Real) -> tuple[Real, Real]:
    """Return sine and cosine to rounding for |x| <= 1.78; beyond, the error grows (1e-11 at 3)."""
    sine, cosine = _sine_cosine(x)
    return sine, cosine


def _near(x):
    square = x * x
    return [x * _horner(_SINE, square), _horner(_COSINE, square)]


def _turned(operation, numbers, changes):
    """Return the values and tangents of an operation that gives sine and cosine."""
    (sine, cosine), (moved,) = operation(*numbers), changes
    return [sine, cosine], [cosine * moved, -sine * moved]


_sine_cosine = MacroPrimitive("sine_cosine", _near, _turned, results=2)


@jax.jit
def sine_ratio(x: Real) -> Real:
    """Return sin(x)/x to rounding for |x| <= 1.78."""
    return _horner(_SINE, x * x)


@jax.jit
def sine_lag(x: Real) -> Real:
    """Return (x - sin(x))/x^3 to rounding for |x| <= 1.78."""
    return -_horner(_SINE[1:], x * x)


def sine_cosine_of_any(x: Real) -> tuple[Real, Real]:
    """Return sine and cosine of any angle, as exact as the rounding of the angle allows."""
    sine, cosine = _sine_cosine_of_any(x)
    return sine, cosine


def _anywhere(x):
    half_turns = jnp.round(x * (1 / math.pi))
    sine, cosine = _near((x - half_turns * math.pi) - half_turns * 1.2246467991473532e-16)  # the low part of pi
    sign = 1 - 2 * jnp.abs(half_turns - 2 * jnp.round(half_turns / 2))
    return [sign * sine, sign * cosine]


_sine_cosine_of_any = MacroPrimitive("sine_cosine_of_any", _anywhere, _turned, results=2)


def logarithm(x: Real) -> Real:
    """Return the natural logarithm of a positive normal number, to a few units of rounding."""
    return _logarithm(x)[0]


def _logarithm_written(x):
    info = jnp.finfo(x.dtype)
    one, bias = 1 << info.nmant, info.maxexp - 1
    bits = jax.lax.bitcast_convert_type(x, jnp.int64 if info.bits == 64 else jnp.int32)
    # x = 2^power times a number in [17/24, 17/12), about [1/sqrt 2, sqrt 2).
    power = ((bits + (one // 2 + one // 12)) >> info.nmant) - bias
    part = jax.lax.bitcast_convert_type(bits - power * one, x.dtype)
    ratio = (part - 1) / (part + 1)
    square = ratio * ratio
    return [power.astype(x.dtype) * math.log(2) + 2 * ratio * _horner(_LOGARITHM, square)]


def _logarithm_changed(operation, numbers, changes):
    return operation(*numbers), [changes[0] / numbers[0]]


_logarithm = MacroPrimitive("logarithm", _logarithm_written, _logarithm_changed)


def exponential(x: Real) -> Real:
    """Return exp(x), to a few units of rounding; zero where it would be subnormal."""
    return _exponential(x)[0]


def _exponential_written(x):
    info = jnp.finfo(x.dtype)
    power = jnp.round(jnp.clip(x / math.log(2), info.minexp - 1, info.maxexp))
    # ln 2 in two parts: the products with the first are exact.
    parts = _LOGARITHM_OF_2 if info.bits == 64 else _LOGARITHM_OF_2_IN_SINGLE
    rest = (x - power * parts[0]) - power * parts[1]
    integer = jnp.int64 if info.bits == 64 else jnp.int32

    def power_of_two(k):
        return jax.lax.bitcast_convert_type((k.astype(integer) + info.maxexp - 1) << info.nmant, x.dtype)

    # Two factors: 2^1024 overflows, but exp(709) does not.
    half = jnp.floor(power * 0.5)
    value = _horner(_EXPONENTIAL, rest) * power_of_two(half) * power_of_two(power - half)
    return [select(power < info.minexp, 0.0, select(x > math.log(2) * info.maxexp, jnp.inf, value))]


def _exponential_changed(operation, numbers, changes):
    (value,) = operation(*numbers)
    return [value], [value * changes[0]]


_exponential = MacroPrimitive("exponential", _exponential_written, _exponential_changed)


@jax.jit
def exponential_less_one(x: Real) -> Real:
    """Return exp(x) - 1, to a few units of rounding of the result."""
    x = jnp.asarray(x)
    near = x * _horner(tuple(c / (k + 1) for k, c in enumerate(_EXPONENTIAL)), x)
    return select(jnp.abs(x) < 0.346, near, exponential(x) - 1)


@jax.jit
def logarithm_of_one_and(x: Real) -> Real:
    """Return log(1 + x), to a few units of rounding of the result, where 1 + x is a positive normal number."""
    ratio = x / (2 + x)
    near = 2 * ratio * _horner(_LOGARITHM, ratio * ratio)
    return select((x > -0.29) & (x < 0.41), near, logarithm(1 + x))


@jax.jit
def tangent(x: Real) -> Real:
    """Return tan(x), to a few units of rounding."""
    sine, cosine = sine_cosine_of_any(x)
    return sine / cosine


@jax.jit
def _is_negative(x: Real) -> Bool[Array, "..."]:
    """Return whether the sign is minus, also for negative zero."""
    return (x < 0) | ((x == 0) & (1 / x < 0))


@jax.jit
def arctangent_of(y: Real, x: Real) -> Real:
    """Return the angle of the point (x, y), in [-pi, pi], to a few units of rounding; zeros have signs, as in C."""
    high, wide = jnp.abs(y), jnp.abs(x)
    steep = high > wide
    small, large = select(steep, wide, high), select(steep, high, wide)
    share = select(small == large, select(large > 0, 1.0, 0.0), small / large)
    beyond = share > 0.41421356237309503  # tan(pi/8)
    part = select(beyond, (share - 1) / (share + 1), share)
    angle = part * _horner(_ARCTANGENT, part * part)
    # Each multiple of pi/4 is added with its rounding error.
    angle = select(beyond, (angle + 3.061616997868383e-17) + math.pi / 4, angle)
    angle = select(steep, (6.123233995736766e-17 - angle) + math.pi / 2, angle)
    angle = select(_is_negative(x), (1.2246467991473532e-16 - angle) + math.pi, angle)
    angle = select(jnp.isnan(x) | jnp.isnan(y), jnp.nan, angle)
    return select(_is_negative(y), -angle, angle)


@jax.jit
def arcsine(x: Real) -> Real:
    """Return arcsin(x), to a few units of rounding."""
    return arctangent_of(x, jnp.sqrt((1 - x) * (1 + x)))


@jax.jit
def hyperbolic_arctangent(x: Real) -> Real:
    """Return artanh(x), to a few units of rounding; infinite at the ends."""
    size = jnp.abs(x)
    near = size * _horner(_LOGARITHM, x * x)
    inside = 0.5 * logarithm((1 + size) / (1 - select(size < 1, size, 0.0)))
    far = select(size < 1, inside, select(size == 1, jnp.inf, jnp.nan))
    value = select(size < 0.17, near, far)
    return select(x < 0, -value, value)


@jax.jit
def hyperbolic_arcsine(x: Real) -> Real:
    """Return arsinh(x), to a few units of rounding."""
    size = jnp.abs(x)
    inside = jnp.minimum(size, 1e9)  # beyond, arsinh is log(2 x) to rounding
    root = jnp.sqrt(inside * inside + 1)
    near = hyperbolic_arctangent(jnp.minimum(inside, 0.2) / root)
    finite = select(size < jnp.inf, jnp.maximum(size, 1e9), 1.0)
    far = select(size < jnp.inf, logarithm(select(size < 1e9, inside + root, finite)), jnp.inf)
    far = far + select(size < 1e9, 0.0, math.log(2))
    value = select(size < 0.17, near, far)
    value = select(x < 0, -value, value)
    return select(x == x, value, jnp.nan)


@jax.jit
def hyperbolic_sine(x: Real) -> Real:
    """Return sinh(x), to a few units of rounding."""
    size = jnp.abs(x)
    grown, half = exponential_less_one(jnp.minimum(size, 20.0)), exponential(size / 2)
    # Beyond 20, sinh is half of the exponential, which may overflow where sinh does not.
    value = select(size < 20, 0.5 * (grown + grown / (grown + 1)), 0.5 * half * half)
    return select(x > 0, value, select(x < 0, -value, x))


@jax.jit
def hyperbolic_cosine(x: Real) -> Real:
    """Return cosh(x), to a few units of rounding."""
    half = exponential(jnp.abs(x) / 2)
    return 0.5 * half * half + 0.5 / half / half


@jax.jit
def hyperbolic_tangent(x: Real) -> Real:
    """Return tanh(x), to a few units of rounding."""
    grown = exponential_less_one(2 * jnp.minimum(jnp.abs(x), 30.0))
    return select(x < 0, -grown, grown) / (grown + 2)


def _logarithm_of_any(x, positive=logarithm, border=0):
    """Extend a logarithm of finite numbers beyond its border to all numbers."""
    inside = jnp.where(x > border, jnp.where(x < jnp.inf, positive(x), jnp.inf), -jnp.inf)
    return jnp.where(x >= border, inside, jnp.nan)


# Machine code computes JAX's operations by these.
_IMPLEMENTATIONS: dict[str, Callable] = {
    "exp": exponential,
    "expm1": exponential_less_one,
    "log": _logarithm_of_any,
    "log1p": lambda x: _logarithm_of_any(x, logarithm_of_one_and, -1),
    "sin": lambda x: sine_cosine_of_any(x)[0],
    "cos": lambda x: sine_cosine_of_any(x)[1],
    "tan": tangent,
    "asin": arcsine,
    "atan": lambda x: arctangent_of(x, jnp.ones_like(x)),
    "atan2": arctangent_of,
    "sinh": hyperbolic_sine,
    "cosh": hyperbolic_cosine,
    "tanh": hyperbolic_tangent,
    "asinh": hyperbolic_arcsine,
    "atanh": hyperbolic_arctangent,
}
for _name, _function in _IMPLEMENTATIONS.items():
    MacroPrimitive.implement(_name, _function)
