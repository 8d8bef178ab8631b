"""A viscous damper, as a hinge or as a link."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import ArrayLike

from jaxrock._arguments.annotations import arguments
from jaxrock._arguments.parameters import parameter, set_parameters
from jaxrock._arguments.ranges import not_negative
from jaxrock._core.types import Real
from jaxrock.blocks.rigid import Block
from jaxrock.models.restraints.restraint import AbstractRestraint, RestraintTerms
from jaxrock.models.terms import Terms
from jaxrock.numerics.elementary import sine_cosine


class Damper(AbstractRestraint):
    """A linear viscous damper between the block and the ground.

    With the velocity x' = dx/d(p t) of the opening angle its moment over m g R is

    - damping x' without further arguments: a hinge at the base;
    - damping sin^2(alpha) cos^2(x/2) x' along the centre line (`centre=True`), like a `Tendon`;
    - damping height^2 cos^2(x) x' in a horizontal link at a height, like a `Tie`.

    **Arguments:**

    - `damping`: 0 or more; of a hinge, moment over angular velocity [m g R/p]; of a link, force over velocity
      [m g/(R p)].
    - `centre`: whether it is a link along the centre line.
    - `height`: height over the pivot at which a horizontal link holds the block [R], 0 or more. None: no such link.

    **Raises:** ValueError for a value outside its range, and for a link of both kinds.

    **Source:** derived here.
    """

    damping: Real = parameter("m g R/p", not_negative)
    height: Real | None = parameter("R", not_negative)
    centre: bool = eqx.field(static=True)

    @arguments
    def __init__(self, damping: ArrayLike, *, centre: bool = False, height: ArrayLike | None = None):
        if centre and height is not None:
            raise ValueError("Argument `height` must be None for a damper along the centre line.")
        self.centre, self.height = centre, None
        set_parameters(self, damping=damping, **({} if height is None else {"height": height}))

    @property
    def only_damps(self) -> bool:
        """Return True."""
        return True

    def terms(self, block: Block) -> RestraintTerms:
        """Return the moment over the velocity."""
        return RestraintTerms(damping=self._terms(block))

    def _terms(self, block: Block) -> Terms:
        if self.centre:
            half = self.damping * sine_cosine(block.alpha)[0] ** 2 / 2
            return Terms(constant=half, cosine=half)  # cos^2(x/2) = (1 + cos x)/2
        if self.height is not None:
            return of_horizontal_damper(self.damping, self.height)
        return Terms(constant=jnp.asarray(self.damping))


def of_horizontal_damper(damping: Real, height: Real) -> Terms:
    """Return the moment over the velocity of a horizontal damper: damping height^2 cos^2(x)."""
    half = damping * height**2 / 2
    return Terms(constant=half, double_cosine=half)  # cos^2(x) = (1 + cos 2x)/2
