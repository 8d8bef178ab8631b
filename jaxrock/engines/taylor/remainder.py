"""What a series leaves out: how large the terms after its last may be, and how far that lets a step go.

Of any ground the last terms tell: those after them are taken to be no larger. Where a record runs along a straight line
the equation tells more, for it makes every term of those two and more before it: x_{k+2} has over them the square of
the time, and how fast the moment changes with the angle, over (k + 1)(k + 2).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Inexact

from jaxrock.engines.taylor.expansion import Start
from jaxrock.models.coefficients import Terms
from jaxrock.motions.shaking import Shaking
from jaxrock.numerics.polynomial import last_size, length_within

Scalar = Inexact[Array, ""]

# What is between the last terms and those after them is made of products of terms; these bound all but one of a
# thousand starts, however steep the line (`tests/test_remainder.py`).
_MARGIN, _EARLIER = 16.0, 0.5


class Remainder(NamedTuple):
    """Of a series about the start of a step, in units of its time."""

    size: Scalar  # after a step of one unit
    degree: int  # how it grows with the step

    @classmethod
    def of(cls, start: Start, terms: list[Scalar], is_record: bool) -> "Remainder":
        """Of the series of the opening angle; `is_record`: the pieces of the motion are short beside 1/p, mostly."""
        if is_record and _is_line(start.shaking):
            return cls(_following(start, terms), len(terms))
        return cls(last_size(terms), len(terms) - 1)

    def at(self, length: Scalar) -> Scalar:
        """How large it is after a step of this length."""
        return self.size * length**self.degree

    def reach(self, least: Scalar, cap: Scalar) -> Scalar:
        """The step after which it is as small as that, at most `cap`."""
        return length_within(self.size, self.degree, least, cap)


def _is_line(shaking: Shaking) -> bool:
    """Whether the acceleration of the ground changes in proportion to time."""
    return all(terms is None or len(terms) <= 2 for terms in shaking)


def _following(start: Start, terms: list[Scalar]) -> Scalar:
    """Size of the terms that would come next."""
    moments, (horizontal, vertical) = start.moments, start.shaking
    size = jnp.abs(horizontal[0])
    weight = 1.0 if vertical is None else 1 + jnp.abs(vertical[0])
    pull = weight * _steepest(moments.restoring_terms) + size * _steepest(moments.arm_terms)
    steep = start.stretch + jnp.abs(start.speed)
    steep = steep + sum(jnp.abs(c) for component in (horizontal, vertical or []) for c in component[1:])
    order, share = len(terms) - 1, _EARLIER * steep
    last = jnp.abs(terms[-1]) + jnp.abs(terms[-2]) + share * (jnp.abs(terms[-3]) + share * jnp.abs(terms[-4]))
    return _MARGIN / (order * (order + 1)) * start.stretch**2 * pull * last


def _steepest(moment: Terms) -> Scalar:
    """Bound of how fast a moment changes with the angle."""
    slopes = [jnp.abs(c) for c in (moment.line, moment.sine, moment.cosine) if c is not None]
    return sum(slopes, start=jnp.zeros(()))
