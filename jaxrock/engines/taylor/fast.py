"""The fast pass: Taylor steps for the many scenes that meet no near tie.

A step is a series, with a certificate of its shape and the turning point within it, if any. It is cut at the first
level that it meets (ground or saddle). A lane without a certificate is rejected: the accurate pass of the series engine
reruns it afterwards.
"""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxrock._core.types import Flag, Scalar
from jaxrock.compiler.hints import materialize, materialize_by, materialize_flag, select
from jaxrock.engines.bookkeeping import checked_step, errors_after, escaped, record_extrema
from jaxrock.engines.events import Events, landed
from jaxrock.engines.impact import impact
from jaxrock.engines.rest import lift, longest_wait
from jaxrock.engines.settling import settled
from jaxrock.engines.state import State
from jaxrock.engines.taylor.accurate import TaylorStepper
from jaxrock.engines.taylor.expansion import Start, taylor_expansion
from jaxrock.engines.taylor.policy import POLICY
from jaxrock.engines.taylor.step_start import first_sign
from jaxrock.numerics.newton import is_found, root_between
from jaxrock.numerics.polynomial import derivative, horner, jet, keeps_sign, last_size, remainder, step_length
from jaxrock.status import Status

# Degrees of the polynomials for Newton's first iterations, where the series has degree 16 or less (else in proportion).
# They serve a value that is stationary at the root, the time of a turning point, and the meeting of a level.
_FLAT, _TURN, _MEET = (6, 10), (5, 10), (5, 9)


def _if(needed: Flag, function: Callable, otherwise):
    """Call `function()` where needed: skipped if no lane of a vector needs it."""
    return jax.lax.cond(needed, function, lambda: otherwise)


def _certified(terms: list[Scalar], length: Scalar, rises: Scalar) -> Scalar:
    """Return the share of a step that certainly contains at most one turn; zero if no part is certain.

    The acceleration keeps its sign there, or its derivative does.
    """
    acceleration = derivative(derivative(terms))
    jerk = derivative(acceleration)
    jerks = first_sign(jerk[0], jerk[1])

    def sure(share):
        kept = keeps_sign(acceleration, rises, share * length) > 0
        return _if(~kept, lambda: kept | (keeps_sign(jerk, jerks, share * length) > 0), kept)

    def shorter():
        share = jnp.zeros_like(length)
        for part in reversed(POLICY.shorter):
            share = select(sure(part), part, share)
        return share

    return _if(~sure(1.0), shorter, jnp.ones_like(length))


class _Part(NamedTuple):
    """The part of a step on which the velocity changes sign at most once; time is in the unit of the series."""

    length: Scalar
    opening: Scalar  # at its end, with its derivatives
    speed: Scalar
    acceleration: Scalar
    full: Flag  # goes to the end of the room
    outward: Scalar  # sign of the velocity at its start
    has_extremum: Flag  # the velocity has an extremum
    bound: Scalar  # of the velocity at that extremum
    certain: Flag


def _part(start: Start, terms: list[Scalar], room: Scalar, least: Scalar, most: float) -> _Part:
    """Return the certain part of a step, `most` long at most; `least`: bound of what the last coefficients
    contribute."""
    one, before, first = start.one, terms[1], 2 * terms[2]
    cap = jnp.minimum(room, most)
    # Under records nearly all steps go as far as there is room: no root is taken for them.
    short = ~(last_size(terms) * cap ** (len(terms) - 1) <= least)
    longest = _if(short, lambda: step_length(terms, least, cap), cap)
    reaches = longest >= room * (1 - 1e-9)
    longest = materialize_by(select(reaches, room, longest), one)
    rises = select(start.uplifting, 1.0, first_sign(terms[2], terms[3]))
    outward = select(start.uplifting, 1.0, first_sign(before, rises))
    share = materialize_by(_certified(terms, longest, rises), one)

    def extremum(length):
        opening, speed, acceleration = (materialize_by(x, one) for x in jet(terms, length, 2))
        has_extremum = rises * acceleration < 0

        def where_tangents_meet():
            turn = select(has_extremum, first - acceleration, 1.0)
            return before + first * ((speed - before - acceleration * length) / turn)

        bound = _if(has_extremum, where_tangents_meet, before)
        return (
            (opening, speed, acceleration),
            has_extremum,
            bound,
            has_extremum & (outward * speed >= 0) & (outward * bound <= 0),
        )

    length = materialize_by(share * longest, one)
    end, has_extremum, bound, twice = extremum(share * longest)
    whole, slowing = (length, end, has_extremum, bound, twice), end[2]

    def shorter():
        # Where the velocity may turn twice, the part ends about where the acceleration is zero.
        length = materialize_by(share * longest * first / select(twice, first - slowing, 1.0), one)
        return length, *extremum(length)

    length, end, has_extremum, bound, still = _if(twice, shorter, whole)
    opening, speed, acceleration = end
    certain, full = (share > 0) & ~still, reaches & (share == 1) & ~twice
    return _Part(length, opening, speed, acceleration, full, outward, has_extremum, bound, certain)


