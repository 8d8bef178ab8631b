"""Polynomials on [0, 1] as lists of coefficients, and their first sign change, certified.

A list entry is a scalar (or, under vmap, one per lane). An operation on all coefficients of a list is one JAX primitive
(`compound`), which is expanded at lowering.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxrock._core.types import Flag, Scalar
from jaxrock.compiler import MacroPrimitive, custom_tangent
from jaxrock.compiler.hints import materialize, select


def rescaled(coefficients: list[Scalar], length: Scalar) -> list[Scalar]:
    """Return the coefficients in x/length from those in x."""
    return _rescaled(length, *coefficients)


def _rescaled_written(length, *coefficients):
    scaled, power = [coefficients[0]], length
    for c in coefficients[1:]:
        scaled.append(c * power)
        power = power * length
    return scaled


_rescaled = MacroPrimitive("rescaled", _rescaled_written, results=lambda count: count - 1)


def _polynomial(x, *coefficients, derivatives: int):
    """Return value and derivatives; derivatives above the degree are zero."""
    *lower, first = coefficients or [jnp.zeros_like(x)]
    values = [first]
    for c in reversed(lower):
        higher = [value * x for value in values]
        values = [higher[0] + c, *(a + b for a, b in zip(higher[1:], values)), *values[-1:]][: derivatives + 1]
    values = [math.factorial(j) * value if j > 1 else value for j, value in enumerate(values)]
    return values + [jnp.zeros_like(first)] * (derivatives + 1 - len(values))


def _polynomial_changed(polynomial, numbers, changes, derivatives: int):
    (x, *coefficients), (moved, *others) = numbers, changes
    still = moved is None
    values = polynomial(x, *coefficients, derivatives=derivatives if still else derivatives + 1)
    change = [0.0] * (derivatives + 1) if still else [moved * slope for slope in values[1:]]
    while others and others[-1] is None:
        others.pop()
    if others:
        others = [jnp.zeros_like(c) if d is None else d for c, d in zip(coefficients, others)]
        own = polynomial(x, *others, derivatives=derivatives)
        change = own if still else [a + b for a, b in zip(change, own)]
    values = values[: derivatives + 1]
    return values, change


polynomial = MacroPrimitive("polynomial", _polynomial, _polynomial_changed, lambda _, derivatives: derivatives + 1)


def jet(coefficients: list[Scalar], x: Scalar, derivatives: int) -> list[Scalar]:
    """Return value and the first derivatives of a polynomial at x."""
    return polynomial(x, *coefficients, derivatives=derivatives)


def _total(terms: list) -> Any:
    """Sum the terms from the middle outwards.

    In products of series the outer terms are computed last, and the sum of the others need not wait for them.
    """
    middle = (len(terms) - 1) / 2
    first, *rest = sorted(range(len(terms)), key=lambda place: abs(place - middle))
    return sum((terms[place] for place in rest), start=terms[first])


def _sum_of_products(*factors):
    half = len(factors) // 2
    return [_total([a * b for a, b in zip(factors[:half], factors[half:])])]


def _sum_of_products_changed(operation, numbers, changes):
    half, moved = len(numbers) // 2, []
    for here, there in ((0, half), (half, 0)):
        pairs = [(changes[here + k], numbers[there + k]) for k in range(half) if changes[here + k] is not None]
        moved += operation(*(x for x, _ in pairs), *(y for _, y in pairs)) if pairs else []
    (value,) = operation(*numbers)
    return [value], [sum(moved[1:], start=moved[0])]


_products = MacroPrimitive("sum_of_products", _sum_of_products, _sum_of_products_changed)


def sum_of_products(first: Sequence, second: Sequence) -> Scalar:
    """Return the sum of the products of two lists' entries; the lists have one length."""
    return _products(*first, *second)[0]


def product_term(first: list, second: list, k: int) -> Any:
    """Return coefficient k of a product of series; missing coefficients (None) are zero."""
    pairs = [(first[j], second[k - j]) for j in range(min(k, len(first) - 1) + 1) if second[k - j] is not None]
    return sum_of_products(*map(list, zip(*pairs))) if pairs else 0.0


def value_and_slope(coefficients: list[Scalar], x: Scalar) -> tuple[Scalar, Scalar]:
    """Return value and slope of a polynomial of degree 1 or more at x.

    Even and odd powers are evaluated side by side, for use where the last digit does not matter.
    """
    square = x * x
    even, even_slope = jet(coefficients[::2], square, 1)
    odd, odd_slope = jet(coefficients[1::2], square, 1)
    return even + x * odd, odd + 2 * x * (even_slope + x * odd_slope)


