"""Arrays of a call: NumPy's and JAX's, concrete or traced, and error messages about them."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Inexact

from jaxrock._core.settings import narrowed

Values = ArrayLike | Sequence[float | int] | Sequence[Sequence[float | int]]


def as_array(value: Any) -> Array:
    """Return `value` as an array of JAX.

    For a number that is differentiated outside of `jax.jit`, `jnp.asarray` would compile an identity.
    """
    return value if isinstance(value, jax.Array) else jnp.asarray(value)


def is_traced(tree: Any) -> bool:
    """Return whether any array in a tree is traced: within `jax.jit`, `jax.vmap` or a derivative."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def is_concrete(tree: Any) -> bool:
    """Return whether NumPy may compute with the arrays of a tree: they are concrete, and not committed to a device."""
    leaves = jax.tree.leaves(tree)
    return not is_traced(leaves) and not any(getattr(leaf, "committed", False) for leaf in leaves)


def as_real(name: str, value: Values) -> Inexact[Array, "..."]:
    """Return `value` as a floating-point array; a concrete value stays concrete within `jax.jit`.

    **Raises:** ValueError for any other value, which the message shows.
    """
    if isinstance(value, jax.Array) and value.dtype == jnp.result_type(float) and not value.weak_type:
        return value
    if is_traced(value):
        return _as_real(name, value)
    with jax.ensure_compile_time_eval():
        return _as_real(name, value)


def in_native_bytes(numbers: np.ndarray) -> np.ndarray:
    """Return numbers as JAX accepts them: in native byte order, and in double precision at most."""
    kind = numbers.dtype.newbyteorder("=") if numbers.dtype.itemsize <= 8 else np.dtype(float)
    return numbers.astype(kind, copy=False)


def check_unmasked(name: str, value: Any) -> None:
    """Raise ValueError for a NumPy array with masked values: the numbers under a mask are arbitrary."""
    if np.ma.is_masked(value):
        raise ValueError(f"Argument `{name}` must have a value everywhere, but some are masked.")


def _as_real(name: str, value: Values) -> Inexact[Array, "..."]:
    if _holds_no_number(value):
        raise _no_number(name, value)
    check_unmasked(name, value)
    usual = jnp.result_type(float)
    try:
        # A Python number has a weak type, for which every function would be compiled again; NumPy's have none.
        known = value if isinstance(value, jax.Array) or is_traced(value) else np.array(value)
        if isinstance(known, np.ndarray) and known.dtype.kind in "fiu":
            known = in_native_bytes(known)
            is_real = known.dtype.kind == "f" and known.dtype.itemsize >= usual.itemsize // 2
            with np.errstate(over="ignore"):  # the check of the range reports infinity
                return to_device(known if is_real else known.astype(usual))  # integers and half precision
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


def to_device(known: Any) -> Any:
    """Return a tree of NumPy arrays as JAX arrays, without the program that `jnp.asarray` compiles for every shape."""
    return jax.device_put(known)


def if_traced(array: Any) -> Any:
    """Return a traced array unchanged, and any other as a NumPy array, whose operations compile nothing."""
    return array if is_traced(array) else np.asarray(array)


def of_each(function: Callable, tree: Any) -> Any:
    """Map a function over the arrays of a tree; it gets concrete ones as NumPy arrays, so that nothing is compiled."""
    return jax.tree.map(lambda x: function(x) if is_traced(x) else to_device(function(np.asarray(x))), tree)


def _no_number(name: str, value: Any) -> ValueError:
    return ValueError(f"Argument `{name}` must be a number or an array of numbers, but is {shown(value)}.")


def _holds_no_number(value: Any) -> bool:
    """Return whether a value holds True, None, or text, which NumPy or JAX would convert to numbers."""
    if isinstance(value, (list, tuple)):
        return any(map(_holds_no_number, value))
    return value is None or isinstance(value, (bool, np.bool_, str, bytes))


def shown(value: Any) -> str:
    """Return the description of a value for an error message, in one short line."""
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
    if " at 0x" in text:  # Python's default, with an address in memory
        return f"an object of type {type(value).__name__}"
    return text if len(text) <= _LONG else f"{text[: _LONG - 3]}..."


_LONG = 80  # characters of a value in a message


def check_shapes(**arrays: Array | None) -> None:
    """Raise ValueError for arguments whose shapes do not broadcast."""
    shapes = {name: array.shape for name, array in arrays.items() if array is not None}
    if len({*shapes.values(), ()}) <= 2:
        return
    try:
        np.broadcast_shapes(*shapes.values())
    except ValueError:
        names, given = (" and ".join(words) for words in ([f"`{n}`" for n in shapes], map(str, shapes.values())))
        raise ValueError(f"Arguments {names} must have shapes that go together, but have {given}.") from None
