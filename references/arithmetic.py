"""Numbers of the Taylor reference: real numbers of some decimal digits, by gmpy2 or mpmath."""

import math
from operator import mul

from mpmath import mp

try:
    import gmpy2
except ImportError:  # the same answers, about eight times slower
    gmpy2 = None


class Arithmetic:
    """Real numbers of some decimal digits: gmpy2 where it is installed, otherwise mpmath; use inside `context()`."""

    def __init__(self, digits=40, backend=None):
        self.backend = backend or ("gmpy2" if gmpy2 else "mpmath")
        self.digits = digits
        self.bits = int(math.ceil((digits + 1) * math.log2(10)))
        if self.backend == "gmpy2":
            self.number, self.sin_cos, self.log2 = gmpy2.mpfr, gmpy2.sin_cos, gmpy2.log2
            source = gmpy2
        else:
            self.number, self.sin_cos, self.log2 = mp.mpf, lambda x: mp.cos_sin(x)[::-1], lambda x: mp.log(x, 2)
            source = mp
        for name in ("sin", "cos", "tan", "asin", "sqrt", "exp", "expm1"):
            setattr(self, name, getattr(source, name))

    def context(self):
        """Context manager that sets the working precision."""
        return gmpy2.context(precision=self.bits) if self.backend == "gmpy2" else mp.workprec(self.bits)

    @property
    def pi(self):
        """Half the circumference of the unit circle."""
        return gmpy2.const_pi() if self.backend == "gmpy2" else +mp.pi

    def power_of_ten(self, exponent):
        """10 to an integer exponent."""
        return self.number(10) ** exponent

    def mpf(self, x):
        """Convert the number to mpmath, exactly."""
        if self.backend == "mpmath":
            return x
        mantissa, exponent = x.as_mantissa_exp()
        return mp.mpf((int(mantissa), int(exponent)))

    def text(self, x, digits=28):
        """Decimal digits as text."""
        with mp.workprec(self.bits):
            return mp.nstr(self.mpf(x), digits)


def sign(x):
    """-1, 0 or 1."""
    return (x > 0) - (x < 0)


def dot(first, second):
    """Sum of products, to the end of the shorter one."""
    return sum(map(mul, first, second))
