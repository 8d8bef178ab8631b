"""Parameters of a scene by name, for derivatives and fits."""

import operator
from collections import Counter

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxrock._arguments.parameters import Leaf, Parameter, declared, is_ours, leaves_of, with_values
from jaxrock._arguments.ranges import not_negative, share
from jaxrock._core.arrays import as_array
from jaxrock._core.types import Real
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.restitution import Constant, PerSide, tells_sides
from jaxrock.engines.scene import peak_bound
from jaxrock.models.equation import AbstractEquation
from jaxrock.motions.floors import Floor
from jaxrock.motions.motion import AbstractMotion, Scaled, Shifted, Summed
from jaxrock.motions.peaks import peaks_of_motion
from jaxrock.motions.pulses.mavroeidis_papageorgiou import MavroeidisPapageorgiouPulse
from jaxrock.responses.arguments import USUAL, AnyBlock


def named(
    block: AnyBlock, motion: AbstractMotion, model: AbstractEquation = USUAL, peak: Real | None = None
) -> dict[str, Real]:
    """Return parameters and their values, by name.

    The block declares `alpha` and `p`; an asymmetric one `alpha1`, `alpha2`, `p1`, `inertia_ratio` and `radius_ratio`.
    Its law adds `restitution`, or `restitution1` and `restitution2` of two sides, or parameters of its own, such as
    `restitution.gentle`. The motion adds parameters by its own names. A motion without `amplitude` [g] (a record) gets
    one: its peak, which scales all of it. Those of the model follow, by their paths, such as `model.edge.radius`.
    `peak`: that of the motion, where it is known.

    **Raises:** ValueError for a user's motion that has a parameter of the name of another, and for two parameters of
    one name, as of `{"a.b": 1.0, "a": {"b": 2.0}}`.
    """
    owners = {"block": _of_own(block), "motion": _numbers(motion), "model": _of_model(model)}
    for owner, leaves in owners.items():
        for name, count in Counter(leaf.name for leaf in leaves).items():
            if count > 1:
                raise ValueError(f"Argument `{owner}` has {count} parameters {name!r}: they need names of their own.")
    found = {name: getattr(block, name) for name in _declared(block)} | _of_law(block)
    moving = {leaf.name: as_array(leaf.value) for leaf in _numbers(motion)} | {"amplitude": amplitude_of(motion, peak)}
    modelled = named_of_model(model)
    for other, known in {"block": found, "model": modelled}.items():
        for name in known.keys() & moving:
            raise ValueError(f"Argument `motion` has a parameter {name!r}, as the {other} has: it needs another name.")
    return found | moving | modelled


def named_of_model(model: AbstractEquation) -> dict[str, Real]:
    """Return parameters of a model and their values, by name."""
    return {leaf.name: as_array(leaf.value) for leaf in _of_model(model)}


def amplitude_of(motion: AbstractMotion, peak: Real | None = None) -> Real:
    """Return the amplitude that a motion declares, or its peak [g], computed where it is not known."""
    own = [as_array(leaf.value) for leaf in _numbers(motion) if leaf.name == "amplitude"]
    if own:
        return own[0]
    return peak_of(motion) if peak is None else peak


def peak_of(motion: AbstractMotion) -> Real:
    """Return the peak acceleration [g], even where the bound that a motion declares lies above it.

    The bound is loose for a sum, whose peak may be far below the sum of its parts. It is loose, too, for a floor, for a
    pulse whose amplitude is not its peak, and for motions of the user's own.
    """
    parts = jax.tree.leaves(motion, is_leaf=_is_loose)
    return peaks_of_motion(motion)[0] if any(map(_is_loose, parts)) else peak_bound(motion)


def _is_loose(part) -> bool:
    """Return whether the declared bound of a motion may lie above its peak."""
    if not isinstance(part, AbstractMotion):
        return False
    return isinstance(part, Floor | Summed | MavroeidisPapageorgiouPulse) or not is_ours(part)


def declarations(block: AnyBlock, motion: AbstractMotion, model: AbstractEquation = USUAL) -> dict[str, Parameter]:
    """Return the declarations of the parameters that `named` names."""
    found = dict(_declared(block))
    own = {leaf.name: leaf.declared for leaf in _of_own(block)}
    if own:
        found |= own
    else:
        alone = len(_of_law(block)) == 1
        found |= {name: Parameter("-", share if alone else not_negative) for name in _of_law(block)}
    found |= {leaf.name: leaf.declared for leaf in (*_numbers(motion), *_of_model(model))}
    return {"amplitude": Parameter("g")} | found


def rebuilt(
    block: AnyBlock, motion: AbstractMotion, values: dict[str, Real], amplitude: Real | None = None
) -> tuple[AnyBlock, AbstractMotion]:
    """Rebuild the scene with other values of its parameters, differentiable by them.

    `amplitude`: the amplitude of the motion as it is, where it is known.

    A value that follows from other parameters (a restitution, from alpha) goes on following them: the difference
    between its new value and its present one is added to it.
    """
    return _rebuilt_block(block, values), _rebuilt_motion(motion, values, amplitude)


