"""Values with a rule for their tangents.

A primitive holds the rule, unlike `jax.custom_jvp`, so that JAX keeps it through every transformation. JAX 0.10 loses
the rule of a `custom_jvp` where a `jax.lax.scan` is differentiated in reverse and then once more: second derivatives
then silently lack it. JAX 0.12 keeps it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jaxrock._core.settings import under_usual_settings
from jaxrock.compiler.ordinary import IS_ORDINARY, ordinary_custom_tangent

Tree = TypeVar("Tree")
_custom_tangent_p = Primitive("custom_tangent")
_custom_tangent_p.multiple_results = True


class _Rule(NamedTuple):
    """A rule, `function(*settings, values, by, tangents)`; printed without addresses, so that jaxprs compare."""

    function: Callable
    settings: tuple

    def __call__(self, values: Any, by: Any, changes: Any) -> Any:
        return self.function(*self.settings, values, by, changes)

    def __repr__(self) -> str:
        return f"{_printed(self.function)}({', '.join(map(_printed, self.settings))})"


def _printed(x: Any) -> str:
    return f"{x.__module__}.{x.__qualname__}" if hasattr(x, "__qualname__") else repr(x)


def custom_tangent(rule: Callable, values: Tree, by: Any, *settings: Any) -> Tree:
    """Return `values`, with tangents that a rule computes from the tangents of `by`.

    **Arguments:**

    - `rule`: `rule(*settings, values, by, tangents)`, which returns the tangents of `values` as a tree like it. It must
      be a function at module level. It gets None for a tangent of `by` that is zero, and may return None for zero. The
      `values` that it gets have the same rule, so that derivatives of higher order follow.
    - `values`: arrays in a tree. Their own tangents are ignored.
    - `by`: arrays in a tree, on which the values depend.
    - `settings`: static arguments of the rule.

    **Returns:** `values`.

    **Raises:** ValueError for a rule or a setting that is a function defined within another one. Jaxprs could not
    distinguish it from others of that name.

    **Example:**

    ```python
    import jax, jax.numpy as jnp
    from jaxrock.compiler import custom_tangent
    from jaxrock.compiler.hints import stop_gradient

    def _implicit(x, a, da):  # from x^2 = a
        return da / (2 * x)

    def square_root(a):
        fixed = stop_gradient(a)
        x = jax.lax.fori_loop(0, 20, lambda _, x: (x + fixed / x) / 2, fixed)
        return custom_tangent(_implicit, x, a)

    slope = jax.grad(square_root)(4.0)
    ```
    """
    for function in (rule, *settings):
        if "<" in getattr(function, "__qualname__", ""):
            raise ValueError(f"Argument `rule` must be a function of a module, but is {function.__qualname__}.")
    if IS_ORDINARY:
        return ordinary_custom_tangent(rule, values, by, *settings)
    leaves, structure = _flat(values)
    more, of_by = _flat(by)
    found = _custom_tangent_p.bind(
        *map(jnp.asarray, (*leaves, *more)), rule=_Rule(rule, settings), structures=(structure, of_by)
    )
    return structure.unflatten(found)


def _flat(tree: Any) -> tuple[list, Any]:
    return jax.tree.flatten(tree)


@under_usual_settings
def _moved(leaves, changes, *, rule, structures):
    structure, of_by = structures
    values = _custom_tangent_p.bind(*leaves, rule=rule, structures=structures)
    changes = changes[structure.num_leaves :]
    if all(type(change) is ad.Zero for change in changes):
        return values, [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in values]
    told = [None if type(d) is ad.Zero else d for d in changes]
    by = leaves[structure.num_leaves :]
    found = structure.flatten_up_to(rule(structure.unflatten(values), of_by.unflatten(by), of_by.unflatten(told)))
    return values, [ad.Zero(jax.typeof(x).to_tangent_aval()) if d is None else d for x, d in zip(values, found)]


def _of_many(rule: Callable, axes: tuple, values: Any, by: Any, changes: Any) -> Any:
    """Map a rule over the leading axes of `values`, and of the leaves of `by` whose axis is 0."""
    own, structure = _flat(by)
    told = structure.flatten_up_to(changes)
    moving = [d for d in told if d is not None]

    def one(values, own, moving):
        rest = iter(moving)
        return rule(
            values, structure.unflatten(own), structure.unflatten([d if d is None else next(rest) for d in told])
        )

    return jax.vmap(one, (0, list(axes), [axis for axis, d in zip(axes, told) if d is not None]))(values, own, moving)


@under_usual_settings
def _batched(leaves, axes, *, rule, structures):
    count = structures[0].num_leaves
    size = next(x.shape[axis] for x, axis in zip(leaves, axes) if axis is not None)
    leaves = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(leaves, axes)]
    values = [
        jnp.broadcast_to(x, (size, *x.shape)) if axis is None else x for x, axis in zip(leaves[:count], axes[:count])
    ]
    flags = tuple(None if axis is None else 0 for axis in axes[count:])
    rule = _Rule(_of_many, (rule, flags))
    return _custom_tangent_p.bind(*values, *leaves[count:], rule=rule, structures=structures), [0] * count


def _first(structures, leaves) -> list:
    return list(leaves[: structures[0].num_leaves])


_custom_tangent_p.def_impl(lambda *leaves, rule, structures: _first(structures, leaves))
_custom_tangent_p.def_abstract_eval(lambda *types, rule, structures: _first(structures, types))
batching.primitive_batchers[_custom_tangent_p] = _batched
ad.primitive_jvps[_custom_tangent_p] = _moved
mlir.register_lowering(_custom_tangent_p, lambda context, *leaves, rule, structures: _first(structures, leaves))
