"""Argument checks: one message template, for values that are known and for values under jit."""

import contextlib
import contextvars
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import get_opaque_trace_state
from jaxtyping import Array, ArrayLike, Bool, Inexact

from jaxrock._guard import as_array, guarded
from jaxrock._settings import called_by_users, narrowed, under_usual_settings
from jaxrock._words import meant

Making = TypeVar("Making", bound=Callable)
Values = ArrayLike | Sequence[float | int] | Sequence[Sequence[float | int]]


def as_meant(number: ArrayLike) -> float:
    """A number as it was meant: 0.01 in single precision is 0.009999999776, and that no time fits."""
    return float(str(np.asarray(number)[()]))


def is_traced(tree: Any) -> bool:
    """Return whether any array in it is traced: within `jax.jit`, `jax.vmap` or a derivative."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def is_at_hand(tree: Any) -> bool:
    """Return whether NumPy may compute with the arrays in it: they are concrete, and not committed to a device."""
    leaves = jax.tree.leaves(tree)
    return not is_traced(leaves) and not any(getattr(leaf, "committed", False) for leaf in leaves)


def by_numpy_or_one_program(**settings: Any) -> Callable[[Making], Making]:
    """Decorate a function that looks things up by NumPy where all is at hand: elsewhere it is one program.

    `settings`: of `jax.jit`.
    """

    def decorate(function: Making) -> Making:
        compiled = jax.jit(function, **settings)

        @under_usual_settings
        @functools.wraps(function)
        def run(*args: Any) -> Any:
            return function(*args) if is_at_hand(args) else compiled(*args)

        return cast(Making, run)

    return decorate


def check_known(**values: Any) -> None:
    """Raise ValueError for what is traced, where NumPy takes over."""
    for name, value in values.items():
        if is_traced(value):
            raise ValueError(
                f"Argument `{name}` must be known: this is no function under `jax.jit`, `jax.vmap` or a derivative."
            )


def one_program(function: Making) -> Making:
    """Decorate a pure function of arrays: of known ones all its operations are one program, where each would be one for
    every shape; of traced ones it is as it is written."""
    compiled = jax.jit(function)

    @called_by_users
    @functools.wraps(function)
    def run(*args: Any) -> Any:
        return function(*args) if is_traced(args) else compiled(*args)

    return cast(Making, run)


def as_real(name: str, value: Values) -> Inexact[Array, "..."]:
    """Return `value` as a floating-point array, or say what it is instead; what is known stays so within `jax.jit`."""
    if isinstance(value, jax.Array) and value.dtype == jnp.result_type(float) and not value.weak_type:
        return value
    if is_traced(value):
        return _as_real(name, value)
    with jax.ensure_compile_time_eval():
        return _as_real(name, value)


def native(numbers: np.ndarray) -> np.ndarray:
    """The same as JAX takes them: in this machine's order of bytes, of double precision at most."""
    kind = numbers.dtype.newbyteorder("=") if numbers.dtype.itemsize <= 8 else np.dtype(float)
    return numbers.astype(kind, copy=False)


def check_unmasked(name: str, value: Any) -> None:
    """Raise ValueError for an array of NumPy with values that are masked: what lies under a mask is no number."""
    if np.ma.is_masked(value):
        raise ValueError(f"Argument `{name}` must have a value everywhere, but some are masked.")


def _as_real(name: str, value: Values) -> Inexact[Array, "..."]:
    if _holds_no_number(value):
        raise _no_number(name, value)
    check_unmasked(name, value)
    usual = jnp.result_type(float)
    try:
        # A number of Python leaves a weak type behind, which would recompile every function it meets; NumPy's do not.
        known = value if isinstance(value, jax.Array) or is_traced(value) else np.array(value)
        if isinstance(known, np.ndarray) and known.dtype.kind in "fiu":
            known = native(known)
            is_real = known.dtype.kind == "f" and known.dtype.itemsize >= usual.itemsize // 2
            with np.errstate(over="ignore"):  # the check of the range reports an infinite number
                return placed(known if is_real else known.astype(usual))  # of integers, and of half precision
        array = narrowed(as_array(known))
    except (TypeError, ValueError, OverflowError) as error:
        raise _no_number(name, value) from error
    if jnp.issubdtype(array.dtype, jnp.complexfloating):
        raise ValueError(f"Argument `{name}` must be real, but is {shown(value)}.")
    if array.dtype == bool:
        raise _no_number(name, value)
    if not jnp.issubdtype(array.dtype, jnp.floating) or array.dtype.itemsize < usual.itemsize // 2:
        array = array.astype(usual)
    return jax.lax.convert_element_type(array, array.dtype) if array.weak_type else array


