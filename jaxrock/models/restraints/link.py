"""A horizontal link with a memory: a tie that yields, or one that breaks.

The largest opening angle so far, on the side of the tie, tells how the tie acts: that angle is its whole memory. From
there on the tension is smooth in three intervals of the opening angle: slack, elastic, and at its strength (zero for
a broken tie).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxrock._core.types import Scalar
from jaxrock.compiler.hints import select
from jaxrock.models.equation import Angle
from jaxrock.numerics.elementary import arcsine, sine_cosine
from jaxrock.numerics.lookup import stretch_from

NEVER = 3.5  # an opening angle that no block reaches [rad]


class Onset(NamedTuple):
    """The opening angles at which a link becomes taut, and from which it has its full strength [rad]."""

    taut: Scalar
    sine: Scalar  # of the first
    full: Scalar
    broken: Bool[Array, ""]


class Link(eqx.Module):
    """A tie on one side of one block, with a memory; lengths over R, forces over m g."""

    height: Scalar
    stiffness: Scalar
    strength: Scalar
    damping: Scalar | None  # beside a tie that breaks, as long as it holds
    breaks: bool = eqx.field(static=True)

    @property
    def limit(self) -> Scalar:
        """Return the opening angle at which a new tie first has its strength [rad]; `NEVER` for one so soft."""
        sine = self.strength / (self.stiffness * self.height)
        soft = sine >= 1
        return select(soft, NEVER, arcsine(select(soft, 0.0, sine)))

    def onset(self, reached: Scalar) -> Onset:
        """Return where the tie acts after the block has reached an opening angle [rad]."""
        limit, zero = self.limit, jnp.zeros_like(reached)
        passed = reached >= limit
        if self.breaks:
            gone = select(passed, NEVER, zero)
            return Onset(gone, zero, select(passed, NEVER, limit), passed)
        full = select(passed, reached, limit)
        sine = select(passed, sine_cosine(full)[0] - self.strength / (self.stiffness * self.height), zero)
        return Onset(arcsine(sine), sine, full, jnp.zeros_like(passed))

    def ahead(
        self, at: Onset, opening: Scalar, outward: Bool[Array, ""]
    ) -> tuple[Int[Array, ""], Scalar, Bool[Array, ""]]:
        """Return the interval that holds an opening angle when moving outward or inward, and its end, if any."""
        return stretch_from(jnp.stack([jnp.zeros_like(opening), at.taut, at.full]), opening, outward)

    def tension(self, angle: Angle, at: Onset, interval: Int[Array, ""] | None = None) -> Scalar:
        """Return the tension over m g, in an interval, which continues smoothly beyond its ends; None: where the angle
        lies."""
        if interval is None:
            interval = (angle.value >= at.taut) + 1 * (angle.value >= at.full)
        elastic = self.stiffness * self.height * (angle.sine - at.sine)
        full = jnp.zeros_like(elastic) if self.breaks else self.strength + jnp.zeros_like(elastic)
        return select(interval == 0, 0.0, select(interval == 1, elastic, full))

    def moment(self, angle: Angle, at: Onset, interval: Int[Array, ""] | None = None) -> Scalar:
        """Return the moment of the tension over m g R."""
        return self.tension(angle, at, interval) * self.height * angle.cosine

    def slope(self, angle: Angle, at: Onset) -> Scalar:
        """Return the derivative of the moment by the angle, where the angle lies."""
        elastic = (angle.value >= at.taut) & (angle.value < at.full)
        stiff = select(elastic, self.stiffness * (self.height * angle.cosine) ** 2, 0.0)
        return stiff - self.tension(angle, at) * self.height * angle.sine

    def drag(self, angle: Angle, at: Onset) -> Any:
        """Return the moment of the damper over the velocity."""
        if self.damping is None:
            return 0.0
        return select(at.broken, 0.0, self.damping * (self.height * angle.cosine) ** 2)

    def work(self, opening: Scalar, at: Onset) -> Scalar:
        """Return the work against the tension up to an opening angle, over m g R."""
        sine, full = (sine_cosine(jnp.minimum(x, jnp.pi / 2))[0] for x in (opening, at.full))
        stretched = jnp.clip(sine, at.sine, full) - at.sine
        elastic = self.stiffness * (self.height * stretched) ** 2 / 2
        if self.breaks:
            return select(at.broken, 0.0, elastic)
        return elastic + self.strength * self.height * jnp.maximum(sine - full, 0.0)

    def most_work(self, angle: Angle, at: Onset) -> Scalar:
        """Return a bound of the work against the tension from an angle to pi/2, over m g R."""
        return select(at.broken, 0.0, self.strength * self.height * (1 - angle.sine))
