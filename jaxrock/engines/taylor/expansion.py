"""A Taylor step of a rocking block: the series of the opening angle, and the derivatives of the step's end.

The end of a step is linear in small changes of its start, of the forcing and of the model. Its weights follow from the
recurrence of the series run backwards, once for the angle and once for the velocity. Derivatives with respect to any
number of parameters therefore cost a few products each. The end time moves, too, where an event or a knot sets it.
"""

import functools
import operator
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxrock._core.types import Flag, Scalar
from jaxrock.compiler import custom_tangent
from jaxrock.compiler.hints import materialize, materialize_by, select, stop_gradient
from jaxrock.models.equation import Angle
from jaxrock.models.terms import UNIT_FUNCTION, Basis, TermGroups
from jaxrock.motions.shaking import Shaking
from jaxrock.numerics.elementary import sine_cosine
from jaxrock.numerics.polynomial import product_term, sum_of_products


class Start(NamedTuple):
    """The start of a step. The unit of time is free."""

    moments: Any  # `Coefficients` or `RestrainedMoments`: with `groups` of terms
    stretch: Scalar  # p times the unit of time
    side: Scalar
    uplifting: Flag  # leaves rest with zero acceleration
    opening: Scalar
    speed: Scalar  # of the opening, per unit
    shaking: Shaking  # Taylor coefficients of the ground acceleration [g]
    one: Scalar  # see `keep_by`

    @property
    def angle(self) -> Angle:
        """Return the opening angle with its sine and cosine."""
        angle = Angle.of(self.opening)
        return Angle(angle.value, materialize_by(angle.sine, self.one), materialize_by(angle.cosine, self.one))


class End(NamedTuple):
    """The end of a step, and the conditions that set it."""

    length: Scalar  # time from the start
    opening: Scalar
    speed: Scalar
    level: Scalar  # opening angle at which it ends where it `meets` it
    room: Scalar  # time at which it ends where it is `full`
    meets: Flag
    turns: Flag  # ends where the velocity vanishes
    full: Flag


class Expansion(NamedTuple):
    """Taylor coefficients about a start: the opening angle, its speed, the functions that terms multiply, the arm, and,
    where the ground moves vertically, the restoring moment."""

    opening: list[Scalar]
    speed: list[Scalar]
    functions: "BasisSeries"
    arm: list[Scalar | None]
    restoring: list[Scalar | None]


class BasisSeries(NamedTuple):
    """Series of the functions that terms multiply, as far as they are needed: lists that grow."""

    line: list
    sine: list
    cosine: list
    half_sine: list | None = None
    half_cosine: list | None = None
    double_sine: list | None = None
    double_cosine: list | None = None

    @classmethod
    def at(cls, start: Start) -> "BasisSeries":
        """Begin with the values at the start of a step."""
        groups, angle = start.moments.groups, start.angle
        half = double = (None, None)
        if groups.has_half:
            half = tuple([value] for value in sine_cosine(angle.value / 2))
        if groups.has_double:
            double = [2 * angle.sine * angle.cosine], [1 - 2 * angle.sine**2]
        return cls([angle.value, start.speed], [angle.sine], [angle.cosine], *half, *double)

    def extend(self, k: int, slopes: list, one: Scalar) -> None:
        """Append term k > 0 of every sine and cosine, by their own recurrences (Jorba & Zou 2005)."""
        pairs: list[tuple[list, list, float]] = [(self.sine, self.cosine, 1)]
        if self.half_sine is not None and self.half_cosine is not None:
            pairs.append((self.half_sine, self.half_cosine, 0.5))
        for sine, cosine, rate in pairs:
            sine.append(materialize_by(product_term(slopes, cosine, k - 1) * (rate / k), one))
            cosine.append(materialize_by(product_term(slopes, sine, k - 1) * (-rate / k), one))
        if self.double_sine is not None and self.double_cosine is not None:
            self.double_sine.append(materialize_by(2 * product_term(self.sine, self.cosine, k), one))
            self.double_cosine.append(materialize_by(-2 * product_term(self.sine, self.sine, k), one))

    def term(self, k: int) -> Basis:
        """Return term k; None where a series is shorter, or not needed."""
        later = (None if series is None or k >= len(series) else series[k] for series in self[1:])
        return Basis(UNIT_FUNCTION if k == 0 else None, self.line[k], *later)


