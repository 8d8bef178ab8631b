"""Parameters of blocks, motions and models: declared once, with their fields, and found there by whoever needs them.

    class Ramp(rk.motions.AbstractMotion):
        amplitude: jax.Array = rk.parameter("g")
        corners: jax.Array = rk.parameter("s", "positive", axes=1)

A declared number is one for each scene: it is checked, fitted, differentiated by, and may differ from lane to lane. An
array that is declared with axes belongs to the whole, and all scenes share it. What is not declared all scenes share,
too, where they lie in one object (a suite, critical amplitudes of many blocks); its numbers are parameters of unknown
unit and range.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, dataclass_transform

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxrock._checks import RANGES, Range, check_shapes, finite, is_at_hand, is_traced, one_of, placed, throws


class Parameter(NamedTuple):
    """What is known of a parameter beforehand."""

    unit: str = "-"
    range: Range = finite
    symbol: str = ""
    axes: int | None = 0  # of one owner; None: any
    follows: str = ""  # the property that tells its value where it is not given
    is_free: bool = True  # whether it is one of its own: what only repeats another is not
    argument: str = ""  # of the owner's maker, where it has another name
    is_whole: bool = False  # whether it counts, or is a place, and stays a whole number


_UNDECLARED = Parameter(axes=None)


def parameter(
    unit: str,
    range: Range | str = finite,
    *,
    symbol: str = "",
    axes: int = 0,
    follows: str = "",
    is_free: bool = True,
    argument: str = "",
    is_whole: bool = False,
) -> Any:
    """Declare a field of a block, a motion or a model as a parameter.

    **Arguments:**

    - `unit`: such as "rad", "s", "g", or "-".
    - `range`: the numbers that are allowed: "positive", "not_negative" (0 or more), "finite", "acute" (in (0, pi/2)),
      "share" (in [0, 1]), or "not_nan"; "size" (1e-9 to 1e9: lengths, times), "rate" (1e-6 to 1e6: frequency
      parameters), "ratio" (the same), or "strength" (up to 1e9 in size: accelerations).
    - `symbol`: as formulas write it; empty: the name.
    - `axes`: 0 for a number, 1 for a list that belongs to the whole (samples of a record).
    - `follows`: name of the property that tells its value where the field is None.
    - `is_free`: whether it can be varied by itself.
    - `argument`: what the owner's maker calls it, if not by the name of the field.
    - `is_whole`: whether it is a count or a place among others, which stays a whole number. All other numbers of a
      block or a motion are real, of whatever kind they are given.

    **Returns:** a field for an Equinox module. A value outside of its range raises ValueError where an object is made;
    of traced ones nothing is asked.
    """
    if not isinstance(range, Range):
        range = RANGES[one_of("range", range, tuple(RANGES))]
    return eqx.field(metadata={"parameter": Parameter(unit, range, symbol, axes, follows, is_free, argument, is_whole)})


def declared(kind: type) -> dict[str, Parameter]:
    """The parameters that a class declares, by the names of its fields."""
    fields = dataclasses.fields(kind)
    return {field.name: field.metadata["parameter"] for field in fields if "parameter" in field.metadata}


def set_parameters(owner: eqx.Module, **values: Any) -> None:
    """Check values by what is declared of them, and set them: for the owner's `__init__`.

    **Raises:** ValueError for a value outside its range.
    """
    known = declared(type(owner))
    for name, value in values.items():
        called = known[name].argument or name
        array = known[name].range(called, value)
        if array.size == 0:
            raise ValueError(f"Argument `{called}` must hold at least one number, but has shape {array.shape}.")
        setattr(owner, name, array)
    check_shapes(**{known[name].argument or name: getattr(owner, name) for name in values if known[name].axes == 0})


def is_ours(owner: Any) -> bool:
    """Return whether an object's class is one of the package, and not of the user's own."""
    return type(owner).__module__.partition(".")[0] == __name__.partition(".")[0]


def check_declared(owner: eqx.Module) -> None:
    """Raise ValueError for a value outside of what a class of the user's own declares: for `__check_init__`.

    Classes of the package check what they are given themselves. What is traced is not looked at, nor what stands for a
    value (None), and nothing is raised where numbers outside of their ranges do not.
    """
    kind = type(owner)
    if is_ours(owner) or not throws():
        return
    for name, known in declared(kind).items():
        value = getattr(owner, name)
        if value is None or is_traced(value):
            continue
        called = known.argument or name
        known.range(called, value)
        if isinstance(value, (list, tuple)):
            raise ValueError(f"Argument `{called}` must be a number or an array, as of `numpy.asarray`, but is a list.")


if TYPE_CHECKING:

    @dataclass_transform(field_specifiers=(parameter, eqx.field, dataclasses.field))
    class Owner(eqx.Module):
        """What declares parameters: so checkers know that `parameter(...)` is a field, and no default."""
else:
    Owner = eqx.Module


class Leaf(NamedTuple):
    """An array in a tree of modules: where it is, and what is declared of it."""

    path: tuple[str, ...]
    value: Any
    declared: Parameter

    @property
    def name(self) -> str:
        """The path in words; parts of a motion made of motions have the part's name in front."""
        return ".".join(self.path)

    @property
    def is_shared(self) -> bool:
        """Return whether it belongs to the whole, and not to one scene of many."""
        return self.declared.axes != 0

    @property
    def is_number(self) -> bool:
        """Return whether it is one number for a scene, by which derivatives may be taken."""
        one = self.declared.axes == 0 or (self.declared.axes is None and jnp.ndim(self.value) == 0)
        free = self.declared.is_free and not self.declared.is_whole
        return one and free and jnp.issubdtype(jnp.result_type(self.value), jnp.inexact)