def placed(known: Any) -> Any:
    """Arrays of NumPy, in a tree, as JAX's: as they are, where `jnp.asarray` compiles a program for every shape."""
    return jax.device_put(known)


def if_traced(array: Any) -> Any:
    """An array that is traced as it is, and any other as NumPy's: what is done with that compiles nothing."""
    return array if is_traced(array) else np.asarray(array)


def of_each(function: Callable, tree: Any) -> Any:
    """A function of arrays, NumPy's or JAX's, of each array in a tree, by NumPy where it is known."""
    return jax.tree.map(lambda x: function(x) if is_traced(x) else placed(function(np.asarray(x))), tree)


def _no_number(name: str, value: Any) -> ValueError:
    return ValueError(f"Argument `{name}` must be a number or an array of numbers, but is {shown(value)}.")


def _holds_no_number(value: Any) -> bool:
    """Return whether it holds what NumPy or JAX would take for a number: True, None."""
    if isinstance(value, (list, tuple)):
        return any(map(_holds_no_number, value))
    return value is None or isinstance(value, (bool, np.bool_, str, bytes))


def shown(value: Any) -> str:
    """What a message says that an argument is, in one short line."""
    if isinstance(value, jax.core.Tracer):
        return f"a traced array of shape {value.shape}"
    if isinstance(value, type):
        return f"the class {value.__name__} (without parentheses)"
    if hasattr(type(value), "__dataclass_fields__"):
        name = type(value).__name__
        return f"{'an' if name[0] in 'AEIOUaeiou' else 'a'} {name}"
    if callable(value):
        return f"the function {getattr(value, '__name__', type(value).__name__)}"
    text = " ".join(repr(value).split())
    if " at 0x" in text:  # Python's own, which says where it lies in memory
        return f"an object of type {type(value).__name__}"
    return text if len(text) <= _LONG else f"{text[: _LONG - 3]}..."


_LONG = 80  # characters of a value in a message


def checked(name: str, value: Values, allowed: str, holds: Callable) -> Inexact[Array, "..."]:
    """Return `value` as an array for which `holds` is true everywhere.

    A known value that fails raises ValueError at once, within `jax.jit` too; one that is traced carries a check, which
    raises when the compiled function meets it (see `_guard`). Where nothing may be raised (see `with_throw`), what
    fails is not a number.
    """
    array = as_real(name, value)
    if not throws():
        return jnp.where(holds(array), array, jnp.nan)
    message = f"Argument `{name}` must {allowed}"
    if isinstance(array, jax.core.Tracer):
        return watched(array, message, _failed(holds)(array))
    known = np.asarray(array)
    good = holds(known)
    if isinstance(good, jax.core.Tracer):
        return watched(array, message, ~jnp.all(good))
    good = np.asarray(good)  # of an array of JAX `np.all` would be a program for every shape
    if not good.all():
        known, good = np.broadcast_arrays(known, good)
        raise ValueError(f"{message}, but is {_as_given(value, known, ~good)}.")
    return array


def _as_given(value: Values, known: np.ndarray, bad: np.ndarray) -> str:
    """Return the first bad number as text, and as given where the precision of the session makes it zero or
    infinite."""
    number = known[bad].flat[0]
    given = np.asarray(value) if not isinstance(value, jax.Array) else known
    if given.shape == bad.shape and (number == 0 or np.isinf(number)) and number != given[bad].flat[0]:
        return f"{given[bad].flat[0]}, which is {number} in the precision of the session ({known.dtype})"
    return f"{number}"


def _failed(holds: Callable) -> Callable:
    """Return whether it does not hold somewhere. Under `jax.vmap` outside of `jax.jit` every operation is compiled by
    itself: what is there once and for all is one operation."""
    is_constant = getattr(holds, "__closure__", None) is None and "<locals>" not in holds.__qualname__
    return _compiled_failed(holds) if is_constant else lambda array: ~jnp.all(holds(array))


@functools.cache
def _compiled_failed(holds: Callable) -> Callable:
    return jax.jit(lambda array: ~jnp.all(holds(array)), inline=True)


def watched(values: Any, message: str, failed: Bool[Array, ""]) -> Any:
    """Return `values`, which are traced, with a check: it is put down, or made where they are computed."""
    state, checks = _put_down.get()
    if state is not None and state == get_opaque_trace_state():
        checks.append((message, failed))
        return values
    return guarded(values, failed, message + ".")


# What is traced where checks are put down, and these; every thread has its own.
_put_down: contextvars.ContextVar[tuple[Any, Any]] = contextvars.ContextVar("put_down", default=(None, None))


