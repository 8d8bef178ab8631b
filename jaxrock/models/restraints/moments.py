"""The moments of a block with restraints: those of the free block, and those of tendons, ties and dampers.

With the opening angle x, velocity x' = dx/d(p t), weight 1 + v, side s and ground acceleration u [g]

    x'' = -[(1 + v) restoring(x) + s u arm(x) + restraint(x) + damping(x) x'].

Divided by sin(x), restoring moment and restraints together fall from 0 to pi, for every tendon and tie: the block has
one unstable equilibrium, beyond which no forcing of the same sign holds it better.
"""

import functools
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxrock._core.types import Scalar
from jaxrock.compiler.hints import select
from jaxrock.models.coefficients import Coefficients
from jaxrock.models.equation import AbstractMoments, Angle, Summit
from jaxrock.models.restraints.link import Link, Onset
from jaxrock.models.terms import TermGroups, Terms
from jaxrock.numerics.elementary import sine_cosine
from jaxrock.numerics.roots import bracketed_root


class RestrainedMoments(AbstractMoments):
    """The moments that act on a block with restraints, on one of its corners."""

    free: Coefficients
    static_terms: Terms | None
    damping_terms: Terms | None
    links: tuple[Link, ...] = ()
    onsets: tuple[Onset, ...] = ()  # where the links act, as far as they remember
    intervals: tuple[Int[Array, ""], ...] | None = None  # of the links, in which they act; None: where the angle lies
    known_saddle: Scalar | None = None
    broken_saddle: Scalar | None = None  # the saddle after a tie has broken
    summit: Summit | None = None  # of new restraints; None: the moment only falls

    @classmethod
    def of(
        cls, free: Coefficients, static: Terms | None, damping: Terms | None, links: tuple[Link, ...]
    ) -> "RestrainedMoments":
        """Build the moments of a block that has not rocked; its saddle is found once."""
        new = tuple(link.onset(jnp.zeros_like(free.restoring_at_rest)) for link in links)
        made = cls(free.bare, static, damping, links, new)
        if static is None and not links:
            return replace(made, known_saddle=free.saddle)
        lasting = tuple(link for link in links if not link.breaks)
        saddle = broken = _saddle(free, static, lasting)
        if len(lasting) < len(links):
            # A tie that breaks before the block is in balance leaves it to the others there, or where these hold it.
            (brittle,) = (link for link in links if link.breaks)
            endless = replace(brittle, strength=jnp.full_like(broken, jnp.inf))
            saddle = jnp.maximum(broken, jnp.minimum(_saddle(free, static, (endless, *lasting)), brittle.limit))
        made = replace(made, known_saddle=saddle, summit=_summit(free, static, links, saddle))
        return replace(made, broken_saddle=broken) if len(lasting) < len(links) else made

    # ---- What the engines ask ----

    @property
    def has_series(self) -> bool:
        """Return whether no link has a memory."""
        return not self.links

    @property
    def is_damped(self) -> bool:
        """Return whether there is a damper."""
        return self.damping_terms is not None or any(link.damping is not None for link in self.links)

    @property
    def remembers(self) -> bool:
        """Return whether the moments depend on the largest opening angle so far."""
        return bool(self.links)

    def remembering(self, reached: Scalar) -> "RestrainedMoments":
        """Return the moments after the block has reached an opening angle on this side [rad]."""
        return replace(self, onsets=tuple(link.onset(reached) for link in self.links))

    @property
    def has_broken(self) -> Bool[Array, ""]:
        """Return whether a tie has broken on this side."""
        return functools.reduce(jnp.logical_or, [at.broken for at in self.onsets])

    def largest_drop(self, angle: Angle) -> Scalar:
        """Return the moment over m g R that a tie loses where it breaks."""
        lost = [link.strength * link.height * angle.cosine for link in self.links if link.breaks]
        return sum(lost, start=jnp.zeros_like(angle.cosine))

    @property
    def groups(self) -> TermGroups:
        """Return the terms by what multiplies them."""
        return TermGroups(self.free.restoring_terms, self.free.arm_terms, self.static_terms, self.damping_terms)

    def with_groups(self, groups: TermGroups) -> "RestrainedMoments":
        """Return other moments of this kind, of these terms alone."""
        return RestrainedMoments(self.free.with_groups(groups), groups.restraint, groups.damping)

    @property
    def bare(self) -> "RestrainedMoments":
        """Return the moments without what is known of their balance."""
        return replace(self, known_saddle=None, summit=None)

    @property
    def trigonometric(self) -> bool:
        """Return whether there is a term in a sine or a cosine."""
        return self.groups.trigonometric

    def times(self, factor: Scalar | float) -> "RestrainedMoments":
        """Refuse: restraints hold symmetric blocks, whose sides share their unit of time."""
        raise ValueError("Argument `block` must be a symmetric `Block` for a model with restraints.")

    # ---- Moments ----

    def _restraint(self, angle: Angle) -> Any:
        """Return the moment of all restraints, over m g R."""
        found = 0.0 if self.static_terms is None else self.static_terms.at(angle)
        intervals = self.intervals or (None,) * len(self.links)
        for link, at, interval in zip(self.links, self.onsets, intervals):
            found = found + link.moment(angle, at, interval)
        return found

    def _drag(self, angle: Angle) -> Any:
        """Return the moment of all dampers over the velocity."""
        found = 0.0 if self.damping_terms is None else self.damping_terms.at(angle)
        for link, at in zip(self.links, self.onsets):
            found = found + link.drag(angle, at)
        return found

    def acceleration(self, angle: Angle, velocity: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return the acceleration of the opening angle per (p t)^2; push = side u, weight = 1 + v (None: 1)."""
        found = self.free.acceleration(angle, velocity, push, weight) - self._restraint(angle)
        return found - self._drag(angle) * velocity if self.is_damped else found

    def restoring(self, angle: Angle) -> Scalar:
        """Return the restoring moment of weight and restraints over m g R at an opening angle."""
        return self.free.restoring(angle) + self._restraint(angle)

    def arm(self, angle: Angle) -> Scalar:
        """Return the overturning moment over m R u g at an opening angle."""
        return self.free.arm(angle)

    def repulsion(self, angle: Angle, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return the rate at which nearby angles diverge, per angle; dampers, which bring them together, are left
        out."""
        found = self.free.repulsion(angle, push, weight)
        if self.static_terms is not None:
            found = found - self.static_terms.slope(angle)
        for link, at in zip(self.links, self.onsets):
            found = found - link.slope(angle, at)
        return found

    def fall(self, angle: Angle) -> Scalar:
        """Return how far the restoring moment changes from an opening angle to the balance."""
        moment = self.restoring(angle)
        if self.summit is None:
            return moment
        found = self.summit.fall(angle, moment)
        return select(self.has_broken, moment, found) if self.broken_saddle is not None else found

    @property
    def fall_at_rest(self) -> Scalar:
        """Return `fall` at rest."""
        rest = self.restoring_at_rest
        return rest if self.summit is None else self.summit.fall_at_rest(rest)

    @property
    def restoring_at_rest(self) -> Scalar:
        """Return the restoring moment just after uplift: sin(alpha) (1 + prestress)."""
        free = self.free.restoring_at_rest
        return free if self.static_terms is None else free + self.static_terms.at(Angle(jnp.zeros_like(free), 0.0, 1.0))

    @property
    def arm_at_rest(self) -> Scalar:
        """Return the overturning arm just after uplift."""
        return self.free.arm_at_rest

    @property
    def threshold_of_weight(self) -> Scalar:
        """Return the threshold of the free block, which alone changes with the weight [g]."""
        return self.free.threshold

    @property
    def saddle(self) -> Scalar:
        """Return the opening angle of the unstable equilibrium [rad]; it may lie beyond pi/2."""
        known = self.known_saddle
        assert known is not None
        if self.broken_saddle is None:
            return known
        return select(self.has_broken, self.broken_saddle, known)

    @property
    def stiffness(self) -> Scalar:
        """Return the rate at which the restoring moment falls at the saddle."""
        if self.static_terms is None and not self.links:
            return self.free.stiffness
        return jnp.abs(self.repulsion(Angle.of(self.saddle), jnp.zeros_like(self.saddle)))

    @property
    def steepest(self) -> Scalar:
        """Return a bound of the rate at which the restoring moment changes with the angle."""
        found = self.free.steepest
        if self.static_terms is not None:
            rates = (0.0, 1.0, 1.0, 1.0, 0.5, 0.5, 2.0, 2.0)
            pairs = zip(rates, self.static_terms.coefficients)
            found = found + sum(rate * jnp.abs(c) for rate, c in pairs if c is not None)
        return found + sum((link.stiffness * link.height**2 for link in self.links), start=0.0)

    @property
    def steepest_start(self) -> Scalar:
        """Return the bound of the rate at which the restoring moment changes."""
        return self.steepest

    def work(self, opening: Scalar) -> Scalar:
        """Return the work against weight and restraints up to an opening angle, over m g R."""
        smooth = AbstractMoments.work(replace(self, links=(), onsets=()), opening)
        return smooth + sum((link.work(opening, at) for link, at in zip(self.links, self.onsets)), start=0.0)

    # ---- Bounds of what is still to come ----

    def held_manifold(self, angle: Angle, hold: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar:
        """Return an upper bound of the velocity that reaches the unstable equilibrium, or pi/2 before it.

        It is infinite for a damped block, and for a model whose restoring moment has a constant or a line.
        """
        moment, arm, factor = self.free.restoring_terms, self.free.arm_terms, 1.0 if weight is None else weight
        if self.is_damped or any(c is not None for c in (moment.constant, moment.line, arm.constant, arm.line)):
            return jnp.full_like(hold, jnp.inf)
        # The work from here on is at most that of the sinusoid up to its zero, and of restraints up to pi/2.
        pairs = (moment.sine, arm.sine), (moment.cosine, arm.cosine)
        sine, cosine = (factor * _or_zero(own) + push * _or_zero(pushed) for own, pushed in pairs)
        work = jnp.sqrt(sine**2 + cosine**2) + sine * angle.cosine - cosine * angle.sine
        if self.static_terms is not None:
            work = work + _most_work(self.static_terms, angle)
        work = work + sum((link.most_work(angle, at) for link, at in zip(self.links, self.onsets)), start=0.0)
        return jnp.sqrt(2 * jnp.maximum(work, 0.0))

    def unheld_manifold(self, angle: Angle, hold: Scalar, push: Scalar, weight: Scalar | None = None) -> Scalar | float:
        """Return zero where no moment further on can hold the block, else infinity."""
        if self.static_terms is None and not self.links:
            return self.free.unheld_manifold(angle, hold, push, weight)
        # Over sin(x), the moments fall as long as the one at rest, with the forcing, is positive (module docstring).
        factor = 1.0 if weight is None else weight
        falls = factor * self.free.restoring_at_rest + push * self.free.arm_at_rest >= 0
        for link, at in zip(self.links, self.onsets):  # a slack tie may still hold the block
            if not link.breaks:
                falls = falls & (angle.value >= at.full)
        return select(falls, 0.0, jnp.inf)

    # ---- Links, which act differently from one opening angle to the next ----

    @property
    def bends(self) -> int:
        """Return the number of opening angles at which links become taut, or have their strength."""
        return 2 * len(self.links)

    def ahead(self, opening: Scalar, outward: Bool[Array, ""]) -> tuple["RestrainedMoments", Scalar]:
        """Return the moments of the intervals that act from an opening angle on, and the next angle that ends one."""
        found = [link.ahead(at, opening, outward) for link, at in zip(self.links, self.onsets)]
        nearest = select(outward, jnp.asarray(jnp.pi, opening.dtype), -1.0)
        for _, end, ends in found:
            closer = ends & select(outward, end < nearest, end > nearest)
            nearest = select(closer, end, nearest)
        bend = select(nearest < 0, jnp.pi, nearest)
        return replace(self, intervals=tuple(interval for interval, _, _ in found)), bend


def _or_zero(coefficient: Any) -> Any:
    return 0.0 if coefficient is None else coefficient


def _most_work(terms: Terms, angle: Angle) -> Scalar:
    """Return a bound of the work against restraints from an angle to pi/2, term by term."""
    left, half = jnp.pi / 2 - angle.value, sine_cosine(angle.value / 2)[0]
    of_sines = angle.cosine, 1 - angle.sine, left, 2 * (0.5**0.5 - half), angle.cosine**2, left
    pairs = zip(terms.coefficients, (left, 2 * left, *of_sines))
    most = [jnp.abs(c) * work for c, work in pairs if c is not None]
    return jnp.maximum(sum(most, start=jnp.zeros_like(left)), 0.0)


def _saddle(free: Coefficients, static: Terms | None, links: tuple[Link, ...]) -> Scalar:
    """Return the zero of the restoring moment of a block whose ties are new, between 0 and pi."""
    like = jnp.zeros_like(free.restoring_at_rest)
    return bracketed_root(_new_moment, like, like + jnp.pi, *_numbers(free, static, links))


def _summit(free: Coefficients, static: Terms | None, links: tuple[Link, ...], saddle: Scalar) -> Summit:
    """Return the largest restoring moment of a block whose ties are new; a tie that breaks holds."""
    numbers, zero = _numbers(free, static, links), jnp.zeros_like(saddle)
    rises = _new_slope(zero, *numbers) > 0
    angle = select(rises, bracketed_root(_new_slope, zero, jnp.minimum(saddle, jnp.pi / 2), *numbers), 0.0)
    angle = jax.lax.stop_gradient(angle)  # the moment is stationary there
    return Summit(angle, _new_moment(angle, *numbers))


def _numbers(free: Coefficients, static: Terms | None, links: tuple[Link, ...]) -> list[Scalar]:
    """Return the coefficients of all terms, and three numbers of each link."""
    like = jnp.zeros_like(free.restoring_at_rest)
    total = free.restoring_terms if static is None else free.restoring_terms.plus(static)
    numbers = [like if c is None else like + c for c in total.coefficients]
    return numbers + [like + x for link in links for x in (link.height, link.stiffness, link.strength)]


def _new_moment(x: Scalar, *numbers: Scalar) -> Scalar:
    """Return the restoring moment of all terms, and of ties that are new: three numbers for each."""
    half, cosine = sine_cosine(x / 2)  # to rounding up to pi
    angle = Angle(x, 2 * half * cosine, 1 - 2 * half**2)
    found = Terms(*numbers[:8]).at(angle)
    for k in range(8, len(numbers), 3):
        height, stiffness, strength = numbers[k : k + 3]
        found = found + jnp.minimum(stiffness * height * angle.sine, strength) * height * angle.cosine
    return found


def _new_slope(x: Scalar, *numbers: Scalar) -> Scalar:
    """Return the derivative of `_new_moment` by the angle."""
    return jax.jvp(lambda x: _new_moment(x, *numbers), (x,), (jnp.ones_like(x),))[1]
