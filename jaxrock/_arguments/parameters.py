"""Parameters of blocks, motions and models: declared once, as fields, where checks, fits and derivatives find them.

    class Ramp(rk.motions.AbstractMotion):
        amplitude: jax.Array = rk.parameter("g")
        corners: jax.Array = rk.parameter("s", "positive", axes=1)

A declared number may differ from scene to scene (a scene is a block under a motion): it is checked, fitted, and a
variable of derivatives. All scenes share an array that is declared with axes. They also share undeclared arrays of an
object that holds many scenes (a suite, critical amplitudes of many blocks). Undeclared numbers are parameters of
unknown unit and range.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, dataclass_transform

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxrock._arguments.ranges import RANGES, Range, finite, one_of
from jaxrock._core.arrays import check_shapes, is_concrete, is_traced, to_device
from jaxrock._core.throwing import throws


class Parameter(NamedTuple):
    """Declaration of a parameter: unit, range and role."""

    unit: str = "-"
    range: Range = finite
    symbol: str = ""
    axes: int | None = 0  # number of axes in one scene; None: any
    follows: str = ""  # property with its value where the field is None
    is_free: bool = True  # False: it only repeats another parameter
    argument: str = ""  # name of the argument of the owner's maker, if another
    is_whole: bool = False  # whether it is a count or an index, and stays an integer


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
    - `symbol`: symbol in formulas; empty: the name.
    - `axes`: 0 for a number, 1 for an array that all scenes share (samples of a record).
    - `follows`: name of the property that has its value where the field is None.
    - `is_free`: whether it can be varied independently of other parameters.
    - `argument`: its name as an argument of the owner's maker, if that is not the name of the field.
    - `is_whole`: whether it is a count or an index, which stays an integer. All other numbers of a block or a motion
      become floating-point numbers.

    **Returns:** a field for an Equinox module. A value outside of its range raises ValueError where an object is made;
    traced values are not checked.
    """
    if not isinstance(range, Range):
        range = RANGES[one_of("range", range, tuple(RANGES))]
    return eqx.field(metadata={"parameter": Parameter(unit, range, symbol, axes, follows, is_free, argument, is_whole)})


def declared(kind: type) -> dict[str, Parameter]:
    """Return the parameters that a class declares, by the names of its fields."""
    fields = dataclasses.fields(kind)
    return {field.name: field.metadata["parameter"] for field in fields if "parameter" in field.metadata}


def set_parameters(owner: eqx.Module, **values: Any) -> None:
    """Check values against their declarations, and set them: for the owner's `__init__`.

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
    """Return whether an object's class belongs to the package, and not to the user."""
    return type(owner).__module__.partition(".")[0] == __name__.partition(".")[0]


def check_declared(owner: eqx.Module) -> None:
    """Raise ValueError for a value outside of the range that a user's class declares: for `__check_init__`.

    Classes of the package check their own arguments. Traced values and None are not checked. Nothing is raised under
    `throw=False`.
    """
    kind = type(owner)
    if is_ours(owner) or not throws():
        return
    for name, known in declared(kind).items():
        value = getattr(owner, name)
        if value is None or is_traced(value):
            continue
        called = known.argument or name
        if isinstance(value, dict | eqx.Module):
            for leaf in leaves_of(value, (called,), known):
                leaf.declared.range(leaf.name, leaf.value)
            continue
        known.range(called, value)
        if isinstance(value, (list, tuple)):
            raise ValueError(f"Argument `{called}` must be a number or an array, as of `numpy.asarray`, but is a list.")


if TYPE_CHECKING:

    @dataclass_transform(field_specifiers=(parameter, eqx.field, dataclasses.field))
    class Owner(eqx.Module):
        """Base of classes that declare parameters: to type checkers, `parameter(...)` is a field, and no default."""
else:
    Owner = eqx.Module