def taylor_expansion(start: Start, order: int) -> Expansion:
    """Compute the series of x'' = -stretch^2 [(1 + v) restoring(x) + side u arm(x) + restraint(x) + damping(x) x'].

    The sine and cosine of the angle follow their own recurrences (Jorba & Zou 2005).
    """
    moments, one = start.moments, start.one
    functions, groups = BasisSeries.at(start), moments.groups
    x, slopes = functions.line, [start.speed]  # slopes: (k + 1) x_{k+1}
    arms, restorings, drags = [], [], []
    scale = materialize_by(-(start.stretch**2), one)
    pushes = [materialize_by(scale * start.side, one) * u for u in start.shaking.horizontal]
    scaled = groups.restoring.each(lambda c: materialize_by(scale * c, one))
    if groups.restraint is not None:
        scaled = scaled.plus(groups.restraint.each(lambda c: materialize_by(scale * c, one)))
    # Under a straight line every term is a few products, of the moment and the arm together; the oldest come first.
    straight = start.shaking.vertical is None and len(pushes) <= 2
    now, *before = (groups.arm.each(lambda c, push=push: materialize_by(push * c, one)) for push in pushes)
    now, last = now.plus(scaled), None
    for k in range(order - 1):
        if moments.trigonometric and k > 0:
            functions.extend(k, slopes, one)
        basis = functions.term(k)
        arm = groups.arm.summed(basis, empty=None)
        arms.append(arm if arm is None else materialize_by(arm, one))
        if straight:
            products = before[0].products(last) if before and last else []
            moment = functools.reduce(operator.add, products + now.products(basis))
        else:
            moment = product_term(pushes, arms, k)
            restoring = scaled.summed(basis, empty=None)
            moment = moment if restoring is None else moment + restoring
        last = basis
        if start.shaking.vertical is not None:
            restorings.append(groups.restoring.summed(basis, empty=None))
            moment = moment + scale * product_term(start.shaking.vertical, restorings, k)
        if groups.damping is not None:  # speeds are per unit of time: stretch times those per p t
            drags.append(groups.damping.summed(basis, empty=None))
            moment = moment - start.stretch * product_term(slopes, drags, k)
        slope = materialize_by(moment * (1 / (k + 1)), one)
        if k == 0:
            slope = select(start.uplifting, 0.0, slope)  # by continuity, exactly
        slopes.append(slope)
        x.append(slope * (1 / (k + 2)))
    return Expansion(x, slopes, functions, arms, restorings)


class _Weights(NamedTuple):
    """Derivatives of the end of a step (its angle, or its velocity) with respect to its inputs."""

    start: Start  # the weights in place of the values; zero for side and uplifting

    def times(self, change: Start) -> Any:
        """Return the change of the end."""
        pairs = zip(*(jax.tree.leaves(x, is_leaf=lambda x: x is None) for x in (self.start, change)), strict=True)
        return _summed((weight, moved) for weight, moved in pairs if moved is not None)


def _summed(pairs: Iterable[tuple[Scalar, Scalar]]) -> Any:
    """Return the sum of the products of pairs."""
    factors = list(zip(*pairs))
    return sum_of_products(*factors) if factors else 0.0


def _weighed(terms: list | None, vertical: list[Scalar] | None, order: int, like: Scalar) -> list | None:
    """Return a series times 1 + v, where the model has that series."""
    if vertical is None or terms is None or len(terms) < order - 1:
        return terms
    return [terms[k] + materialize(product_term(vertical, terms, k), like) for k in range(order - 1)]


