"""A condition as a one-iteration `while`: a vmapped `cond` runs both branches for all lanes."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import ArrayLike, Bool, PyTree

from jaxrock.compiler.hints.materialize import are_hints_wanted, materialize

Flag = Bool[ArrayLike, ""]


def cond_any(needed: Flag, function: Callable, value: PyTree) -> PyTree:
    """Return `function(value, needed, inside)` where `needed`, else `value`; under `jax.vmap` it runs if any lane does.

    **Arguments:**

    - `needed`: flag, of one lane.
    - `function`: called with `value`, with the flag, and with a function `inside`. Values from outside must pass
      through `inside` before `function` computes with them. Otherwise XLA moves that computation out of the branch, and
      every step pays for it.
    - `value`: arrays in a tree; `function` returns the same types.

    **Returns:** a tree like `value`.

    **Example:**

    ```python
    import jax, jax.numpy as jnp
    from jaxrock.compiler import cond_any

    def damped(x, rate):
        def function(x, needed, inside):
            return x * jnp.exp(-inside(rate))

        return cond_any(x > 1, function, x)

    few = jax.vmap(damped, in_axes=(0, None))(jnp.array([0.5, 4.0]), jnp.array(0.1))
    ```
    """

    def body(carry):
        first, value = carry

        # The flag is a carry of the loop, so XLA cannot hoist what depends on it.
        witness = jnp.where(first, 0.0, -1.0) if are_hints_wanted() else None

        def inside(x):
            return x if witness is None else materialize(x, witness)

        return jnp.zeros_like(first), function(value, first, inside)

    return jax.lax.while_loop(lambda carry: carry[0], body, (needed, value))[1]