class Leaf(NamedTuple):
    """An array in a tree of modules, with its path and its declaration."""

    path: tuple[str, ...]
    value: Any
    declared: Parameter

    @property
    def name(self) -> str:
        """Return the path, joined by dots; a number of a part of a composed motion has the part's name in front."""
        return ".".join(self.path)

    @property
    def is_shared(self) -> bool:
        """Return whether all scenes share it."""
        return self.declared.axes != 0

    @property
    def is_number(self) -> bool:
        """Return whether it is one number of a scene that derivatives may be taken by."""
        one = self.declared.axes == 0 or jnp.ndim(self.value) == 0
        free = self.declared.is_free and not self.declared.is_whole
        return one and free and jnp.issubdtype(jnp.result_type(self.value), jnp.inexact)


def leaves_of(owner: Any, path: tuple[str, ...] = (), known: Parameter = _UNDECLARED) -> Iterator[Leaf]:
    """Yield all leaves of a tree, in the order of `jax.tree.leaves`.

    A module that has a method `parameter_path` names what it holds. The method takes the path of fields to a leaf,
    within the module, and returns the path in its name; or None for a leaf that is no parameter.
    """
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
            held = leaves_of(getattr(owner, field.name), (field.name,), own)
            yield from (leaf._replace(path=(*path, *leaf.path)) for leaf in _renamed(owner, held))


def _renamed(owner: eqx.Module, leaves: Iterator[Leaf]) -> Iterator[Leaf]:
    """Yield leaves with the names that their owner gives them; those without a name are no parameters."""
    named = getattr(owner, "parameter_path", None)
    if named is None:
        yield from leaves
        return
    for leaf in leaves:
        told = named(leaf.path)
        if told is None:
            yield leaf._replace(declared=leaf.declared._replace(is_free=False))
        else:
            yield leaf._replace(path=tuple(told))


def with_values(owner: Any, values: Mapping[str, Any]) -> Any:
    """Return the owner with new values of the named parameters, which may lie in modules, dictionaries, lists or
    tuples."""
    leaves = [values.get(leaf.name, leaf.value) if leaf.is_number else leaf.value for leaf in leaves_of(owner)]
    return jax.tree.unflatten(jax.tree.structure(owner), leaves)


def _is_module(value: Any) -> bool:
    return isinstance(value, eqx.Module)


def shared(owner: Any) -> Any:
    """Return a tree like the owner: for each leaf, whether all scenes share it."""
    return jax.tree.unflatten(jax.tree.structure(owner), [leaf.is_shared for leaf in leaves_of(owner)])


def broadcast(owner: Any, shape: tuple[int, ...]) -> Any:
    """Return the owner with every number of a scene broadcast to a shape; shared leaves stay."""

    def of(x, own):
        if own or jnp.shape(x) == shape:
            return x
        return jnp.broadcast_to(x, shape) if is_traced(x) else to_device(np.broadcast_to(np.asarray(x), shape))

    return jax.tree.map(of, owner, shared(owner))


def one_of_many(owners: Any, index: Any) -> Any:
    """Return one of many owners in one tree, whose numbers have a leading axis."""

    def one(x):
        return to_device(np.asarray(x)[np.asarray(index)]) if is_concrete((x, index)) else x[index]

    return jax.tree.map(lambda x, own: x if own else one(x), owners, shared(owners))


def in_precision(owner: Any, dtype: Any) -> Any:
    """Return the owner with its numbers cast to a floating-point type, except declared integers and undeclared
    booleans."""

    def of(leaf):
        is_flag = leaf.declared.axes is None and jnp.issubdtype(jnp.result_type(leaf.value), jnp.bool_)
        return leaf.value if leaf.declared.is_whole or is_flag else jnp.asarray(leaf.value, dtype)

    return jax.tree.unflatten(jax.tree.structure(owner), [of(leaf) for leaf in leaves_of(owner)])


def in_real_numbers(*owners: Any) -> tuple:
    """Return owners with integers cast to a floating-point type, unless they are declared as integers.

    Programs that are compiled for floating-point numbers then serve them, too.
    """
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