def rebuilt_model(model: AbstractEquation, values: dict[str, Real]) -> AbstractEquation:
    """Rebuild a model with other values of its parameters; the same object if none of them is its own."""
    own = {".".join(leaf.path[1:]): values[leaf.name] for leaf in _of_model(model) if leaf.name in values}
    return with_values(model, own) if own else model


def _rebuilt_block(block: AnyBlock, values: dict[str, Real]) -> AnyBlock:
    names = _declared(block)
    given = [name for name, known in names.items() if not known.follows]
    new = eqx.tree_at(lambda b: [getattr(b, name) for name in given], block, [values[name] for name in given])

    def following(name):
        return getattr(new, name) + (values[name] - jax.lax.stop_gradient(getattr(block, name)))

    for field, known in declared(type(block)).items():
        if known.follows:
            value = following(known.follows) if getattr(block, field) is None else values[known.follows]
            new = eqx.tree_at(operator.attrgetter(field), new, value, is_leaf=lambda x: x is None)
    own = _of_own(block)
    if own:
        law = with_values(block.law, {".".join(leaf.path[1:]): values[leaf.name] for leaf in own})
    elif not _of_law(block):
        return new
    elif len(_of_law(block)) == 1:
        value = values["restitution"] if isinstance(block.law, Constant) else following("restitution")
        law = eqx.tree_at(lambda constant: constant.value, Constant(0.0), value)
    else:
        pair = ("restitution1", "restitution2")
        pair = [values[name] if isinstance(block.law, PerSide) else following(name) for name in pair]
        law = eqx.tree_at(lambda both: (both.first, both.second), PerSide(0.0, 0.0), pair)
    return eqx.tree_at(lambda b: b.law, new, law, is_leaf=lambda x: x is block.law)


def _rebuilt_motion(motion: AbstractMotion, values: dict[str, Real], amplitude: Real | None) -> AbstractMotion:
    names = [leaf.name for leaf in _numbers(motion)]
    changed = with_values(motion, {name: values[name] for name in names})
    if "amplitude" not in names:
        peak = jax.lax.stop_gradient(peak_of(motion) if amplitude is None else amplitude)
        changed = scaled_motion(changed, values["amplitude"] / jnp.where(peak == 0, 1.0, peak))  # rest scales to rest
    return changed


def scaled_motion(motion: AbstractMotion, factor: Real) -> AbstractMotion:
    """Return a motion times a factor, unchecked: a NaN factor makes the outcome of the scene NaN."""
    return eqx.tree_at(lambda changed: changed.factor, Scaled(motion, jnp.ones_like(factor)), factor)


def _declared(block: AnyBlock) -> dict[str, Parameter]:
    """Return the declared parameters of a block by the names of the parameters."""
    return {known.follows or field: known for field, known in declared(type(block)).items() if known.is_free}


def _of_own(block: AnyBlock) -> list[Leaf]:
    """Return parameters of a law of restitution that is more than one number for each side."""
    if isinstance(block.law, Constant) or (isinstance(block.law, PerSide) and isinstance(block, AsymmetricBlock)):
        return []
    return [
        Leaf(("restitution", *leaf.path), leaf.value, leaf.declared) for leaf in leaves_of(block.law) if leaf.is_number
    ]


def _of_law(block: AnyBlock) -> dict[str, Real]:
    """Return parameters of the restitution; none for a law without numbers that is not one number for each side."""
    own = _of_own(block)
    if own:
        return {leaf.name: as_array(leaf.value) for leaf in own}
    if block.law.depends_on_speed:
        return {}
    if not isinstance(block, AsymmetricBlock) and tells_sides(block.law, block.corners):
        return {}
    if isinstance(block.law, Constant):
        return {"restitution": block.law.value}
    names = ("restitution1", "restitution2") if isinstance(block, AsymmetricBlock) else ("restitution",)
    return {name: getattr(block, name) for name in names}


def _of_model(model: AbstractEquation) -> list[Leaf]:
    """Return the single numbers of a model."""
    return [Leaf(("model", *leaf.path), leaf.value, leaf.declared) for leaf in leaves_of(model) if leaf.is_number]


def _numbers(motion: AbstractMotion) -> list[Leaf]:
    """Return the single numbers of a motion.

    For a scaled or shifted motion, or a floor, the factor and the amplitude of the inner pulse are left out: the
    amplitude of the whole motion replaces them.
    """
    inner, place = motion, ""
    while isinstance(inner, Floor | Scaled | Shifted):
        inner, place = inner.motion, f"{place}motion."
    return [leaf for leaf in leaves_of(motion) if leaf.is_number and not (place and leaf.name == f"{place}amplitude")]
