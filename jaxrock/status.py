"""Status of a computation, which every result carries."""

from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool

from jaxrock._core.arrays import is_traced
from jaxrock.compiler import checks

if TYPE_CHECKING:  # some checkers take items of Equinox's own declaration for strings
    from typing import Self, TypeVar

    Kind = TypeVar("Kind")

    class item:
        """An item as checkers see it: an instance of its class."""

        def __init__(self, message: str) -> None: ...
        def __get__(self, instance: object, owner: type[Kind]) -> Kind: ...

    class _Items(type):
        def __getitem__(cls, item: Any) -> str: ...

    class Enumeration(metaclass=_Items):
        """`equinox.Enumeration` as checkers see it: items, alone or in arrays, that compare to arrays."""

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
        "solver is of low order, raise `atol`. An equation of your own may use it up where its moments jump at some "
        "angle or velocity: list such angles in `bends`, and smooth the jump, as of k sign(v) to k tanh(v/w)."
    )
    undecided = item(
        "Too close to call: a near balance, a grazing impact or long chaotic rocking makes the response so sensitive "
        "that errors of this computation decide it; `overturned_share` tells how many of the motions that they allow "
        "overturn. Where errors are larger than rounding, a tighter tolerance or a higher `order` of the engine lowers "
        "them, and may decide; where chaotic rocking makes rounding grow as large, no setting of an engine decides."
    )
    solver_failed = item(
        "The differential equation solver gave up: its nonlinear solver failed or its steps became too small."
    )
    not_finite = item(
        "The state or the motion stopped being a finite number, or a law of restitution left [0, 1]. Check the inputs."
    )
    chaotic = item(
        "The verdict holds, but the peak is known only to `error`: long chaotic rocking amplifies rounding errors "
        "beyond the rotation itself, and every motion that they allow has the same verdict."
    )


def is_decided(status: Status) -> Bool[Array, "..."]:
    """Return whether the verdict holds: the response was computed, or is chaotic."""
    return (status == Status.successful) | (status == Status.chaotic)


def still_where(lost: Bool[Array, ""], values: Any) -> Any:
    """Return values whose tangents are zero where `lost`: in reverse mode, NaN cotangents end here.

    A value that many scenes share stays shared.
    """

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
    """Return the arguments of an engine, with zero tangents if any number among them is NaN."""
    return still_where(checks.any_nan(given), given) if is_traced(given) else given


checks.declare_status(Status, Status.not_finite)
