"""Values as they are given, whose derivatives follow a rule.

As by `jax.custom_jvp`, but one operation, of which JAX keeps the rule wherever it goes: where a `jax.lax.scan` is
differentiated in reverse and then once more, JAX 0.10 (0.12 does not) forgets that of `custom_jvp`, and second
derivatives lack what it tells, without a word.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jaxrock._settings import under_usual_settings

Tree = TypeVar("Tree")
_given_p = Primitive("given")
_given_p.multiple_results = True


class _Rule(NamedTuple):
    """`function(*settings, values, by, changes)`; printed without addresses, so that programs with it can be told."""

    function: Callable
    settings: tuple

    def __call__(self, values: Any, by: Any, changes: Any) -> Any:
        return self.function(*self.settings, values, by, changes)

    def __repr__(self) -> str:
        return f"{_printed(self.function)}({', '.join(map(_printed, self.settings))})"


def _printed(x: Any) -> str:
    return f"{x.__module__}.{x.__qualname__}" if hasattr(x, "__qualname__") else repr(x)


def given(rule: Callable, values: Tree, by: Any, *settings: Any) -> Tree:
    """`values`, whose changes are `rule(*settings, values, by, changes of by)`.

    `rule` is a function of a module, `settings` are static. Changes that are zero are `SymbolicZero`; to the values
    that the rule is given their derivatives belong, so that those of higher order follow.

    Raises ValueError for functions within others, which programs could not tell from each other.
    """
    for function in (rule, *settings):
        if "<" in getattr(function, "__qualname__", ""):
            raise ValueError(f"Argument `rule` must be a function of a module, but is {function.__qualname__}.")
    leaves, structure = _flat(values)
    more, of_by = _flat(by)
    found = _given_p.bind(
        *map(jnp.asarray, (*leaves, *more)), rule=_Rule(rule, settings), structures=(structure, of_by)
    )
    return structure.unflatten(found)


def _flat(tree: Any) -> tuple[list, Any]:
    return jax.tree.flatten(tree)


def is_zero(change: Any) -> bool:
    """Return whether a change is zero whatever the numbers are."""
    return isinstance(change, SymbolicZero)


def along(function: Callable, by: Any, changes: Any) -> Any:
    """How `function(by)` changes along `changes`, as rules are given them."""
    leaves, structure = _flat(by)
    told = structure.flatten_up_to(changes)
    moving = [(x, d) for x, d in zip(leaves, told) if not is_zero(d)]

    def of_moving(*own):
        rest = iter(own)
        return function(structure.unflatten([x if is_zero(d) else next(rest) for x, d in zip(leaves, told)]))

    return jax.jvp(of_moving, [x for x, _ in moving], [d for _, d in moving])[1]


@under_usual_settings
def _moved(leaves, changes, *, rule, structures):
    structure, of_by = structures
    values = _given_p.bind(*leaves, rule=rule, structures=structures)
    changes = changes[structure.num_leaves :]
    if all(type(change) is ad.Zero for change in changes):
        return values, [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in values]
    told = [SymbolicZero(d.aval) if type(d) is ad.Zero else d for d in changes]
    by = leaves[structure.num_leaves :]
    found = rule(structure.unflatten(values), of_by.unflatten(by), of_by.unflatten(told))
    return values, structure.flatten_up_to(found)


def _of_many(rule: Callable, axes: tuple, values: Any, by: Any, changes: Any) -> Any:
    """A rule under `jax.vmap`, where values have a leading axis, and of `by` the leaves with an axis 0."""
    own, structure = _flat(by)
    told = structure.flatten_up_to(changes)
    moving = [d for d in told if not is_zero(d)]

    def one(values, own, moving):
        rest = iter(moving)
        return rule(
            values, structure.unflatten(own), structure.unflatten([d if is_zero(d) else next(rest) for d in told])
        )

    return jax.vmap(one, (0, list(axes), [axis for axis, d in zip(axes, told) if not is_zero(d)]))(values, own, moving)


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
    return _given_p.bind(*values, *leaves[count:], rule=rule, structures=structures), [0] * count


def _first(structures, leaves) -> list:
    return list(leaves[: structures[0].num_leaves])


_given_p.def_impl(lambda *leaves, rule, structures: _first(structures, leaves))
_given_p.def_abstract_eval(lambda *types, rule, structures: _first(structures, types))
batching.primitive_batchers[_given_p] = _batched
ad.primitive_jvps[_given_p] = _moved
mlir.register_lowering(_given_p, lambda context, *leaves, rule, structures: _first(structures, leaves))