def shifted(coefficients: list[Scalar], by: Scalar) -> list[Scalar]:
    """Return the coefficients about a point `by` further on (synthetic division)."""
    terms = list(coefficients)
    for start in range(len(terms) - 1):
        for j in range(len(terms) - 2, start - 1, -1):
            terms[j] = terms[j] + by * terms[j + 1]
    return terms


def derivative(coefficients: list[Scalar]) -> list[Scalar]:
    """Return the coefficients of the derivative."""
    return [k * c for k, c in enumerate(coefficients)][1:]


def horner(coefficients: list[Scalar], x: Scalar | float) -> Scalar:
    """Return the value of a polynomial at x."""
    return polynomial(x, *coefficients, derivatives=0)[0]


def keeps_sign(coefficients: list[Scalar], sign: Scalar, length: Scalar) -> Scalar:
    """Return a number that is positive only if sign times the polynomial is certainly positive on (0, length].

    As long as the leading coefficients are not negative, x^m times their sum is a lower bound of their part. Every
    later negative coefficient lowers the sum by at most its size times x^m.
    """
    return _keeps_sign(length, sign, *coefficients)[0]


def _keeps_sign_written(length, sign, *coefficients):
    leading, kept = jnp.ones_like(sign, bool), []
    for k, c in enumerate(coefficients):
        term = sign * c
        least = jnp.minimum(term, 0.0)
        if k < 4:
            leading = leading & (term >= 0)
            least = select(leading, term, least)
        kept.append(least)
    return _polynomial(length, *kept, derivatives=0)


_keeps_sign = MacroPrimitive("keeps_sign", _keeps_sign_written)


def fall_bound(coefficients: list[Scalar], sign: Scalar, order: int, length: Scalar | float = 1.0) -> Scalar:
    """Bound minus the derivative of this order of sign times the polynomial, from above, on [0, length]."""
    if len(coefficients) <= order:
        return jnp.zeros_like(sign)
    return _fall_bound(length, sign, *coefficients[order:], order=order)[0]


def _fall_bound_written(length, sign, *coefficients, order: int):
    weights = (math.perm(k, order) for k in range(order, order + len(coefficients)))
    falls = [weight * jnp.maximum(-sign * c, 0.0) for weight, c in zip(weights, coefficients)]
    return _polynomial(length, *falls, derivatives=0)


_fall_bound = MacroPrimitive("fall_bound", _fall_bound_written)


def last_size(coefficients: list[Scalar]) -> Scalar:
    """Return the size of the last coefficients.

    Where every second or third is large (a resonance, a steep ramp), the last two may both be small. So those before
    count, too, with a weight that does not matter for other series.
    """
    last = jnp.maximum(jnp.abs(coefficients[-1]), jnp.abs(coefficients[-2]))
    return jnp.maximum(last, 0.02 * jnp.maximum(jnp.abs(coefficients[-3]), jnp.abs(coefficients[-4])))


_CAUTION = 24.0  # ratios of coefficients vary


def remainder(coefficients: list[Scalar], x: Scalar) -> Scalar:
    """Return an estimate of the terms after the last, at `x`, not above the last two.

    It is the last two terms times the larger of two ratios: of these to the two before, and of those to the two before
    them. Pairs, because every second coefficient may vanish.
    """
    pairs = [
        jnp.maximum(jnp.abs(coefficients[-k]) * x, jnp.abs(coefficients[-k - 1]))
        for k in (1, 3, 5)
        if k < len(coefficients)
    ]
    last, before = pairs[:2]
    falls = x**2  # each pair is two powers later
    if len(pairs) > 2:
        slower = last * pairs[2] < before * before
        over, under = select(slower, before, last), select(slower, pairs[2], before)
    else:
        over, under = last, before
    tiny = jnp.finfo(last.dtype).tiny
    ratio = jnp.minimum(_CAUTION * falls * over / jnp.maximum(under, tiny), 1.0)
    return ratio * last * x ** (len(coefficients) - 2)


def step_length(coefficients: list[Scalar], size: Scalar | float, cap: Scalar) -> Scalar:
    """Return the step at which the last coefficients drop below `size`, at most `cap`."""
    order, last = len(coefficients) - 1, last_size(coefficients)
    tiny = jnp.finfo(last.dtype).tiny
    ratio = size / jnp.maximum(last, tiny)
    return jnp.minimum(select(last > tiny, root_of(ratio, order), jnp.inf), cap)


def longest(order: int, dtype: Any) -> float:
    """Return a step whose powers up to this order are finite: the only bound where coefficients have vanished."""
    return float(jnp.finfo(dtype).max) ** (1 / (order + 2))