@contextlib.contextmanager
def put_down() -> Iterator[list[tuple[str, Bool[Array, ""]]]]:
    """Checks of traced values are not made, but put down: pairs of a message, and whether the check has failed.

    One that returns what was put down is kept by JAX's cache of compiled programs on every platform; one that raises on
    CPUs only.
    Checks within transformations of the function that is traced here are still made.
    """
    checks: list[tuple[str, Bool[Array, ""]]] = []
    before = _put_down.set((get_opaque_trace_state(), checks))
    try:
        yield checks
    finally:
        _put_down.reset(before)


# Whether numbers outside of their ranges raise, or become what is not a number; every thread has its own.
_throws = contextvars.ContextVar("throws", default=True)


@contextlib.contextmanager
def throwing(wanted: bool) -> Iterator[None]:
    """Numbers outside of their ranges, known or traced, raise here if that is wanted, and was before; or else they
    become what is not a number.

    Not around anything that JAX traces and keeps: a program would go on without.
    """
    before = _throws.set(_throws.get() and wanted)
    try:
        yield
    finally:
        _throws.reset(before)


def throws() -> bool:
    """Return whether numbers outside of their ranges raise now."""
    return _throws.get()


def with_throw(function: Making) -> Making:
    """Decorate what makes a block, a law or a motion, and takes `throw`: that is seen to here.

    False: a number outside of its range becomes what is not a number, and nothing is raised, so that optimisers may
    take a step there; the outcome of such a scene is not a number either, and its status says so. What is no number at
    all, or of a wrong shape, raises all the same.
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
    """The numbers that are allowed somewhere; called with a name and a value it returns the value as such an array."""

    allowed: str  # in words, after "must"
    low: float  # ends of the interval in which a number may be moved
    high: float
    holds: Callable

    def __call__(self, name: str, value: Values) -> Inexact[Array, "..."]:
        """Return `value` as an array of these numbers, or raise ValueError."""
        return checked(name, value, self.allowed, self.holds)


positive = Range("be positive and finite", 0.0, np.inf, lambda x: (x > 0) & (x < np.inf))
not_negative = Range("be 0 or more and finite", 0.0, np.inf, lambda x: (x >= 0) & (x < np.inf))
finite = Range("be finite", -np.inf, np.inf, lambda x: (x > -np.inf) & (x < np.inf))
level = Range("be 0 or more", 0.0, np.inf, lambda x: x >= 0)  # of a shaking; infinite: any
not_nan = Range("be a number", -np.inf, np.inf, lambda x: x == x)  # some may be infinite
# Directions, with room for the rounding of a full turn; more of it is a number of degrees.
direction = Range("be finite, and in radians, from -2 pi to 2 pi", -2 * np.pi, 2 * np.pi, lambda x: abs(x) <= 6.2832)
share = Range("be in [0, 1]", 0.0, 1.0, lambda x: (x >= 0) & (x <= 1))
inner_share = Range("be in (0, 1)", 0.0, 1.0, lambda x: (x > 0) & (x < 1))
below_one = Range("be in [0, 1)", 0.0, 1.0, lambda x: (x >= 0) & (x < 1))

# Of what blocks and motions are made. A block of 1e-9 rad is 1 m wide and a million kilometres high; one of p = 1e6
# rad/s is smaller than an atom, one of 1e-6 rad/s as large as the solar system; 1e9 s are thirty years. Beyond, squares
# of these numbers, and products of several, come to where floating-point numbers end (in single precision first), or
# p times a duration to where rounding is all. Where a fit moves them the ends are open.
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
    """Return `value` as an array, of numbers in a range where they are known; what is traced is not looked at."""
    array = as_real(name, value)
    return array if isinstance(array, jax.core.Tracer) else allowed(name, array)


def check_shapes(**arrays: Array | None) -> None:
    """Raise ValueError for arguments whose shapes do not go together."""
    shapes = {name: array.shape for name, array in arrays.items() if array is not None}
    if len({*shapes.values(), ()}) <= 2:
        return
    try:
        np.broadcast_shapes(*shapes.values())
    except ValueError:
        names, given = (" and ".join(words) for words in ([f"`{n}`" for n in shapes], map(str, shapes.values())))
        raise ValueError(f"Arguments {names} must have shapes that go together, but have {given}.") from None


def scalar(name: str, array: Inexact[Array, "..."]) -> Inexact[Array, ""]:
    """Return `array` if it is one number."""
    if array.ndim:
        raise ValueError(f"Argument `{name}` must be one number, but has shape {array.shape}. Use jax.vmap for many.")
    return array


def whole(name: str, value: Any, least: int | None = None, most: int | None = None) -> int:
    """Return `value` if it is a whole number, from `least` up to `most`."""
    good = isinstance(value, (int, np.integer)) and not isinstance(value, (bool, np.timedelta64))  # which NumPy counts
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
        raise ValueError(f"Argument `{name}` must be one of {words}, but is {shown(value)}.{meant(value, allowed)}")
    return value
