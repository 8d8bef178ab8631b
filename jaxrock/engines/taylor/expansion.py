"""A Taylor step of a rocking block: the series of the opening angle, and how the step's end moves with its start.

The end of a step is linear in small changes of its start, of the forcing and of the model. Its weights follow from the
recurrence of the series run backwards, once for the angle and once for the velocity, whatever the number of
parameters: derivatives cost a few products each. The end itself moves, too, where an event or a knot sets it.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import ArrayLike, Bool, Inexact

from jaxrock.models.coefficients import Angle, Table
from jaxrock.motions.motion import Shaking
from jaxrock.numerics.polynomial import derivative, horner
from jaxrock.numerics.xla_cpu import keep, keep_by

Scalar = Inexact[ArrayLike, ""]


Flag = Bool[ArrayLike, ""]


class Start(NamedTuple):
    """Where a step starts. Time is in a unit of choice."""

    table: Table
    stretch: Scalar  # p times the unit of time
    side: Scalar
    uplifting: Flag  # leaves rest with zero acceleration
    opening: Scalar
    speed: Scalar  # of the opening, per unit
    shaking: Shaking  # Taylor coefficients of the ground acceleration [g]
    one: Scalar  # see `keep_by`

    @property
    def angle(self) -> Angle:
        """The opening angle with its sine and cosine."""
        angle = Angle.of(self.opening)
        return Angle(angle.value, keep_by(angle.sine, self.one), keep_by(angle.cosine, self.one))


class End(NamedTuple):
    """Where a step ends, and what sets that."""

    length: Scalar  # time from the start
    opening: Scalar
    speed: Scalar
    level: Scalar  # opening angle at which it ends if it `meets` it
    room: Scalar  # time at which it ends if it is `full`
    meets: Flag
    turns: Flag  # ends where the velocity vanishes
    full: Flag


class Expansion(NamedTuple):
    """Taylor coefficients about a start: the opening angle, its sine and cosine, the arm, and the restoring moment."""

    opening: list[Scalar]
    sine: list[Scalar]
    cosine: list[Scalar]
    arm: list[Scalar | None]
    restoring: list[Scalar | None]


def _total(terms: list):
    """Their sum, in four chains side by side: additions one after the other would wait for each other."""
    chains = [sum(terms[i + 4 :: 4], start=terms[i]) for i in range(min(4, len(terms)))]
    return sum(chains[1:], start=chains[0]) if len(chains) < 4 else (chains[0] + chains[1]) + (chains[2] + chains[3])


def _product(first: list, second: list, k: int):
    """Coefficient k of a product of series, of which coefficients may be missing (zero)."""
    terms = [first[j] * second[k - j] for j in range(min(k, len(first) - 1) + 1) if second[k - j] is not None]
    return _total(terms) if terms else 0.0


def expand(start: Start, order: int) -> Expansion:
    """Series of x'' = -stretch^2 [(1 + v) restoring(x) + side u arm(x)].

    The sine and cosine of the angle follow their own recurrences (Jorba & Zou 2005).
    """
    table, angle, one = start.table, start.angle, start.one
    x, slopes = [angle.value, start.speed], [start.speed]  # slopes: (k + 1) x_{k+1}
    sine, cosine, arms, restorings = [angle.sine], [angle.cosine], [], []
    scale = keep_by(-(start.stretch**2), one)
    pushes = [start.side * u for u in start.shaking.horizontal]
    for k in range(order - 1):
        if table.trigonometric and k > 0:
            sine.append(keep_by(_product(slopes, cosine, k - 1) * (1 / k), one))
            cosine.append(keep_by(_product(slopes, sine, k - 1) * (-1 / k), one))

        def combine(constant, line, of_sine, of_cosine, k):
            terms = [] if constant is None or k > 0 else [constant]
            terms += [] if line is None else [line * x[k]]
            terms += [] if of_sine is None else [of_sine * sine[k]]
            terms += [] if of_cosine is None else [of_cosine * cosine[k]]
            return sum(terms) if terms else None

        arm = combine(table.m0, None, table.ms, table.mc, k)
        arms.append(arm if arm is None else keep_by(arm, one))
        moment = _product(pushes, arms, k)
        restoring = combine(table.r0, table.r1, table.rs, table.rc, k)
        restorings.append(restoring)
        moment = moment if restoring is None else moment + restoring
        if start.shaking.vertical is not None:
            moment = moment + _product(start.shaking.vertical, restorings, k)
        term = keep_by(scale * moment * (1 / ((k + 1) * (k + 2))), one)
        if k == 0:
            term = jnp.where(start.uplifting, 0.0, term)  # by continuity, exactly
        x.append(term)
        slopes.append((k + 2) * term)
    return Expansion(x, sine, cosine, arms, restorings)


class _Weights(NamedTuple):
    """What the end of a step (its angle, or its velocity) gains per change of what it depends on."""

    start: Start  # the weights in place of the values; zero for side and uplifting

    def times(self, change: Start) -> Scalar:
        """The change of the end."""
        pairs = zip(jax.tree.leaves(self.start), jax.tree.leaves(change, is_leaf=_is_zero), strict=True)
        return sum((weight * moved for weight, moved in pairs if not _is_zero(moved)), start=0.0)


def _is_zero(tangent) -> bool:
    return isinstance(tangent, SymbolicZero)


def _weighed(terms: list, vertical: list[Scalar] | None, order: int, like: Scalar) -> list:
    """A series times 1 + v, where the model has it."""
    if vertical is None or len(terms) < order - 1:
        return terms
    return [terms[k] + keep(_product(vertical, terms, k), like) for k in range(order - 1)]


def _weights(order: int, start: Start, length: Scalar) -> tuple[_Weights, _Weights]:
    """Weights of the angle and of the velocity at the end.

    A change c of the coefficients obeys c_{k+2} = scale/((k + 1)(k + 2)) [sum_j pull_j c_{k-j} + source_k], linear
    with the coefficients `pull` of the derivative of the moment. Backwards: `of_term[m]` is what the end gains from
    a change of coefficient m, `of_source[k]` from one of source k.
    """
    table, side, stretch = start.table, start.side, start.stretch
    series = expand(start, order)
    moments = range(order - 1)
    trigonometric = table.ms is not None or table.mc is not None
    horizontal, vertical = start.shaking
    pushed_sine = [keep(_product(horizontal, series.sine, k), stretch) for k in moments if trigonometric]
    pushed_cosine = [keep(_product(horizontal, series.cosine, k), stretch) for k in moments if trigonometric]
    constant = [jnp.ones_like(length)] + [None if vertical is None else jnp.zeros_like(length)] * (order - 2)
    # What multiplies r0, r1, rs and rc.
    unity, line, sine, cosine = (
        _weighed(terms, vertical, order, stretch) for terms in (constant, series.opening, series.sine, series.cosine)
    )

    def pull(k):
        terms = [] if table.r1 is None or unity[k] is None else [table.r1 * unity[k]]
        terms += [] if table.rs is None else [table.rs * cosine[k]]
        terms += [] if table.rc is None else [-table.rc * sine[k]]
        terms += [] if table.ms is None else [side * table.ms * pushed_cosine[k]]
        terms += [] if table.mc is None else [-side * table.mc * pushed_sine[k]]
        return keep(sum(terms), stretch)

    pulls = [pull(k) for k in (moments if table.trigonometric or vertical is not None else range(1))]
    powers = [jnp.ones_like(length)]
    for _ in range(order):
        powers.append(keep(powers[-1] * length, stretch))
    scale = -(stretch**2)

    def of(own):
        of_term, of_source = [None] * (order + 1), [None] * (order - 1)
        for m in range(order, -1, -1):
            later = [of_source[k] * pulls[k - m] for k in range(m, min(order - 1, m + len(pulls)))]
            of_term[m] = keep(own[m] + sum(later, start=0.0), stretch)
            if m >= 2:
                source = of_term[m] * scale * (1 / (m * (m - 1)))
                of_source[m - 2] = keep(jnp.where(start.uplifting, 0.0, source) if m == 2 else source, stretch)

        def along(terms):
            return sum(w * c for w, c in zip(of_source, terms))

        def of_push(j):
            pairs = [(of_source[k], series.arm[k - j]) for k in range(j, order - 1)]
            return side * sum((w * arm for w, arm in pairs if arm is not None), start=jnp.zeros_like(length))

        def of_weight(j):
            pairs = [(of_source[k], series.restoring[k - j]) for k in range(j, order - 1)]
            return sum((w * moment for w, moment in pairs if moment is not None), start=jnp.zeros_like(length))

        def coefficient(present, terms):
            return None if present is None else along(terms)

        weights = Table(
            r0=coefficient(table.r0, [term for term in unity if term is not None]),
            r1=coefficient(table.r1, line),
            rs=coefficient(table.rs, sine),
            rc=coefficient(table.rc, cosine),
            m0=coefficient(table.m0, [side * u for u in horizontal]),
            ms=coefficient(table.ms, [side * u for u in pushed_sine]),
            mc=coefficient(table.mc, [side * u for u in pushed_cosine]),
        )
        zero = jnp.zeros_like(length)
        of_stretch = sum(w * c for w, c in zip(of_term[2:], series.opening[2:])) * 2 / stretch
        of_shaking = Shaking(
            [of_push(j) for j in range(len(horizontal))],
            None if vertical is None else [of_weight(j) for j in range(len(vertical))],
        )
        return _Weights(Start(weights, of_stretch, zero, zero, of_term[0], of_term[1], of_shaking, zero))

    return of(powers), of([jnp.zeros_like(length)] + [k * power for k, power in enumerate(powers[:-1], 1)])


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def arrive(order: int, start: Start, end: End) -> tuple[Scalar, Scalar, Scalar]:
    """Length, opening angle and speed of a step's end, as they are given; their derivatives follow the flow.

    Only these derive from `start`, and from `end.level` and `end.room`: the values in `end` need no derivatives.
    """
    return end.length, end.opening, end.speed


@functools.partial(arrive.defjvp, symbolic_zeros=True)
def _(order, primals, tangents):
    (start, end), (d_start, d_end) = primals, tangents
    length, opening, speed = arrive(order, start, end)  # with derivatives of their own, for those of higher order
    d_opening, d_speed = (weights.times(d_start) for weights in _weights(order, start, length))
    acceleration, weight = start.shaking.at(length)
    law = start.table.acceleration(Angle.of(opening), speed, start.side * acceleration, weight)
    bend = start.stretch**2 * law
    d_level, d_room = (0.0 if _is_zero(d) else d for d in (d_end.level, d_end.room))
    # An end that is grazed has no derivative: infinite, for the status to tell.
    d_length = jnp.where(end.full, d_room, 0.0)
    d_length = jnp.where(end.turns, -d_speed / jnp.where(end.turns, bend, 1.0), d_length)
    d_length = jnp.where(end.meets, (d_level - d_opening) / jnp.where(end.meets, speed, 1.0), d_length)
    moved = d_length, d_opening + speed * d_length, d_speed + bend * d_length
    return (length, opening, speed), tuple(jnp.broadcast_to(d, length.shape) for d in moved)


@jax.custom_jvp
def meet(x: Scalar, forcing: list[Scalar], level: Scalar) -> Scalar:
    """x, where the series `forcing` meets `level`, as it is given; its derivatives are those of the root."""
    return x


@functools.partial(meet.defjvp, symbolic_zeros=True)
def _(primals, tangents):
    (_, forcing, _), (_, d_forcing, d_level) = primals, tangents
    x = meet(*primals)
    moved = [jnp.zeros_like(x) if _is_zero(d) else d for d in d_forcing]
    slope = horner(derivative(forcing), x) if len(forcing) > 1 else jnp.zeros_like(x)
    lack = (0.0 if _is_zero(d_level) else d_level) - horner(moved, x)
    return x, jnp.where(slope == 0, 0.0, lack / jnp.where(slope == 0, 1.0, slope))
