"""What became of a computation: every result carries one of these."""

from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool

from jaxrock._checks import is_traced

if TYPE_CHECKING:  # of Equinox's own declaration some checkers think that its items are words
    from typing import Self, TypeVar

    Kind = TypeVar("Kind")

    class item:
        """What checkers see of an item: an instance of its class."""

        def __init__(self, message: str) -> None: ...
        def __get__(self, instance: object, owner: type[Kind]) -> Kind: ...

    class _Items(type):
        def __getitem__(cls, item: Any) -> str: ...

    class Enumeration(metaclass=_Items):
        """What checkers see of `equinox.Enumeration`: items, alone or in arrays, that compare to arrays."""

        def __eq__(self, other: object) -> Bool[Array, "..."]: ...  # type: ignore[override]
        def __ne__(self, other: object) -> Bool[Array, "..."]: ...  # type: ignore[override]
        @classmethod
        def where(cls, pred: Bool[ArrayLike, "..."], a: Self, b: Self) -> Self: ...
else:
    Enumeration, item = eqx.Enumeration, str


class Status(Enumeration):
    """Outcome of a computation, as data: it goes through jit and vmap, and compares with ==.

    `Status[result.status]` is the message. Numbers beside a status other than `successful` are not results.
    """

    successful = item("The response was computed.")
    step_budget_exhausted = item(
        "The step budget was used up before the motion ended, usually by impacts that do not die out "
        "(restitution at or near 1). Raise that of the engine (`max_steps`, or `max_solves` of Diffrax); where its "
        "solver is of low order, raise `atol`."
    )
    undecided = item(
        "Too close to call: a near balance, a grazing impact or long chaotic rocking makes the response so sensitive "
        "that errors of this computation decide it. Where they are larger than rounding, a tighter tolerance or a "
        "higher `order` of the engine lowers them, and may decide; where a chaotic tail makes rounding grow as large, "
        "no setting of an engine decides."
    )
    solver_failed = item(
        "The differential equation solver gave up: its nonlinear solver failed or its steps became too small."
    )
    not_finite = item(
        "The state or the motion stopped being a finite number, or a law of restitution left [0, 1]. Check the inputs."
    )


def is_none(given: Any) -> Bool[Array, ""]:
    """Return whether any floating-point input is NaN."""
    numbers = [x for x in jax.tree.leaves(given) if jnp.issubdtype(jnp.result_type(x), jnp.inexact)]
    return jnp.stack([jnp.isnan(x).any() for x in numbers] or [jnp.asarray(False)]).any()


def still_where(lost: Bool[Array, ""], values: Any) -> Any:
    """The values, which nothing moves where `lost`: in reverse mode slopes that are no numbers end here. What many
    scenes share they go on to share."""

    def of(x):
        return _still_where(lost, x) if jnp.issubdtype(jnp.result_type(x), jnp.inexact) else x

    return jax.tree.map(of, values)


@jax.custom_jvp
def _still_where(lost, value):
    return value


@_still_where.defjvp
def _still_where_jvp(primals, tangents):
    lost, value = primals
    return _still_where(lost, value), jnp.where(lost, jnp.zeros_like(tangents[1]), tangents[1])


def still_if_none(given: Any) -> Any:
    """What is given to an engine, which has no slopes if a number of it is none."""
    return still_where(is_none(given), given) if is_traced(given) else given


@jax.jit
def marked_result(result: Any, given: Any) -> Any:
    """A result as it is, unless a number that was given is none: then none of the result is, and its status says so.

    An engine may pass by a number that it does not come to need, and what it returns may look like a result.
    """
    bad = is_none(given)

    def of(part):
        if isinstance(part, Status):
            return Status.where(bad, Status.not_finite, part)
        return jnp.where(bad, jnp.nan, part) if jnp.issubdtype(jnp.result_type(part), jnp.inexact) else part

    return jax.tree.map(of, result, is_leaf=lambda part: isinstance(part, Status))
