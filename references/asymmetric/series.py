"""Power series in 150-bit numbers (gmpy2): products, roots, and how far a series holds."""

import os

import gmpy2
from gmpy2 import mpfr

from references import roots as polynomials
from references.arithmetic import Arithmetic

BITS = int(os.environ.get("ASYMMETRIC_BITS", 150))  # 150: 45 digits
ARITHMETIC = Arithmetic(int(BITS * 0.30103) - 1, "gmpy2")
DIGITS = ARITHMETIC.digits - 3
gmpy2.get_context().precision = ARITHMETIC.bits
TOLERANCE = mpfr(10) ** -DIGITS
ORDER = int(os.environ.get("ASYMMETRIC_ORDER", 44))


def product_term(a, b, k):
    """Coefficient k of a product; what lies beyond the end of a series is zero."""
    return sum((a[j] * b[k - j] for j in range(max(0, k - len(b) + 1), min(k, len(a) - 1) + 1)), mpfr(0))


def product(a, b):
    """All coefficients of a product of two series, cut at the longer one's order."""
    return [product_term(a, b, k) for k in range(max(len(a), len(b)))]


def roots(c, zeros=0):
    """Roots in (0, 1], rising, after `zeros` known ones at 0 are divided out."""
    return iter(polynomials.roots(ARITHMETIC, c[zeros:]))


def onset(pushes):
    """Where on [0, 1] the first of several series, by side, becomes positive.

    **Returns:** the place, the side, and how often the opening angle is zero there; None where none does.
    """
    found = None
    for s, push in pushes.items():
        zero = abs(push[0]) <= TOLERANCE
        if zero and len(push) > 1 and push[1] > 0:  # touching from below: leave only where it grows
            return mpfr(0), s, 3
        if push[0] > TOLERANCE:
            return mpfr(0), s, 2
        root = next(roots(push, int(zero)), None)
        if root is not None and (found is None or root < found[0]):
            found = root, s, 3
    return found


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
