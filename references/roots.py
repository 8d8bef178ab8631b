"""Roots of polynomials in (0, 1] for the Taylor reference: none can be missed.

Descartes' rule of signs on Bernstein coefficients isolates them; float64 decides only where its rounding cannot
change a sign.
"""

import functools
import math

import numpy as np

from references.arithmetic import sign


def value_at(coefficients, x):
    """Value of a polynomial."""
    if x == 1:
        return sum(coefficients)
    total = coefficients[-1]
    for c in coefficients[-2::-1]:
        total = total * x + c
    return total


def slopes_of(coefficients):
    """Coefficients of the derivative."""
    return [k * c for k, c in enumerate(coefficients)][1:] or [0 * coefficients[0]]


@functools.cache
def _to_bernstein(degree):
    """Matrix from power to Bernstein coefficients on [0, 1]."""
    table = [[math.comb(i, k) / math.comb(degree, k) for k in range(degree + 1)] for i in range(degree + 1)]
    return np.array(table)


def rough_bernstein(rough):
    """Bernstein coefficients on [0, 1] in float64, and a bound of their rounding errors."""
    degree = len(rough) - 1
    return _to_bernstein(degree) @ rough, 4e-16 * (degree + 4) * float(np.abs(rough).sum()) + 1e-300


def bernstein(coefficients):
    """Bernstein coefficients on [0, 1]."""
    degree = len(coefficients) - 1
    scaled = [c / math.comb(degree, k) for k, c in enumerate(coefficients)]
    for level in range(1, degree + 1):  # a table of sums: b_i = sum_k binomial(i, k) scaled_k
        for i in range(degree, level - 1, -1):
            scaled[i] += scaled[i - 1]
    return scaled


def halves(values):
    """Bernstein coefficients on both halves of the interval (de Casteljau)."""
    left, right, row = [values[0]], [values[-1]], values
    while len(row) > 1:
        row = [(a + b) / 2 for a, b in zip(row, row[1:])]
        left.append(row[0])
        right.append(row[-1])
    return left, right[::-1]


def newton(coefficients, low, high, guess, close):
    """The one root in [low, high] at whose ends the polynomial differs in sign: Newton inside a bracket."""
    slopes, width = slopes_of(coefficients), high - low
    sign_low, x, change = sign(value_at(coefficients, low)) or -sign(value_at(coefficients, high)), guess, width
    for count in range(500):
        value, slope = value_at(coefficients, x), value_at(slopes, x)
        if value == 0:
            return x
        low, high = (x, high) if sign(value) == sign_low else (low, x)
        guess = x - value / slope if slope else low
        guess = guess if low < guess < high else (low + high) / 2
        last, change = change, abs(guess - x)
        stalled = count > 8 and change >= last and change <= math.sqrt(close) * width
        if change <= close * guess or stalled:
            return guess
        x = guess
    raise ArithmeticError("A root did not converge.")


def isolate(arithmetic, coefficients):
    """Intervals of (0, 1] with one root each, rising (low = high: the root itself), in exact signs."""
    one = arithmetic.number(1)
    pending = [(0 * one, one, bernstein(coefficients))]
    while pending:
        low, high, values = pending.pop()
        signs = [b > 0 for b in values if b]
        changes = sum(a != b for a, b in zip(signs, signs[1:]))
        if values[-1] == 0 and changes == 0:
            yield high, high
        elif changes == 1 and values[-1] != 0:
            yield low, high
        elif changes:
            if high - low < arithmetic.power_of_ten(-arithmetic.digits // 2):
                raise ArithmeticError("Two roots too close to tell apart: grazing.")
            middle, (left, right) = (low + high) / 2, halves(values)
            pending += [(middle, high, right), (low, middle, left)]


def roots(arithmetic, coefficients, rough=None):
    """Roots in (0, 1] of a polynomial, rising; those at zero are left out. `rough`: the coefficients as floats."""
    lowest = next((k for k, c in enumerate(coefficients) if c), None)
    if lowest is None:
        return []
    coefficients = coefficients[lowest:]
    rough = np.array([float(c) for c in coefficients]) if rough is None else rough[lowest:]
    values, error = rough_bernstein(rough)
    close = arithmetic.power_of_ten(2 - arithmetic.digits)
    if np.abs(values).min() > error:
        changes = np.count_nonzero((values[1:] > 0) != (values[:-1] > 0))
        if changes == 0:
            return []
        if changes == 1:
            guess = newton(rough.tolist(), 0.0, 1.0, 0.5, 1e-12)
            return [newton(coefficients, 0 * close, 1 + 0 * close, arithmetic.number(guess), close)]
    brackets = isolate(arithmetic, coefficients)
    return [low if low == high else newton(coefficients, low, high, (low + high) / 2, close) for low, high in brackets]