def _leaving(start: Start, terms: list[Scalar], part: _Part) -> tuple:
    """Return the velocity over a part, as `root_between` takes it, without the zero at its start.

    It is divided by the time where the block stands still at the start, and by its square where it leaves rest with
    zero acceleration.
    """
    velocity, length = derivative(terms), part.length
    still = velocity[0] == 0
    later = [select(start.uplifting, b, a) for a, b in zip(velocity[1:], [*velocity[2:], jnp.zeros_like(length)])]
    left = [select(still, b, a) for a, b in zip(velocity, [*later, jnp.zeros_like(length)])]
    power = select(start.uplifting, 2.0, select(still, 1.0, 0.0))
    per_time = select(still, 1 / length, 0.0)
    share = select(start.uplifting, per_time * per_time, select(still, per_time, 1.0))
    slope = (part.acceleration - power * part.speed * per_time) * share
    return left, jnp.zeros_like(length), length, (left[0], part.speed * share), (left[1], slope)


class _Meeting(NamedTuple):
    """The end of a part of a step, and the turning point before it."""

    at: Scalar
    opening: Scalar  # at the end, with its derivatives
    speed: Scalar
    acceleration: Scalar
    certain: Flag
    turned: Flag  # turned back before the end
    turn_at: Scalar
    top: Scalar  # opening angle at the turning point
    top_acceleration: Scalar
    hits: Events  # the events that end it


def _meeting(start: Start, terms: list[Scalar], part: _Part, state: State, saddle: Scalar) -> _Meeting:
    """Find the turning point within a part, and the first level that it meets, before or after it turns."""
    one, zero = start.one, jnp.zeros_like(part.length)
    turns = materialize_flag(part.outward * part.speed < 0, state.local)

    def turn():
        x, last = root_between(_TURN, *_leaving(start, terms, part))
        x = materialize_by(x, one)
        opening, _, acceleration = (materialize_by(value, one) for value in jet(terms, x, 2))
        return x, opening, acceleration, is_found(x, last, 1e-6) & (x > 0)

    turn_at, top, top_acceleration, sure = _if(
        turns, turn, (part.length, part.opening, part.acceleration, part.certain)
    )
    certain = part.certain & sure

    crossing = (top >= saddle) != state.beyond
    early = crossing | (top <= 0)
    # If it turns before it crosses, the step ends where it turns.
    stops = ~early & turns & ((part.opening >= saddle) != (top >= saddle))
    impact = ~crossing & ((top <= 0) | (turns & ~stops & (part.opening <= 0)))
    crossing, impact, stops = (materialize_flag(x, state.local) for x in (crossing, impact, stops))
    level = select(crossing, saddle, 0.0)
    low, high = select(early, 0.0, turn_at), select(early, turn_at, part.length)
    at_low = select(early, terms[0], top) - level
    at_high = select(early, top, part.opening) - level
    slopes = select(early, terms[1], 0.0), select(early & turns, 0.0, part.speed)

    def meet():
        x, last = root_between(_MEET, [terms[0] - level, *terms[1:]], low, high, (at_low, at_high), slopes)
        x = materialize_by(x, one)
        return x, *(materialize_by(value, one) for value in jet(terms, x, 2)), certain & is_found(x, last)

    def at_end(of_turn, of_part):
        return select(stops, of_turn, of_part)

    otherwise = at_end(turn_at, part.length), at_end(top, part.opening), at_end(zero, part.speed)
    otherwise = *otherwise, at_end(top_acceleration, part.acceleration), certain
    at, opening, speed, acceleration, certain = _if(crossing | impact, meet, otherwise)
    turned = turns & (turn_at <= at)
    never = jnp.zeros_like(impact)
    hits = Events(impact, stops, never, crossing, never)
    return _Meeting(at, opening, speed, acceleration, certain, turned, turn_at, top, top_acceleration, hits)


