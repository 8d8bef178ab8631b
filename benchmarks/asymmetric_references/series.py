"""Power series in 150-bit numbers (gmpy2): products, roots on [0, 1] with every root isolated before it is polished."""

import os
from operator import mul

import gmpy2
from gmpy2 import mpfr

BITS = int(os.environ.get("ASYMMETRIC_BITS", 150))  # 150: 45 digits
DIGITS = int(BITS * 0.30103) - 4
gmpy2.get_context().precision = BITS
TOLERANCE = mpfr(10) ** -DIGITS
ORDER = int(os.environ.get("ASYMMETRIC_ORDER", 44))


def dot(first, second):
    """Sum of products to the end of the shorter one."""
    return sum(map(mul, first, second), mpfr(0))


def product_term(a, b, k):
    """Coefficient k of a product; what lies beyond the end of a series is zero."""
    return sum((a[j] * b[k - j] for j in range(max(0, k - len(b) + 1), min(k, len(a) - 1) + 1)), mpfr(0))


def product(a, b):
    """All coefficients of a product of two series, cut at the longer one's order."""
    return [product_term(a, b, k) for k in range(max(len(a), len(b)))]


def value(c, t):
    """A polynomial at t."""
    total = c[-1]
    for a in c[-2::-1]:
        total = total * t + a
    return total


def slopes(c):
    """Coefficients of the derivative."""
    return [k * a for k, a in enumerate(c)][1:]


def rescaled(c, h):
    """Coefficients in t/h of a series in t."""
    power, out = mpfr(1), []
    for a in c:
        out.append(a * power)
        power = power * h
    return out


def shifted(c, middle, radius):
    """Coefficients in r of a polynomial at middle + radius r."""
    c = list(c)
    for k in range(len(c) - 1):
        for j in range(len(c) - 2, k - 1, -1):
            c[j] += middle * c[j + 1]
    return rescaled(c, radius)


def trimmed(c):
    """Without trailing terms that cannot matter."""
    size, n = max(map(abs, c)), len(c)
    while n > 1 and abs(c[n - 1]) < size * TOLERANCE / 1000:
        n -= 1
    return c[:n]


def isolated(c, low, high, depth=0):
    """Intervals with exactly one simple root each, rising."""
    if depth > 60:
        raise ArithmeticError("two roots too close to be told apart")
    q = shifted(c, (low + high) / 2, (high - low) / 2)
    if abs(q[0]) > sum(map(abs, q[1:])):
        return
    if len(q) > 1 and abs(q[1]) > sum(k * abs(a) for k, a in enumerate(q[2:], 2)):
        if (value(q, mpfr(-1)) > 0) != (value(q, mpfr(1)) > 0):
            yield low, high
        return
    middle = (low + high) / 2
    yield from isolated(c, low, middle, depth + 1)
    yield from isolated(c, middle, high, depth + 1)


def roots(c, zeros=0):
    """Roots in (0, 1], rising, after `zeros` known ones at 0 are divided out."""
    c = trimmed(c[zeros:])
    if len(c) < 2 or abs(c[0]) > sum(map(abs, c[1:])):
        return
    d = slopes(c)
    for low, high in isolated(c, mpfr(0), mpfr(1)):
        rising = value(c, high) > value(c, low)
        for _ in range(14):
            middle = (low + high) / 2
            low, high = (low, middle) if (value(c, middle) > 0) == rising else (middle, high)
        root = (low + high) / 2
        for _ in range(6):
            root -= value(c, root) / value(d, root)
        if 0 < root <= 1:
            yield root


def step_length(*several):
    """Part of a unit step for which the last four terms of each series fall below the tolerance."""
    length = mpfr(1)
    for c in several:
        if len(c) < 10:  # a polynomial: exact
            continue
        size = max(map(abs, c))
        n = len(c) - 1
        for k in range(max(1, n - 3), n + 1):
            if size and abs(c[k]) > TOLERANCE * size:
                length = min(length, (TOLERANCE * size / abs(c[k])) ** (mpfr(1) / k))
    return length
