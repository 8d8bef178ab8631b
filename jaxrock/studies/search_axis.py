"""Search axes for critical values: z is the logarithm of a factor, on the motion or on its times."""

import abc
import operator
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxrock._arguments.parameters import is_ours, one_of_many
from jaxrock._core.arrays import is_traced
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block
from jaxrock.compiler.hints import jit_low_effort
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.models.equation import AbstractEquation, Angle
from jaxrock.models.mechanism import Mechanism
from jaxrock.models.user_equation import Equation
from jaxrock.responses.outcome import outcome
from jaxrock.status import Status, is_decided
from jaxrock.studies.parameters import amplitude_of, named, rebuilt, rebuilt_model, scaled_motion

_NEAR = 1e-2  # margin of a scene that is near its balance


def known_margin(margin, status: Status):
    """Return the margin, NaN where the scene was not computed, and whether its verdict is open.

    A verdict that holds counts, however chaotic the peak. Two kinds of scenes are too close to call: those near their
    balance, and those that chaos leaves open. Near the balance the margin is zero within its error, which a search for
    its zeros closes in on, so those count, too. How near errors leave it open depends on the engine.
    """
    is_close = status == Status.undecided
    return jnp.where(is_decided(status) | is_close, margin, jnp.nan), is_close & ~(abs(margin) < _NEAR)


class AbstractVaried(eqx.Module):
    """Scenes of one block, motion and model along a line of factors."""

    model: AbstractEquation
    engine: AbstractEngine | None

    @abc.abstractmethod
    def scene(self, z, block, motion):
        """Return the scene at a factor e^z."""

    @abc.abstractmethod
    def unit(self, block, motion):
        """Return the quantity that the factor multiplies."""

    @abc.abstractmethod
    def units(self, both, amplitude):
        """Return `unit` for many scenes, from block and motion of arrays and known amplitudes."""

    @abc.abstractmethod
    def amplitude(self, value, own):
        """Return the amplitude of the motion at a critical value; `own`: the amplitude of the motion as it is [g]."""

    @abc.abstractmethod
    def keeps(self, name: str) -> bool:
        """Return whether the critical value depends on a parameter."""

    def margin(self, z, block, motion):
        """Return margin and outcome of the scene with the factor e^z."""
        result = outcome(*self.scene(z, block, motion), self.model, engine=self.engine)
        return result.margin, result

    def at(self, z, block, motion):
        """Return the margin (NaN where unknown), its slope, the number of impacts, and whether the verdict is open."""
        margin, slope, result = jax.jvp(
            lambda z: self.margin(z, block, motion), (z,), (jnp.ones_like(z),), has_aux=True
        )
        margin, is_open = known_margin(margin, result.status)
        return margin, slope, result.impact_count, is_open

    def slopes(self, z, block, motion, peak):
        """Return derivatives of the critical z by the parameters; `peak`: that of the motion [g]."""
        known = named(block, motion, self.model, peak)

        def margin(z, values):
            varied = replace(self, model=rebuilt_model(self.model, known | values))
            return varied.margin(z, *rebuilt(block, motion, known | values, known["amplitude"]))[0]

        by_z, by_values = jax.jacfwd(margin, argnums=(0, 1))(z, self._kept(known))
        by_z = jnp.where(by_z == 0, jnp.nan, by_z)
        return {name: -slope / by_z for name, slope in by_values.items()}

    def slopes_of_unit(self, block, motion, peak):
        """Return derivatives of the logarithm of `unit` by the parameters; `peak`: that of the motion [g]."""
        known = named(block, motion, self.model, peak)

        def unit(values):
            return jnp.log(self.unit(*rebuilt(block, motion, known | values, known["amplitude"])))

        return jax.jacfwd(unit)(self._kept(known))

    def _kept(self, known):
        return {name: jnp.asarray(value) for name, value in known.items() if self.keeps(name)}


class Amplitude(AbstractVaried):
    """Search over the amplitude of the motion."""

    def scene(self, z, block, motion):
        """Return the scene at a factor; a NaN factor marks an unknown scene, whose outcome is NaN too."""
        return block, scaled_motion(motion, jnp.exp(z))

    def unit(self, block, motion):
        """Return the amplitude of the motion [g], which the factor multiplies."""
        return jnp.abs(amplitude_of(motion))

    def units(self, both, amplitude):
        """Return the amplitudes of many scenes [g]."""
        return amplitude

    def amplitude(self, value, own):
        """Return the critical value itself, which is an amplitude [g]."""
        return value

    def keeps(self, name: str) -> bool:
        """Return whether the critical value depends on a parameter."""
        return name != "amplitude"