def _fastest(start: Start, terms: list[Scalar], part: _Part, at: Scalar, known: Scalar) -> tuple[Scalar, Flag]:
    """Return the largest speed between the ends of a step where it exceeds the known one, and whether that is
    certain."""
    velocity, zero = derivative(terms), jnp.zeros_like(at)

    def extremum():
        x, last = root_between(
            _FLAT, derivative(velocity), zero, part.length, (2 * terms[2], part.acceleration), (6 * terms[3], None)
        )
        return select(x <= at, jnp.abs(horner(velocity, x)), 0.0), (x > at) | (is_found(x, last, 1e-4) & (x > 0))

    return _if(part.has_extremum & (jnp.abs(part.bound) > known), extremum, (zero, jnp.ones_like(part.has_extremum)))


def _missed(stepper: TaylorStepper, terms: list[Scalar], at: Scalar, least: Scalar) -> Scalar:
    """Return the truncation error of a step from its last terms; `least`: their bound. A step that ends early has
    less."""
    return jnp.minimum(least, remainder(terms, at))


def _stands(stepper: TaylorStepper, meeting: _Meeting) -> Flag | bool:
    """Return whether the block stays above flat on the ground within the step."""
    return not stepper.scene.falls_flat or jnp.maximum(meeting.opening, meeting.top) < jnp.pi / 2


def _lost(stepper: TaylorStepper, state: State, start: Start) -> Flag:
    """Call `escaped` only for blocks that move outward past their saddle."""
    away = state.beyond & (state.velocity >= 0)
    return _if(away, lambda: escaped(stepper, state, start.angle), jnp.zeros_like(away))