class _Sources(NamedTuple):
    """The series that coefficients of moments multiply: of the restoring moment times 1 + v, of the arm times u, of
    restraints times 1, of dampers times the velocity."""

    restoring: Basis
    arm: Basis
    restraint: Basis
    damping: Basis

    @classmethod
    def of(cls, start: Start, series: Expansion, order: int, like: Scalar) -> "_Sources":
        """Compute them from the series of a step."""
        horizontal, vertical = start.shaking
        groups, functions = start.moments.groups, series.functions
        trigonometric = groups.arm.trigonometric

        def times(factors, terms):
            products = (product_term(factors, terms, k) for k in range(order - 1))
            return [materialize(x, start.stretch) for x in products]

        plain = functions.line, functions.sine, functions.cosine
        needed = groups.arm.line is not None, trigonometric, trigonometric
        pushed = [times(horizontal, terms) if wanted else None for wanted, terms in zip(needed, plain)]
        constant = [jnp.ones_like(like)] + [None if vertical is None else jnp.zeros_like(like)] * (order - 2)
        weighed = (_weighed(terms, vertical, order, start.stretch) for terms in (constant, *plain))
        one = [jnp.ones_like(like)]
        own = Basis() if groups.restraint is None else Basis(one, *functions)
        dragged = Basis()
        if groups.damping is not None:
            speed = [x * (1 / start.stretch) for x in series.speed]
            later = (terms if terms is None or len(terms) < order - 1 else times(speed, terms) for terms in functions)
            dragged = Basis(speed[: order - 1], *later)
        return cls(Basis(*weighed), Basis(horizontal, *pushed), own, dragged)

    def pulls(self, start: Start, order: int) -> list[Scalar]:
        """Return the Taylor coefficients of the derivative of the moment with respect to the angle."""
        groups, side = start.moments.groups, start.side
        is_line = not groups.trigonometric and groups.arm.line is None
        constant_pull = is_line and start.shaking.vertical is None

        def of(k):
            restoring, arm, restraint, damping = (basis.term(k).derivative for basis in self)
            terms = groups.restoring.products(restoring)
            terms += groups.arm.products(arm, side)
            terms += [] if groups.restraint is None else groups.restraint.products(restraint)
            terms += [] if groups.damping is None else groups.damping.products(damping)
            return materialize(sum(terms), start.stretch)

        return [of(k) for k in (range(1) if constant_pull else range(order - 1))]


def _drags(start: Start, series: Expansion, order: int) -> list:
    """Return the Taylor coefficients of the moment of dampers over the velocity per unit of time; empty without any."""
    damping = start.moments.groups.damping
    if damping is None:
        return []
    found = [damping.summed(series.functions.term(k), empty=None) for k in range(order - 1)]
    return [None if x is None else materialize(x / start.stretch, start.stretch) for x in found]


def _product(first: list, second: list, k: int) -> Scalar:
    return product_term(second, first, k)


def _weights(order: int, start: Start, length: Scalar) -> tuple[_Weights, _Weights]:
    """Return the weights of the angle and of the velocity at the end.

    A change c of the coefficients obeys c_{k+2} = scale/((k + 1)(k + 2)) [sum_j pull_j c_{k-j} + source_k]. `pull`
    holds the coefficients of the derivative of the moment; a damper adds drag_j (k - j + 1) c_{k-j+1}/stretch. Run
    backwards: `of_term[m]` is the derivative of the end by coefficient m, `of_source[k]` by source k.
    """
    side, stretch = start.side, start.stretch
    series = taylor_expansion(start, order)
    sources = _Sources.of(start, series, order, length)
    pulls, drags = sources.pulls(start, order), _drags(start, series, order)
    powers = [jnp.ones_like(length)]
    for _ in range(order):
        powers.append(materialize(powers[-1] * length, stretch))
    scale = -(stretch**2)

    def backwards(own):
        of_term, of_source = [None] * (order + 1), [None] * (order - 1)
        for m in range(order, -1, -1):
            later = _summed((of_source[k], pulls[k - m]) for k in range(m, min(order - 1, m + len(pulls))))
            if drags and m >= 1:
                known = range(m - 1, min(order - 1, m - 1 + len(drags)))
                of_speed = [(of_source[k], drags[k - m + 1]) for k in known if drags[k - m + 1] is not None]
                later = later + m * _summed(of_speed)
            of_term[m] = materialize(own[m] + later, stretch)
            if m >= 2:
                source = of_term[m] * scale * (1 / (m * (m - 1)))
                of_source[m - 2] = materialize(select(start.uplifting, 0.0, source) if m == 2 else source, stretch)
        return of_term, of_source

    def of(own):
        of_term, of_source = backwards(own)

        def gain(_, terms, sign=None):
            total = _summed(zip(of_source, (term for term in terms if term is not None)))
            return total if sign is None else sign * total

        def of_shaking(length_of_series, factors):
            """Return the derivatives of the end by the coefficients of the ground acceleration."""
            pairs = ([(of_source[k], factors[k - j]) for k in range(j, order - 1)] for j in range(length_of_series))
            sums = [_summed((w, f) for w, f in each if f is not None) for each in pairs]
            return [jnp.broadcast_to(x, length.shape).astype(length.dtype) for x in sums]

        horizontal, vertical = start.shaking
        zero = jnp.zeros_like(length)
        groups = start.moments.groups
        moments = start.moments.with_groups(
            TermGroups(
                groups.restoring.each(gain, sources.restoring),
                groups.arm.each(functools.partial(gain, sign=side), sources.arm),
                None if groups.restraint is None else groups.restraint.each(gain, sources.restraint),
                None if groups.damping is None else groups.damping.each(gain, sources.damping),
            )
        )
        of_stretch = sum_of_products(of_term[2:], series.opening[2:]) * 2 / stretch
        if drags:  # their part grows with the stretch itself, not with its square
            dragged = [_product(drags, series.speed, k) for k in range(order - 1)]
            of_stretch = of_stretch - _summed(zip(of_source, dragged)) / stretch
        shaking = Shaking(
            [side * gain for gain in of_shaking(len(horizontal), series.arm)],
            None if vertical is None else of_shaking(len(vertical), series.restoring),
        )
        return _Weights(Start(moments, of_stretch, zero, zero, of_term[0], of_term[1], shaking, zero))

    return of(powers), of([jnp.zeros_like(length)] + [k * power for k, power in enumerate(powers[:-1], 1)])