class Duration(AbstractVaried):
    """Search over the duration of the motion, by way of p: only the product of p and time counts."""

    def scene(self, z, block, motion):
        """Return the scene at a factor e^z, with p larger by that factor in place of a longer motion."""
        return faster(block, jnp.exp(z)), motion

    def unit(self, block, motion):
        """Return the duration of the motion [s], which the factor multiplies."""
        return motion.end

    def units(self, both, amplitude):
        """Return the durations of the motions of many scenes [s]."""
        return _ends(both, amplitude.size)

    def amplitude(self, value, own):
        """Return the amplitude of the motion as it is [g]."""
        return own

    def keeps(self, name: str) -> bool:
        """Return whether the critical value depends on a parameter."""
        return name not in ("duration", "period", "dt")


@jit_low_effort(eqx.filter_jit)
def _ends(both, size: int):
    """Return the ends of the motions of `size` scenes."""
    return jax.vmap(lambda index: one_of_many(both, index)[1].end)(jnp.arange(size))


def faster(block: Block | AsymmetricBlock, factor) -> Block | AsymmetricBlock:
    """Return a smaller block of the same shape: its frequency parameters times a factor."""
    name = "p" if isinstance(block, Block) else "p1"
    return eqx.tree_at(operator.attrgetter(name), block, getattr(block, name) * factor)


def check_sizeless(block: Block | AsymmetricBlock, model: AbstractEquation) -> None:
    """Raise ValueError where the restitution or a user's model depends on block size other than through p times time.

    Traced arguments are only checked for a dependence on the speed of impacts.
    """
    if block.law.depends_on_speed:  # a longer motion is taken as a larger p, which makes impacts faster
        raise ValueError("Argument `block` must have a restitution that does not depend on the speed of impacts.")
    if is_traced((block, model)):
        return
    block = jax.tree.map(lambda x: jnp.ravel(x)[0], block)
    two = block, faster(block, 1.7)
    names = ("restitution",) if isinstance(block, Block) else ("restitution1", "restitution2")
    one, other = ([getattr(each, name) for name in names] for each in two)
    if not np.allclose(one, other, rtol=1e-9, atol=0, equal_nan=True):
        raise ValueError("Argument `block` must have a restitution that does not depend on its p.")
    if is_ours(model) and not isinstance(model, Equation | Mechanism):
        return
    one, other = (_accelerations(model, each) for each in two)
    if not np.allclose(one, other, rtol=1e-9, atol=0, equal_nan=True):
        raise ValueError("Argument `model` must not depend on the block's p: a longer motion is taken as a larger p.")


@jit_low_effort()
def _accelerations(model: AbstractEquation, block: Block | AsymmetricBlock):
    """Sample accelerations of each side, over its p squared."""
    found = []
    for side in (block,) if isinstance(block, Block) else block.sides:
        moments = model.moments(side)
        for share, velocity, push in ((0.0, 0.0, 1.0), (0.3, -0.4, 0.5), (0.8, 0.6, -0.7)):
            angle = Angle.of(share * side.alpha)
            found.append(moments.acceleration(angle, velocity * side.alpha, push * jnp.ones_like(side.alpha)))
    return jnp.stack(found)


@eqx.filter_custom_jvp
def on_border(z, found, balanced, scene):
    """Attach the derivatives of the implicit function (the margin stays zero) to ends `z` found without derivatives.

    `scene`: the search axis, block and motion. Derivatives are NaN where the block does not come to balance, and zero
    where no end was found.
    """
    return z


@on_border.def_jvp
def _on_border_jvp(primals, tangents):
    z, found, balanced, scene = primals
    z = on_border(*primals)  # for derivatives of the next order

    moving = eqx.filter(scene, jax.tree.map(lambda x: x is not None, tangents[3], is_leaf=lambda x: x is None))

    def margins(z, moving):
        kind, *both = eqx.combine(moving, scene)
        return jax.vmap(lambda z: kind.margin(z, *both)[0])(z)

    # One linearization gives the derivatives by both.
    _, push = jax.linearize(margins, z, moving)
    change = push(jnp.zeros_like(z), tangents[3])
    slope = push(jnp.ones_like(z), jax.tree.map(jnp.zeros_like, tangents[3]))
    good = balanced & (slope != 0)
    rate = jnp.where(good, -1 / jnp.where(good, slope, 1.0), jnp.where(found, jnp.nan, 0.0))
    return z, rate * change
