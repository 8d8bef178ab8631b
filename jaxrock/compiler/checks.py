"""Checks of arguments within programs: they raise, or are collected as data; and NaN results for NaN inputs.

Start with `error_if`, then `collect`.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxrock.compiler.primitive.error_if import collect as collect, error_if as error_if


class Checked(eqx.Module):
    """Results of a function, and for each message of its checks whether the check fails."""

    results: Any
    failed: tuple
    messages: tuple[str, ...] = eqx.field(static=True)


def with_checks(function: Callable) -> Callable[..., Checked]:
    """Return the function with its checks collected instead of raised, as `Checked` results."""

    def checked(*arguments):
        with collect() as checks:
            results = function(*arguments)
        return Checked(results, tuple(failed for _, failed in checks), tuple(message for message, _ in checks))

    return checked


def any_nan(inputs: Any) -> Bool[Array, ""]:
    """Return whether any floating-point input is NaN."""
    numbers = [x for x in jax.tree.leaves(inputs) if jnp.issubdtype(jnp.result_type(x), jnp.inexact)]
    return jnp.stack([jnp.isnan(x).any() for x in numbers] or [jnp.asarray(False)]).any()


_STATUSES: list[tuple[type, Any]] = []  # set at import only


def declare_status(kind: Any, invalid: Any) -> None:
    """Register a class of `equinox.Enumeration` whose items tell whether a result is valid.

    **Arguments:**

    - `kind`: the class. `invalid`: its item for results of NaN inputs.
    """
    _STATUSES.append((kind, invalid))


@jax.jit
def nan_where_inputs_are(result: Any, inputs: Any) -> Any:
    """Return a result that is NaN, and whose status is invalid, where any input is NaN.

    A function may pass by an input that it does not come to need, so that its result looks valid.
    """
    bad = any_nan(inputs)

    def is_status(part):
        return any(isinstance(part, kind) for kind, _ in _STATUSES)

    def of(part):
        for kind, invalid in _STATUSES:
            if isinstance(part, kind):
                return kind.where(bad, invalid, part)
        return jnp.where(bad, jnp.nan, part) if jnp.issubdtype(jnp.result_type(part), jnp.inexact) else part

    return jax.tree.map(of, result, is_leaf=is_status)
