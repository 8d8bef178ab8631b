"""Argument checks: one message template, for concrete values and for values under jit."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Inexact

from jaxrock._core.arrays import Values, as_real, shown
from jaxrock._core.did_you_mean import did_you_mean
from jaxrock._core.settings import under_usual_settings
from jaxrock._core.throwing import throwing, throws
from jaxrock.compiler import checks

Making = TypeVar("Making", bound=Callable)


def as_meant(number: ArrayLike) -> float:
    """Return a number as the user wrote it: 0.01 in single precision is 0.009999999776, which divides no time."""
    return float(str(np.asarray(number)[()]))


def checked(name: str, value: Values, allowed: str, holds: Callable) -> Inexact[Array, "..."]:
    """Return `value` as an array for which `holds` is true everywhere.

    A concrete value that fails raises ValueError at once, also within `jax.jit`. A traced one carries a check, which
    raises when the compiled function runs (see `compiler.checks.error_if`). Under `throw=False` (see `with_throw`),
    numbers that fail become NaN.
    """
    array = as_real(name, value)
    if not throws():
        return jnp.where(holds(array), array, jnp.nan)
    message = f"Argument `{name}` must {allowed}"
    if isinstance(array, jax.core.Tracer):
        return checks.error_if(array, _failed(holds)(array), message)
    known = np.asarray(array)
    good = holds(known)
    if isinstance(good, jax.core.Tracer):
        return checks.error_if(array, ~jnp.all(good), message)
    good = np.asarray(good)  # on a JAX array, `np.all` would compile a program for every shape
    if not good.all():
        known, good = np.broadcast_arrays(known, good)
        raise ValueError(f"{message}, but is {_as_given(value, known, ~good)}.")
    return array


def _as_given(value: Values, known: np.ndarray, bad: np.ndarray) -> str:
    """Return the first bad number as text; with the user's value where the session's precision makes it 0 or inf."""
    number = known[bad].flat[0]
    given = np.asarray(value) if not isinstance(value, jax.Array) else known
    if given.shape == bad.shape and (number == 0 or np.isinf(number)) and number != given[bad].flat[0]:
        return f"{given[bad].flat[0]}, which is {number} in the precision of the session ({known.dtype})"
    return f"{number}"


def _failed(holds: Callable) -> Callable:
    """Return a function that tells whether `holds` is false anywhere.

    Under `jax.vmap` outside of `jax.jit`, JAX compiles every operation on its own. A function at module level is one
    operation, compiled once.
    """
    is_constant = getattr(holds, "__closure__", None) is None and "<locals>" not in holds.__qualname__
    return _compiled_failed(holds) if is_constant else lambda array: ~jnp.all(holds(array))


@functools.cache
def _compiled_failed(holds: Callable) -> Callable:
    return jax.jit(lambda array: ~jnp.all(holds(array)), inline=True)


def with_throw(function: Making) -> Making:
    """Decorate a function that makes a block, a law or a motion: it takes an argument `throw`.

    Under `throw=False` a number outside of its range becomes NaN, and does not raise, so that optimisers may take a
    step there. The outcome of such a scene is NaN, too, and its status says so. An argument that is not numeric, or
    has a wrong shape, still raises.
    """

    @under_usual_settings
    @functools.wraps(function)
    def made(*args: Any, throw: bool = True, **kwargs: Any) -> Any:
        if truth("throw", throw):
            return function(*args, **kwargs)
        with throwing(False):
            return function(*args, **kwargs)

    return cast(Making, made)


class Range(NamedTuple):
    """A range of allowed numbers; called with a name and a value, it returns the value as a checked array."""

    allowed: str  # in words, after "must"
    low: float  # ends of the interval in which a fit may move a number
    high: float
    holds: Callable

    def __call__(self, name: str, value: Values) -> Inexact[Array, "..."]:
        """Return `value` as an array of these numbers, or raise ValueError."""
        return checked(name, value, self.allowed, self.holds)


positive = Range("be positive and finite", 0.0, np.inf, lambda x: (x > 0) & (x < np.inf))
not_negative = Range("be 0 or more and finite", 0.0, np.inf, lambda x: (x >= 0) & (x < np.inf))
finite = Range("be finite", -np.inf, np.inf, lambda x: (x > -np.inf) & (x < np.inf))
level = Range("be 0 or more", 0.0, np.inf, lambda x: x >= 0)  # intensity of shaking; infinity stands for any
not_nan = Range("be a number", -np.inf, np.inf, lambda x: x == x)  # infinity is allowed
# Directions, with a margin for the rounding of a full turn; a larger number is in degrees.
direction = Range("be finite, and in radians, from -2 pi to 2 pi", -2 * np.pi, 2 * np.pi, lambda x: abs(x) <= 6.2832)
share = Range("be in [0, 1]", 0.0, 1.0, lambda x: (x >= 0) & (x <= 1))
inner_share = Range("be in (0, 1)", 0.0, 1.0, lambda x: (x > 0) & (x < 1))
below_one = Range("be in [0, 1)", 0.0, 1.0, lambda x: (x >= 0) & (x < 1))

# Parameters of blocks and motions. A block of 1e-9 rad is 1 m wide and a million kilometres high. A block of p = 1e6
# rad/s is smaller than an atom, and one of 1e-6 rad/s is as large as the solar system. 1e9 s are thirty years. Beyond,
# squares and products of these numbers overflow or underflow (in single precision first), or p times a duration is all
# rounding error. In fits the ends are open.
acute = Range("be in (0, pi/2), and not below 1e-9", 0.0, np.pi / 2, lambda x: (x >= 1e-9) & (x < np.pi / 2))
size = Range("be positive and finite, from 1e-9 to 1e9", 0.0, np.inf, lambda x: (x >= 1e-9) & (x <= 1e9))
rate = Range("be positive and finite, from 1e-6 to 1e6", 0.0, np.inf, lambda x: (x >= 1e-6) & (x <= 1e6))
ratio = Range("be positive and finite, from 1e-6 to 1e6", 0.0, np.inf, lambda x: (x >= 1e-6) & (x <= 1e6))
strength = Range("be finite, and at most 1e9 in size", -np.inf, np.inf, lambda x: (x >= -1e9) & (x <= 1e9))
factor = Range("be finite, and at most 1e30 in size", -np.inf, np.inf, lambda x: (x >= -1e30) & (x <= 1e30))
span = Range("be positive and finite, and at most 1e12", 0.0, np.inf, lambda x: (x > 0) & (x <= 1e12))
delay = Range("be 0 or more and finite, and at most 1e12", 0.0, np.inf, lambda x: (x >= 0) & (x <= 1e12))
RANGES = {
    "positive": positive, "not_negative": not_negative, "finite": finite, "not_nan": not_nan, "acute": acute,
    "share": share, "size": size, "rate": rate, "ratio": ratio, "strength": strength,
}  # fmt: skip


def if_known(allowed: Range, name: str, value: Values) -> Inexact[Array, "..."]:
    """Return `value` as an array; a concrete one is checked against a range, a traced one is not."""
    array = as_real(name, value)
    return array if isinstance(array, jax.core.Tracer) else allowed(name, array)


def scalar(name: str, array: Inexact[Array, "..."]) -> Inexact[Array, ""]:
    """Return `array` if it is one number."""
    if array.ndim:
        raise ValueError(f"Argument `{name}` must be one number, but has shape {array.shape}. Use jax.vmap for many.")
    return array


def whole(name: str, value: Any, least: int | None = None, most: int | None = None) -> int:
    """Return `value` if it is a whole number, from `least` up to `most`."""
    good = isinstance(value, (int, np.integer)) and not isinstance(value, (bool, np.timedelta64))  # an integer to NumPy
    if not (good and (least is None or value >= least) and (most is None or value <= most)):
        ends = "" if least is None else f", at least {least}" if most is None else f" from {least} to {most}"
        raise ValueError(f"Argument `{name}` must be a whole number{ends}, but is {shown(value)}.")
    return int(value)


def truth(name: str, value: Any) -> bool:
    """Return `value` if it is True or False."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"Argument `{name}` must be True or False, but is {shown(value)}.")
    return bool(value)


def one_of(name: str, value: Any, allowed: tuple[str, ...]) -> str:
    """Return `value` if it is one of the allowed words."""
    if not isinstance(value, str) or value not in allowed:
        words = ", ".join(repr(word) for word in allowed)
        raise ValueError(
            f"Argument `{name}` must be one of {words}, but is {shown(value)}.{did_you_mean(value, allowed)}"
        )
    return value