def arrive(order: int, start: Start, end: End) -> tuple[Scalar, Scalar, Scalar]:
    """Return the length, opening angle and speed of a step's end, as given; their derivatives follow the flow.

    Derivatives come only from `start`, and from `end.level` and `end.room`: the other values in `end` need none.
    """
    return custom_tangent(_arriving, (end.length, end.opening, end.speed), (start, end), order)


def _arriving(order: int, values: tuple, by: tuple[Start, End], changes: tuple) -> tuple:
    (length, opening, speed), (start, end), (d_start, d_end) = values, by, changes
    d_opening, d_speed = (weights.times(d_start) for weights in _weights(order, start, length))
    push, weight = start.shaking.at(length)
    velocity = speed / start.stretch if start.moments.is_damped else speed
    law = start.moments.acceleration(Angle.of(opening), velocity, start.side * push, weight)
    acceleration = start.stretch**2 * law
    d_level, d_room = (0.0 if d is None else d for d in (d_end.level, d_end.room))
    # An end that is grazed has no derivative: infinity, which the status reports.
    d_length = select(end.full, d_room, 0.0)
    d_length = select(end.turns, -d_speed / select(end.turns, acceleration, 1.0), d_length)
    d_length = select(end.meets, (d_level - d_opening) / select(end.meets, speed, 1.0), d_length)
    moved = d_length, d_opening + speed * d_length, d_speed + acceleration * d_length
    return tuple(jnp.broadcast_to(d, length.shape) for d in moved)


def extreme_speed(start: Start, length: Scalar, opening: Scalar, speed: Scalar, jerk: Scalar) -> Scalar:
    """Return |speed| at the end of a step, with derivatives up to the second of the speed at the extremum near it.

    The end stays where it was found, at no cost to the first derivative: the speed is stationary there. But the
    extremum moves, by -acceleration/jerk. `jerk`: the jerk there; infinite where the end is no extremum.
    """
    push, weight = start.shaking.at(length)
    law = start.moments.acceleration(Angle.of(opening), speed / start.stretch, start.side * push, weight)
    return custom_tangent(_extreme, jnp.abs(speed), (speed, start.stretch**2 * law, stop_gradient(jerk)))


def _extreme(_, by: tuple, changes: tuple) -> Scalar:
    """Differentiate |v - a^2/(2 j)|, in which a is zero, but not its derivatives."""
    (speed, acceleration, jerk), (change, steeper, _) = by, changes
    change, steeper = (jnp.zeros_like(speed) if d is None else d for d in (change, steeper))
    return jnp.sign(speed) * (change - acceleration / jerk * steeper)
