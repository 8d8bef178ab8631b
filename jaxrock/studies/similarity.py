"""Scale laws: the dimensionless and orientationless groups in which blocks and motions of all sizes are one.

The rocking of a slender block under a motion of given form, with peak a_g and frequency omega_g, depends on three
numbers: omega_g/p, g alpha/a_g and the restitution. That of any rigid block depends on cos(alpha) besides, and on
g tan(alpha)/a_g; as long as rotations are small, dividing them by cos(alpha) makes up for it.

**Source:** Dimitrakopoulos & DeJong (2012), sections 4 to 6.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Inexact

from jaxrock._arguments import arguments
from jaxrock._checks import as_real, one_of, size
from jaxrock.blocks.rigid import Block
from jaxrock.responses.history import Response

Real = Inexact[Array, "..."]
KINDS = ("slender", "rigid")


class Groups(eqx.Module):
    """What is the same for all blocks and motions that respond alike.

    - `frequency_ratio`: omega_g/p [-].
    - `strength`: g alpha/a_g (slender) or g tan(alpha)/a_g (rigid) [-]: one over the intensity.
    - `restitution`: [-].
    - `cos_alpha`: None for slender blocks, for which it plays no part.
    """

    frequency_ratio: Real
    strength: Real
    restitution: Real
    cos_alpha: Real | None = None


class Scales(eqx.Module):
    """What one unit of a dimensionless result is: divide by it on the way in, multiply on the way out.

    - `time`: [s]; `rotation`: [rad]; `velocity`: [rad/s].
    """

    time: Real
    rotation: Real
    velocity: Real


@arguments
def groups(block: Block, amplitude: ArrayLike, frequency: ArrayLike, kind: str = "rigid") -> Groups:
    """The groups of a block under a motion.

    **Arguments:**

    - `block`: a `Block`.
    - `amplitude`: peak a_g of the motion [g], positive.
    - `frequency`: its angular frequency omega_g [rad/s], positive; 2 pi over the period of a pulse.
    - `kind`: "rigid" for any block, "slender" for one in the linear model.

    **Returns:** `Groups`.

    **Source:** Dimitrakopoulos & DeJong (2012), equations 4.11 (slender) and 5.3 (rigid).
    """
    amplitude, frequency = size("amplitude", amplitude), size("frequency", frequency)
    if block.law.depends_on_speed:
        raise ValueError("Argument `block` must have a restitution that does not depend on the speed of impacts.")
    if one_of("kind", kind, KINDS) == "slender":
        return Groups(frequency / block.p, block.alpha / amplitude, block.restitution)  # 4.11
    return Groups(frequency / block.p, jnp.tan(block.alpha) / amplitude, block.restitution, jnp.cos(block.alpha))  # 5.3


@arguments
def block(groups: Groups, amplitude: ArrayLike, frequency: ArrayLike) -> Block:
    """The slender block that has these groups under a motion with this peak [g] and angular frequency [rad/s].

    **Raises:** ValueError for groups of the kind "rigid", whose alpha is given: ask for the motion instead.
    """
    if groups.cos_alpha is not None:
        raise ValueError("Argument `groups` must be of slender blocks: a rigid one's alpha is given. Use `motion`.")
    alpha = groups.strength * size("amplitude", amplitude)
    return Block(alpha, size("frequency", frequency) / groups.frequency_ratio, groups.restitution)


@arguments
def motion(groups: Groups, block: Block, form: Callable):
    """The motion under which a block has these groups.

    **Arguments:**

    - `groups`: `Groups`; if of rigid blocks, with the cosine of `block.alpha`.
    - `block`: a `Block` of any size.
    - `form`: makes a motion from peak [g] and period [s], such as `SinePulse`.

    **Returns:** what `form` makes.
    """
    threshold = block.alpha if groups.cos_alpha is None else jnp.tan(block.alpha)
    return form(threshold / groups.strength, 2 * jnp.pi / (groups.frequency_ratio * block.p))


@arguments
def scales(block: Block, amplitude: ArrayLike | None = None, kind: str = "rigid") -> Scales:
    """The units in which responses of similar blocks are one curve.

    **Arguments:**

    - `block`: a `Block`.
    - `amplitude`: peak a_g of the motion [g]: rotations are measured by the motion. None: by alpha.
    - `kind`: "slender", or "rigid": with an amplitude, rotations are also divided by cos(alpha), which makes the
      response of blocks with different alpha nearly one as long as rotations are small.

    **Returns:** `Scales`.

    **Source:** Dimitrakopoulos & DeJong (2012), equations 4.10, 4.11 and 6.1.
    """
    factor = jnp.cos(block.alpha) if one_of("kind", kind, KINDS) == "rigid" else jnp.ones_like(block.alpha)
    rotation = block.alpha if amplitude is None else size("amplitude", amplitude) * factor
    return Scales(1 / block.p, rotation, block.p * rotation)


@arguments
def master_curve(response: Response, scales: Scales, dimensionless_time: ArrayLike) -> tuple[Real, Real]:
    """Rotation and velocity of a response in dimensionless terms.

    **Arguments:**

    - `response`: result of `simulate`.
    - `scales`: from `scales`.
    - `dimensionless_time`: p t, (n,).

    **Returns:** (rotation, velocity) over their scales, (n,) each.

    **Source:** Dimitrakopoulos & DeJong (2012), figures 6 and 11.
    """
    rotation, velocity = response(as_real("dimensionless_time", dimensionless_time) * scales.time)
    return rotation / scales.rotation, velocity / scales.velocity