def advance(stepper: TaylorStepper, state: State) -> State:
    """Advance a lane that rocks by one step."""
    stepper = stepper.on(state.side)
    scene, order = stepper.scene, stepper.order
    shaking, unit = stepper.shaking(state.piece, state.local)
    start = stepper.start(state, shaking, unit)
    stretch, one = start.stretch, start.one
    terms = taylor_expansion(start, order).opening
    size = functools.reduce(jnp.maximum, [jnp.abs(c) for c in terms[: max(order // 2, 4)]])
    least = stepper.tolerance * materialize_by(jnp.minimum(scene.alpha, size), one)
    part = _part(start, terms, jnp.minimum(stepper.room(state) * (1 / unit), 32.0), least, stepper.longest)
    meeting = _meeting(start, terms, part, state, scene.moments.saddle)
    at, hits = meeting.at, meeting.hits
    fast, sure = _fastest(start, terms, part, at, state.fastest * stretch)
    certain = materialize_flag(meeting.certain & sure & _stands(stepper, meeting), state.local)

    opening, _ = landed(scene, hits, meeting.opening, meeting.speed)
    velocity = materialize_by(meeting.speed * (1 / stretch), one)
    elapsed = materialize_by(at * unit, one)
    full = part.full & ~(hits.saddle | hits.impact | hits.turning)
    piece, local, over = stepper.move_on(state, elapsed, full)
    time = select(at > 0, at * stretch, jnp.inf)  # some pieces have zero length
    missed = _missed(stepper, terms, at, least)
    # Later terms are smaller than the first three.
    rounded = 2 * stepper.rounding * horner([jnp.abs(c) for c in terms[:3]], at)
    errors = rounded + missed, rounded + missed * jnp.maximum(order / time, 1.0)
    spread = errors_after(stepper, state, start.angle, shaking.now, elapsed, errors)
    passed = replace(
        state,
        spread=jax.tree.map(lambda x: materialize_by(x, one), spread),
        local=state.local + meeting.turn_at * unit,  # at the turning point, for `record_extrema`
        opening=opening,
        velocity=velocity,
        beyond=state.beyond ^ hits.saddle,
        uplifting=jnp.zeros_like(state.uplifting),
        fastest=jnp.maximum(state.fastest, jnp.maximum(fast / stretch, jnp.abs(velocity))),
        done=over & (not stepper.follows_free_stage),
    )

    def noted_now():
        return record_extrema(
            stepper,
            passed,
            part.outward > 0,
            meeting.turned & ~hits.saddle,
            hits.saddle,
            select(hits.saddle, scene.moments.saddle, meeting.top),
            select(hits.saddle, velocity, 0.0),
            materialize_by(select(hits.saddle, meeting.acceleration, meeting.top_acceleration) / stretch**2, one),
        )

    noted = replace(_if(meeting.turned | hits.saddle, noted_now, passed), piece=piece, local=local)

    def strike():
        steepest = jax.tree.map(lambda rate: rate / unit, shaking.steepest(part.length))
        return impact(stepper, noted, hits.impact, velocity, shaking.at(at), steepest, (part.length - at) * unit)

    struck = _if(hits.impact, strike, noted)
    lost = _lost(stepper, state, start)
    postponed = ~certain & ~lost & (struck.status == Status.successful)
    after = replace(
        struck,
        overturned=state.overturned | lost,
        done=struck.done | lost | ~certain,
        status=Status.where(postponed, Status.solver_failed, struck.status),
    )
    return settled(stepper, state, checked_step(stepper, state, after))


def certain_wait(stepper: TaylorStepper, state: State) -> State:
    """Advance a lane at rest to where the drive exceeds the threshold, or as far as it certainly does not."""
    scene, order = stepper.scene, stepper.order
    shaking, unit = stepper.shaking(state.piece, state.local)
    room = jnp.minimum(stepper.room(state), 32 * unit) / unit
    length = longest_wait(stepper, shaking, room, order, stepper.tolerance)
    drives = scene.drives_of(shaking)
    share = jnp.ones_like(length)
    alike = shaking.vertical is None and scene.only_side is None  # one is minus the other
    for drive, _ in drives[:1] if alike else drives:
        share = jnp.minimum(share, _monotone(drive, length))
    full = (length >= room * (1 - 1e-9)) & (share == 1)
    length = materialize(share * length, state.local)
    lasting = room > 0  # in a zero-length piece nothing happens

    def of(drive, level):
        """Return whether this drive lifts the block at once, touches the threshold, or passes it in the step; and its
        end."""
        end, slack = horner(drive, length), 8 * jnp.finfo(length.dtype).eps * level
        lifts = lasting & (drive[0] > level + slack)
        touching = lasting & ~lifts & (drive[0] >= level - slack)
        return lifts, touching, lasting & ~lifts & (end > level + slack), end

    (drive, level), (drive2, level2) = drives
    (lifts, touching, meets, end), (lifts2, touching2, meets2, end2) = of(drive, level), of(drive2, level2)
    second = lifts2 | meets2
    missing = [select(second, b, a) for a, b in zip(drive, drive2)]
    missing[0] = select(second, drive2[0] - level2, drive[0] - level)
    slope = missing[1] if len(missing) > 1 else jnp.zeros_like(length)
    ending = select(second, end2 - level2, end - level)
    x, last = root_between(_MEET, missing, jnp.zeros_like(length), length, (missing[0], ending), (slope, None))
    both = (lifts | meets) & second
    lifts, touching, meets = lifts | lifts2, touching | touching2, meets | meets2
    elapsed = select(lifts, 0.0, select(meets, x, length)) * unit
    full = full & ~meets & ~lifts
    piece, local, over = stepper.move_on(state, elapsed, full)
    piece = select(full & ~over, scene.after_quiet(piece), piece)
    never = scene.outlook.is_over(state.piece)
    unclear = ~never & ((share == 0) | touching | both | (meets & ~lifts & ~is_found(x, last)))
    rested = replace(
        state,
        piece=piece,
        local=local,
        done=over | never | unclear,
        steps=state.steps + 1,
        status=Status.where(unclear, Status.solver_failed, state.status),
    )
    side = select(second, -1.0, 1.0)
    return lift(rested, side, (lifts | meets) & ~unclear & ~never, meets & ~lifts, lifts)


def _monotone(terms: list[Scalar], length: Scalar) -> Scalar:
    """Return the share of a step within which a series is certainly monotone."""
    slope = derivative(terms) or [jnp.zeros_like(length)]
    rises = first_sign(slope[0], slope[1] if len(slope) > 1 else jnp.ones_like(length))
    share = jnp.zeros_like(length)
    for part in (*reversed(POLICY.shorter), 1.0):
        share = select(keeps_sign(slope, rises, part * length) > 0, part, share)
    steady = horner([jnp.abs(c) for c in slope], length) * length == 0  # or zero length
    return select(steady, 1.0, share)