def leaves_of(owner: Any, path: tuple[str, ...] = (), known: Parameter = _UNDECLARED) -> Iterator[Leaf]:
    """All leaves of a tree, in the order of `jax.tree.leaves`."""
    if not isinstance(owner, eqx.Module):
        for keys, value in jax.tree_util.tree_leaves_with_path(owner, is_leaf=_is_module):
            inner = (*path, *(jax.tree_util.keystr((key,), simple=True) for key in keys))
            if _is_module(value):
                yield from leaves_of(value, inner)
            else:
                yield Leaf(inner, value, known)
        return
    for field in dataclasses.fields(owner):
        if not field.metadata.get("static", False):
            own = field.metadata.get("parameter", _UNDECLARED)
            yield from leaves_of(getattr(owner, field.name), (*path, field.name), own)


def with_values(owner: Any, values: Mapping[str, Any]) -> Any:
    """Return the owner with new values of the named parameters, which may lie in modules, dictionaries, lists or
    tuples."""
    leaves = [values.get(leaf.name, leaf.value) if leaf.is_number else leaf.value for leaf in leaves_of(owner)]
    return jax.tree.unflatten(jax.tree.structure(owner), leaves)


def _is_module(value: Any) -> bool:
    return isinstance(value, eqx.Module)


def shared(owner: Any) -> Any:
    """A tree like the owner, of whether a leaf belongs to the whole."""
    return jax.tree.unflatten(jax.tree.structure(owner), [leaf.is_shared for leaf in leaves_of(owner)])


def broadcast(owner: Any, shape: tuple[int, ...]) -> Any:
    """The owner with every number of a scene broadcast to a shape; what is shared stays."""

    def of(x, own):
        if own or jnp.shape(x) == shape:
            return x
        return jnp.broadcast_to(x, shape) if is_traced(x) else placed(np.broadcast_to(np.asarray(x), shape))

    return jax.tree.map(of, owner, shared(owner))


def one_of_many(owners: Any, index: Any) -> Any:
    """One of many owners in one tree, whose numbers have a leading axis."""

    def one(x):
        return placed(np.asarray(x)[np.asarray(index)]) if is_at_hand((x, index)) else x[index]

    return jax.tree.map(lambda x, own: x if own else one(x), owners, shared(owners))


def in_precision(owner: Any, dtype: Any) -> Any:
    """Return the owner with its numbers cast to a floating-point type, except declared integers and undeclared
    booleans."""

    def of(leaf):
        is_flag = leaf.declared.axes is None and jnp.issubdtype(jnp.result_type(leaf.value), jnp.bool_)
        return leaf.value if leaf.declared.is_whole or is_flag else jnp.asarray(leaf.value, dtype)

    return jax.tree.unflatten(jax.tree.structure(owner), [of(leaf) for leaf in leaves_of(owner)])


def in_real_numbers(*owners: Any) -> tuple:
    """Owners, with numbers that are whole, but not declared so, as real ones: what is compiled for real ones serves
    them, too."""
    leaves = jax.tree.leaves(owners)
    if not any(_is_whole(leaf) for leaf in leaves):
        return owners
    kind = jnp.result_type(*leaves)
    kind = kind if jnp.issubdtype(kind, jnp.inexact) else jnp.result_type(float)
    return tuple(in_precision(owner, kind) for owner in owners)


def _is_whole(leaf: Any) -> bool:
    return leaf.dtype.kind in "biu" if hasattr(leaf, "dtype") else isinstance(leaf, int)


def check_single(**owners: Any) -> None:
    """Raise ValueError where a parameter of one scene is an array outside of `jax.vmap`."""
    for name, owner in owners.items():
        for leaf in leaves_of(owner):
            known = leaf.declared
            if known.axes is not None and jnp.ndim(leaf.value) > known.axes:
                called = known.argument or leaf.name
                raise ValueError(
                    f"Argument `{name}` must hold one scene, but `{called}` has shape {jnp.shape(leaf.value)}. Use "
                    "jax.vmap for many."
                )