def root_of(value: Scalar, degree: int) -> Scalar:
    """Return the root of this degree (6 or more) of a positive number, to about one per cent.

    The bits of a float, read as an integer, are nearly its logarithm: a power function would not vectorise.
    """
    value = jnp.asarray(value)
    info = jnp.finfo(value.dtype)
    integer = jnp.int64 if info.bits == 64 else jnp.int32
    one, bias = 1 << info.nmant, info.maxexp - 1
    logarithm = (jax.lax.bitcast_convert_type(value, integer).astype(value.dtype) / one - bias) * (1 / degree)
    whole = jnp.floor(logarithm)
    part = logarithm - whole
    power = jax.lax.bitcast_convert_type((whole.astype(integer) + bias) * one, value.dtype)
    return power * (1 + part * (0.6565 + 0.3435 * part))


class Watch(NamedTuple):
    """A quantity whose first sign change is sought: sign (derivative of the polynomial - offset), positive at first."""

    derivative: int
    sign: Scalar
    offset: Scalar | float
    active: Flag | bool


class Landing(NamedTuple):
    """The end of a march: the point, the polynomial's jet there, and which watched quantities reached zero."""

    x: Scalar
    jet: list[Scalar]
    hits: list[Flag]


def _clear_length_written(value, slope, fall):
    """Return the length on which value + slope x - fall x^2/2 stays positive: it contains no zero."""
    root = jnp.sqrt(jnp.maximum(slope * slope + 2 * fall * value, 0.0))
    rising = slope > 0
    # Take the form of the parabola's zero that adds, to avoid cancellation.
    sum_ = materialize(select(rising, slope + root, slope - root), fall)
    above, below = select(rising, sum_, 2 * value), select(rising, fall, -sum_)
    # Without a fall there is no zero, unless the value is zero and does not rise.
    endless = select((value > 0) | rising, jnp.inf, 0.0)
    return [select(below > 0, above / select(below > 0, below, 1.0), endless)]


_clear_length = MacroPrimitive("clear_length", _clear_length_written)


def first_event(coefficients: list[Scalar], watches: list[Watch], start: Scalar, needed: Flag) -> Landing:
    """March from `start` to the first point of [0, 1] where a watched quantity changes sign.

    Each stride is the largest on which a parabola below every watched quantity stays positive. So no zero is stepped
    over, not even one of two in a narrow dip; near a simple zero the strides are Newton's. When the strides do not come
    to an end (a zero that is nearly double), the march stops there, with no hit: everything before that point is
    certain.

    Where not `needed` the march does not start (lanes march together under vmap, as long as the slowest). The result
    has no derivatives.
    """
    highest = max(w.derivative for w in watches) + 1
    eps = jnp.finfo(start.dtype).eps

    def clear(x, radius):
        """Return, for every quantity, the length after x on which it has no zero."""
        values, end = jet(coefficients, x, highest), jnp.minimum(x + radius, 1.0)
        lengths = [
            _clear_length(
                w.sign * (values[w.derivative] - w.offset),
                w.sign * values[w.derivative + 1],
                fall_bound(coefficients, w.sign, w.derivative + 2, end),
            )[0]
            for w in watches
        ]
        return [select(w.active, length, jnp.inf) for w, length in zip(watches, lengths)]

    def march(carry):
        x, radius, _, count = carry
        stride = materialize(jnp.clip(functools.reduce(jnp.minimum, clear(x, radius)), 0.0, radius), x)
        reached = jnp.minimum(x + stride, 1.0)
        going = (stride > 2 * eps * reached) & (reached < 1) & (count < 100)
        # The parabola has to be a lower bound only as far as the next stride may go: a short radius is tight.
        return reached, jnp.minimum(4 * stride, 1.0), going, count + 1

    x, radius, _, _ = jax.lax.while_loop(
        lambda carry: carry[2], march, (start, jnp.ones_like(start), needed, jnp.zeros_like(start, jnp.int32))
    )
    hits = [length <= 32 * eps * x for length in clear(x, radius)]
    return Landing(x, jet(coefficients, x, highest), hits)


def meet(x: Scalar, forcing: list[Scalar], level: Scalar) -> Scalar:
    """Return x, at which the series `forcing` meets `level`, with the derivatives of the root."""
    return custom_tangent(_meeting, x, (forcing, level))


def _meeting(x: Scalar, by: tuple, changes: tuple) -> Scalar:
    (forcing, _), (d_forcing, d_level) = by, changes
    moved = [jnp.zeros_like(x) if d is None else d for d in d_forcing]
    slope = horner(derivative(forcing), x) if len(forcing) > 1 else jnp.zeros_like(x)
    lack = (0.0 if d_level is None else d_level) - horner(moved, x)
    return select(slope == 0, 0.0, lack / select(slope == 0, 1.0, slope))
