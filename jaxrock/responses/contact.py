"""Forces between block and ground, which test pure rocking: the friction it needs, and whether contact persists."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Inexact

from jaxrock._arguments.annotations import arguments
from jaxrock._arguments.parameters import check_single
from jaxrock._arguments.ranges import scalar
from jaxrock._arguments.tables import AbstractTable, over_time
from jaxrock._core.arrays import is_traced, shown
from jaxrock._core.settings import called_by_users
from jaxrock._core.types import Scalar
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.restitution import Housner, ratio_of_inertia
from jaxrock.blocks.rigid import Block
from jaxrock.compiler.hints import jit_low_effort
from jaxrock.engines.scene import Scene
from jaxrock.models.equation import Angle, Rolled
from jaxrock.models.rolling import RollingMoments
from jaxrock.motions.shaking import Shaking
from jaxrock.responses.history import Response, evaluation
from jaxrock.responses.own_block import check_own

_WITHIN = 8  # parts of each step, at whose ends extremes are sought


class Contact(AbstractTable):
    """Forces of the ground on a block, over its weight, and the friction that they need.

    - `time`: (samples,) those of the response [s].
    - `horizontal`, `normal`: (samples,) force of the ground, in the direction of positive ground acceleration and
      upward, over m g [-].
    - `friction`: (samples,) coefficient of friction needed, |horizontal|/normal [-]; infinite without contact.
    - `friction_at_impact`: pair of coefficients that the impacts need which end the stay on side 1, and on side 2 [-].
      Without an impact it is the one that any impact would need.
    - `impacted`: pair of whether an impact ends a stay on side 1, and on side 2.
    - `largest_friction`, `least_normal`: extremes over the rocking below the unstable equilibrium, impacts not
      included, by parabolas through points of every step (1e-6 off where tests judge it). A toppling block may need any
      friction in the end.
    - `keeps_contact`: whether `least_normal` is positive.
    """

    time: Inexact[Array, " samples"]
    horizontal: Inexact[Array, " samples"]
    normal: Inexact[Array, " samples"]
    friction: Inexact[Array, " samples"]
    friction_at_impact: tuple[Scalar, Scalar]
    impacted: tuple[Bool[Array, "..."], Bool[Array, "..."]]
    largest_friction: Scalar
    least_normal: Scalar

    @property
    def _columns(self):
        names = ("horizontal", "normal", "friction")
        return over_time(self.time, {name: (getattr(self, name), "-") for name in names})

    @property
    def keeps_contact(self) -> Bool[Array, ""]:
        """Return whether the ground never had to pull."""
        return self.least_normal > 0

    @called_by_users
    def sticks(self, friction: ArrayLike) -> Bool[Array, "..."]:
        """Return whether a coefficient of friction [-] suffices, below the unstable equilibrium and at the impacts."""
        needed = self.largest_friction
        for happened, by_impacts in zip(self.impacted, self.friction_at_impact):
            needed = jnp.where(happened, jnp.maximum(needed, by_impacts), needed)
        return self.keeps_contact & (jnp.asarray(friction) >= needed)


@arguments
def contact_forces(
    response: Response, block: Block | AsymmetricBlock, inertia_ratio: ArrayLike | None = None
) -> Contact:
    """Compute the forces between block and ground along a response.

    Of a frame they are the sums under all columns, over its whole weight. One column may need more friction, and the
    beam slide on the columns before.

    **Arguments:**

    - `response`: of `simulate` with `Housner()`, `Linear()` or `Rolling(...)`, of one scene.
    - `block`: that of the response.
    - `inertia_ratio`: m R^2/I about a corner [-], in (0, 1], of a symmetric `Block`. None: that of its `Rolling`, or
      that of its law of restitution (of a block made with an inertia ratio), or 3/4, a rectangle's. An
      `AsymmetricBlock` has its own, and a frame the ratio that follows from its beam.

    **Returns:** a `Contact`.

    **Raises:** ValueError for a value outside its range, for another block or inertia ratio than that of the response,
    for a wall that opens to one side, whose neighbour's forces are unknown, and for a response of another model: with a
    spring, a restraint, or an equation of your own, the forces do not follow from the rotation alone. A class of models
    for which they do says so by `forces_follow`.

    **Source:** momentum of the centre of mass, on a circle about the corner, or as it rolls (Shenton 1996 for the
    beginning of rocking); at an impact, of the impulse that angular momentum about the new corner implies.
    """
    check_single(block=block)
    response.trajectory.check_single()
    if response.scene.only_side is not None:
        raise ValueError(
            "Argument `response` must not be of a wall that opens to one side: what stands behind it bears an unknown "
            "part of its forces."
        )
    if not response.scene.forces_follow:
        raise ValueError(
            "Argument `response` must be one with `Housner()`, `Linear()` or `Rolling(...)`, whose forces between "
            "block and ground follow from the rotation. With a `Spring`, restraints, a `Mechanism` or an equation of "
            "your own, they do not: compute them from the momentum of your bodies."
        )
    check_own(response.scene, block)
    if response.scene.is_frame != (isinstance(block, Block) and block.beam is not None):
        words = ("a frame", "one body") if response.scene.is_frame else ("one body", "a frame")
        raise ValueError(f"Argument `block` must be that of the response, which is {words[0]}, but is {words[1]}.")
    ratio = scalar("inertia_ratio", ratio_of_inertia("inertia_ratio", _ratio_of(response.scene, block, inertia_ratio)))
    return _contact(response, block, ratio)


def _ratio_of(scene: Scene, block: Block | AsymmetricBlock, given: ArrayLike | None) -> ArrayLike:
    """Return the inertia ratio that is given, or known for a symmetric block."""
    moments = scene.moments
    own, of = None, "`Rolling`"
    if isinstance(block, Block):
        own = moments.ratio if isinstance(moments, RollingMoments) else block.base_ratio
        of = of if block.beam is None else "frame"
    if given is None:
        known = block.law.inertia_ratio if isinstance(block.law, Housner) else None
        return own if own is not None else 0.75 if known is None else known
    if own is not None and not is_traced((own, given)) and not np.allclose(own, given, rtol=1e-5, atol=0):
        raise ValueError(f"Argument `inertia_ratio` must be {own:.6g} as that of the {of}, but is {shown(given)}.")
    return given


@jit_low_effort()
def _contact(response: Response, block: Block | AsymmetricBlock, ratio: Scalar) -> Contact:
    if isinstance(block, Block):
        ratios, alphas, radii = (ratio, ratio), (block.alpha, block.alpha), (jnp.ones_like(block.p),) * 2
        rates = block.p, block.p
    else:
        ratios, alphas = (block.inertia_ratio, block.inertia_ratio2), (block.alpha1, block.alpha2)
        radii = jnp.ones_like(block.p1), block.radius_ratio
        rates = block.p1, block.p2
    sides = [jnp.stack([jnp.asarray(x) for x in pair]) for pair in (ratios, alphas, rates)]
    time, rotation, velocity = response.time, response.rotation, response.velocity
    horizontal, normal = jax.vmap(lambda *at: _forces(response.scene, sides, *at))(time, rotation, velocity)
    largest, least = _extremes(response, sides)
    corners = [(r * jnp.sin(a), r * jnp.cos(a)) for r, a in zip(radii, alphas)]
    first, needed = _at_impacts(response, 1.0, *corners)
    second, needed2 = _at_impacts(response, -1.0, *corners[::-1])
    friction = _friction(horizontal, normal)
    # Samples lie between the points of steps, and cover a final rest, which has no steps.
    saddles = [moments.saddle for moments in response.scene.both_moments]
    below = jnp.abs(rotation) < jnp.where(rotation < 0, saddles[1], saddles[0])
    largest = jnp.maximum(largest, jnp.max(jnp.where(below, friction, 0.0)))
    least = jnp.minimum(least, jnp.min(jnp.where(below, normal, jnp.inf)))
    return Contact(time, horizontal, normal, friction, (needed, needed2), (first, second), largest, least)


def _at_impacts(
    response: Response, side: float, here: tuple[Scalar, Scalar], there: tuple[Scalar, Scalar]
) -> tuple[Bool[Array, ""], Scalar]:
    """Return whether impacts end a stay on a side, and the most friction that they need, or any would without impacts.

    `here`, `there`: horizontal and vertical distance of the centre from the corner that it leaves, and from the other.
    """
    scene, nodes = response.scene.on(side), response.trajectory.nodes
    # With a law that does not depend on the speed, all impacts need the same friction.
    ours = response.trajectory.impacted & (jnp.sign(nodes.impact_velocity) == -side)
    speeds = jnp.where(ours, jnp.abs(nodes.impact_velocity), 0.0)
    speeds = jnp.where(ours, speeds, speeds.max()) if scene.reset.depends_on_speed else speeds[:1]
    e = jax.vmap(scene.reset.ratio)(speeds)
    # The centre's velocity turns from across one corner's radius to across the other's.
    return ours.any(), jnp.max(jnp.abs(here[1] - e * there[1]) / (here[0] + e * there[0]))


def _friction(horizontal, normal):
    lost = normal <= 0  # false for NaN, too
    return jnp.where(lost, jnp.inf, jnp.abs(horizontal) / jnp.where(lost, 1.0, normal))


def _forces(scene: Scene, sides: list, time: Scalar, rotation: Scalar, velocity: Scalar, side: Scalar | None = None):
    """Return horizontal and normal force over m g at an instant; the ground bears a lying block, too."""
    acceleration, weight = _ground(scene, time)
    if side is None:
        side = jnp.where(rotation != 0, jnp.sign(rotation), jnp.sign(velocity))
    scene = scene.on(side)
    ratio, alpha, rate = (jnp.where(side < 0, values[1], values[0]) for values in sides)
    opening = side * rotation
    speed = side * velocity / rate
    push, own = side * acceleration, (rate / scene.p) ** 2
    angular = scene.moments.acceleration(Angle.of(opening), side * velocity / scene.p, push, weight) / own
    rolled = scene.moments.rolled(Angle.of(opening))
    # Without rolling, the centre moves on a circle about the corner.
    at = Rolled(jnp.cos(alpha - opening), jnp.sin(alpha - opening), jnp.zeros_like(alpha)) if rolled is None else rolled
    horizontal = acceleration + side * ratio * (at.height * angular + at.reach * speed**2)
    normal = weight + ratio * (at.reach * angular + (at.radius - at.height) * speed**2)
    still = (side == 0) | (opening >= jnp.pi / 2)
    return jnp.where(still, acceleration, horizontal), jnp.where(still, weight, normal)


def _ground(scene: Scene, time: Scalar) -> tuple[Scalar, Scalar]:
    """Return ground acceleration [g] and weight at a time, after a jump."""
    piece = jnp.searchsorted(scene.knots, time, side="right") - 1
    shaking: Shaking = scene.shaking(piece, time - scene.knots[piece], 0)[0]
    acceleration, weight = shaking.now
    return acceleration, jnp.ones_like(acceleration) if weight is None else weight


def _highest(values: Inexact[Array, " points"]) -> Scalar:
    """Return the maximum of a smooth function that is known at equal distances, by parabolas through each three
    points."""
    known = jnp.isfinite(values[:-2] + values[1:-1] + values[2:])
    left, middle, right = (jnp.where(known, each, 0.0) for each in (values[:-2], values[1:-1], values[2:]))
    top = (middle >= left) & (middle >= right) & known  # infinity would make reverse-mode derivatives NaN
    curvature = jnp.where(top & (2 * middle > left + right), 2 * middle - left - right, jnp.inf)
    rise = jnp.where(top, (right - left) ** 2, 0.0) / (8 * curvature)
    return jnp.maximum(jnp.max(values), jnp.max(jnp.where(top, middle + rise, -jnp.inf)))


@jax.jit
def _extremes(response: Response, sides: list) -> tuple[Scalar, Scalar]:
    """Return largest friction needed and least normal force below the saddle, over points in all steps."""
    path = response.trajectory
    stepper, nodes, times = path.stepper, path.nodes.start, path.times
    shares, follow = jnp.linspace(0.0, 1.0, _WITHIN + 1), evaluation(stepper)

    def step(node, start, end):
        # Infinity has NaN derivatives, even where a later `where` discards it.
        is_step, ends = jnp.isfinite(start), jnp.isfinite(end)
        start, end = jnp.where(is_step, start, 0.0), jnp.where(ends, end, 0.0)
        lasts = jnp.where(ends, end - start, 0.0)

        def at(share):
            rotation, velocity = follow(node, share * lasts)
            still = (share == 0) | (node.side == 0) | node.done
            opening = jnp.where(still, node.opening, node.side * rotation)
            speed = jnp.where(still, node.velocity * stepper.scene.p, node.side * velocity)
            # Just inside the step: an end may be a jump of the motion.
            time = start + jnp.clip(share, 1e-9, 1 - 1e-9) * lasts
            forces = _forces(stepper.scene, sides, time, node.side * opening, node.side * speed, node.side)
            below = opening < stepper.scene.on(node.side).moments.saddle
            counts = is_step & ~node.done & below
            return jnp.where(counts, _friction(*forces), 0.0), jnp.where(counts, forces[1], jnp.inf)

        friction, normal = jax.vmap(at)(shares)
        return _highest(friction), -_highest(-normal)

    following = jnp.concatenate([times[1:], jnp.full(1, jnp.inf, times.dtype)])
    friction, normal = jax.vmap(step)(nodes, times, following)
    return jnp.max(friction), jnp.min(normal)
