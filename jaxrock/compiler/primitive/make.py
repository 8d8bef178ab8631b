"""The maker of lane functions: it flattens arguments, finds the key, and lifts captured tracers to arguments."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import jaxpr_as_fun

from jaxrock._core.settings import narrowed
from jaxrock.compiler.cache.key import key_of
from jaxrock.compiler.ordinary import IS_ORDINARY, ordinary_lane_function
from jaxrock.compiler.primitive.bind import computed
from jaxrock.compiler.primitive.lane_function import LaneFunction, Mode, TwoPass


def lane_function(
    function: Callable | TwoPass,
    reverse: Callable | None = None,
    key: str | None = None,
    results: Callable | None = None,
    in_lanes: bool = False,
    refill: bool = False,
    mode: Mode | str = Mode.JACOBIAN,
) -> Callable:
    """Return a function of one lane as a function of JAX: under `jax.vmap` it runs in vectors of lanes.

    It has derivatives of every order, forward and reverse, all by forward mode. A derivative is a small Jacobian times
    the tangents, which transposes. One run computes value and Jacobian, and is a lane function, too.

    Under `JAXROCK_COMPILER=off` it is `function` as ordinary JAX, with the same rule for its derivatives.

    **Arguments:**

    - `function`: of one tree of arrays; or a `TwoPass`, whose fast pass runs where lanes are many.
    - `reverse`: the same function, through whose code JAX's reverse mode goes, for derivatives by many numbers.
    - `key`: a name, if the function depends on its argument alone. Then it is traced once, and kept between sessions: a
      function outside of the package that changes needs another key.
    - `results`: of the `jax.ShapeDtypeStruct`s of the argument, returns those of the result without tracing. Needs a
      `key`.
    - `in_lanes`: whether machine code may run it; always for a `TwoPass`.
    - `refill`: whether a lane whose loop is finished takes the next point. `function` is then one loop.
    - `mode`: of its derivatives, see `Mode`.

    **Returns:** `run(tree)`, which `jax.jit`, `jax.vmap` and `jax.grad` take.

    **Example:**

    ```python
    import jax, jax.numpy as jnp
    from jaxrock.compiler import lane_function

    def root(a):  # of x^2 = a, by Newton's steps
        return jax.lax.while_loop(lambda x: abs(x * x - a) > 1e-6 * a, lambda x: (x + a / x) / 2, a)

    slopes = jax.vmap(jax.grad(lane_function(root, in_lanes=True)))(jnp.array([4.0, 9.0]))
    ```
    """
    two_pass = function if isinstance(function, TwoPass) else None
    one: Any = two_pass.accurate_only if two_pass is not None else function
    mode = Mode(mode)
    if IS_ORDINARY:
        return ordinary_lane_function(one, reverse, contract=mode != Mode.JVP)

    def run(tree):
        leaves, structure = jax.tree.flatten(tree)
        leaves = [_strong(x) for x in leaves]
        in_avals = [jax.ShapeDtypeStruct(jnp.shape(x), x.dtype) for x in leaves]
        told = None if key is None else key_of((key, structure.unflatten(in_avals)))
        known = results(structure.unflatten(in_avals)) if told is not None and results is not None else None
        fn = LaneFunction.of(
            one, structure, in_avals, told,
            two_pass=two_pass, reverse=reverse, results=known, in_lanes=in_lanes, refill=refill,
            mode=mode,
        )  # fmt: skip
        fn, leaves = _without_outside(fn, leaves)
        return computed(fn, leaves)

    return run


def _strong(x: Any) -> Any:
    x = narrowed(jnp.asarray(x))
    return jax.lax.convert_element_type(x, x.dtype) if getattr(x, "weak_type", False) else x


def _without_outside(fn: LaneFunction, leaves: list) -> tuple[LaneFunction, list]:
    """Return a lane function that captures no tracers, and its leaves, to which they are added.

    Such a function loses its fast pass and its reverse mode, which take no further leaves. Many points then run the
    accurate pass, and derivatives by many numbers are Jacobians.
    """
    if not fn.holds_traced:
        return fn, leaves
    program, shapes = fn.program, fn.results
    outside = [isinstance(x, jax.core.Tracer) for x in program.consts]
    more = [_strong(x) for x, traced in zip(program.consts, outside) if traced]
    count = len(leaves)

    def function(all_leaves):
        rest = iter(all_leaves[count:])
        consts = [next(rest) if traced else x for x, traced in zip(program.consts, outside)]
        found = jaxpr_as_fun(type(program)(program.jaxpr, consts))(*all_leaves[:count])
        return jax.tree.unflatten(jax.tree.structure(shapes), found)

    in_avals = [*fn.in_avals, *(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in more)]
    structure = jax.tree.structure(in_avals)
    kept = LaneFunction(
        function, structure, in_avals,
        in_lanes=fn.in_lanes, refill=fn.refill, mode=fn.mode,
    )  # fmt: skip
    return kept, [*leaves, *more]
