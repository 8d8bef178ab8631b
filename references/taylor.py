"""Reference responses of a rocking block: Taylor series in 40-digit arithmetic, with events isolated by sign counts.

    nonlinear: theta'' = -p^2 [sin(s alpha - theta) + u(t) cos(s alpha - theta)], uplift at |u| > tan(alpha)
    linear:    theta'' = -p^2 [s alpha - theta + u(t)],                           uplift at |u| > alpha
    theta' *= restitution at theta = 0

It shares no code and no method with jaxrock: numbers of mpmath or gmpy2, order 30, roots bracketed by Descartes' rule
of signs on Bernstein coefficients (no root of the series can be missed; float64 only where its rounding cannot
change a sign), hops followed one by one down to 1e-22 p alpha. Where it cannot decide it raises. `responses` asks it
for peaks and verdicts of scenes, `taylor_checks` checks it, and all other generators of references stand on it.
"""

import copy
import math
from dataclasses import dataclass, field

import numpy as np

from references.arithmetic import Arithmetic, dot, sign
from references.motions import Motion
from references.roots import roots, rough_bernstein, slopes_of, value_at

DIGITS, ORDER = 40, 30
SMALL_HOP = 1e-6  # impacts above this speed over p alpha are counted on their own
SHORT_STEP, SHORT_ORDER = 1e-3, 16  # steps of hops, times p, and the order that serves them
REST = -22  # a block slower than 10^REST p alpha after an impact rests


class Quiet(Motion):
    """No acceleration, for ever."""

    duration, amplitude = math.inf, 0

    def series(self, piece, local, unit, order):
        """Taylor coefficients of the acceleration [g]."""
        return []


# A block on its way


@dataclass
class Block:
    """A block and the arithmetic to follow it with."""

    arithmetic: Arithmetic
    alpha: object
    p: object
    restitution: object
    linear: bool = False
    order: int = ORDER

    def __post_init__(self):
        number = self.arithmetic.number
        self.alpha, self.p, self.restitution = number(self.alpha), number(self.p), number(self.restitution)
        self.threshold = self.alpha if self.linear else self.arithmetic.tan(self.alpha)
        self.half_turn = self.arithmetic.pi / 2
        self.tolerance = self.arithmetic.power_of_ten(4 - self.arithmetic.digits)
        self.tie = 1 + self.arithmetic.power_of_ten(10 - self.arithmetic.digits)

    def angle(self, x):
        """Sine and cosine of the angle whose series the equation of motion needs, as series of one term."""
        return ([], []) if self.linear else ([s] for s in self.arithmetic.sin_cos(self.alpha - x))

    def turn(self, k, slopes, sine, cosine):
        """Add coefficient k to the sine and cosine of an angle that falls by these slopes."""
        if not self.linear:
            back = cosine[::-1]
            cosine.append(dot(slopes, sine[::-1]) / k)
            sine.append(-dot(slopes, back) / k)

    def moment(self, k, opening, sine, cosine, push):
        """Coefficient k of -x''/p^2; `push`: the series of side * u."""
        if self.linear:
            return (self.alpha if k == 0 else 0) - opening[k] + (push[k] if k < len(push) else 0)
        return sine[k] + dot(push, cosine[::-1])

    def deficit(self, x, v):
        """2 (energy of the balanced block - energy)/p^2."""
        away = self.alpha - x if self.linear else 2 * self.arithmetic.sin((self.alpha - x) / 2)
        return away**2 - (v / self.p) ** 2

    def apex(self, deficit):
        """Opening angle at which a block of this deficit turns back."""
        root = self.arithmetic.sqrt(deficit)
        return self.alpha - (root if self.linear else 2 * self.arithmetic.asin(root / 2))


@dataclass
class Path:
    """Where a block is in the motion, its state, and what has happened."""

    piece: int = 0
    local: object = 0
    start: object = 0  # time at which the piece starts
    side: int = 0  # 0 at rest
    x: object = 0  # opening angle: side * rotation
    v: object = 0
    continuous: bool = False  # leaves rest where |u| passes the threshold: its acceleration is zero by definition
    overturned: bool = False
    peak: object = 0
    peak_time: object = 0
    fastest: object = 0
    impacts: int = 0
    turns: int = 0
    height: object = 0  # greatest opening since the last impact
    slowest: object = math.inf  # smallest impact speed
    grazing: object = math.inf  # smallest impact speed over p sqrt(alpha height of the arc before)
    dip: object = math.inf  # smallest opening at an inward turning point
    impact_times: list = field(default_factory=list)
    impact_velocities: list = field(default_factory=list)  # before impact, with the sign of theta'
    tops: list = field(default_factory=list)  # every opening angle at which it may have peaked
    times: list = field(default_factory=list)  # where states are asked for, rising
    states: list = field(default_factory=list)

    @property
    def time(self):
        """Time from the start of the motion [s]."""
        return self.start + self.local

    def top(self, x, time, tie):
        """Note an opening angle; of equal ones the first is the peak."""
        self.tops.append(x)
        if x > self.peak * tie:
            self.peak_time = time
        self.peak = max(self.peak, x)

    def next_piece(self, motion):
        """Go on to the start of the next piece."""
        self.start = motion.start(self.piece) + motion.length(self.piece)
        self.piece, self.local = self.piece + 1, 0 * self.local


def expand(block, path, p, v, forcing, order):
    """Taylor coefficients of the opening angle in units of time in which p, v and the forcing are given.

    **Returns:** the coefficients, and whether they fall below the tolerance for a step of one unit.
    """
    square, push, number = -p * p, [path.side * u for u in forcing], block.arithmetic.number
    opening, slopes = [path.x, v], [v]
    small, tolerance = 0, block.tolerance * min(number(1), abs(path.x) + abs(v))
    sine, cosine = block.angle(path.x)
    for k in range(order - 1):
        if k:
            block.turn(k, slopes, sine, cosine)
        term = block.moment(k, opening, sine, cosine, push)
        term = number(0) if path.continuous and k == 0 else square * term / ((k + 1) * (k + 2))
        opening.append(term)
        slopes.append((k + 2) * term)
        small = small + 1 if abs(term) < tolerance else 0
        if small == 4 and k > 7:
            return opening, True
    return opening, small >= 4


def step_length(block, coefficients):
    """Step for which the last four terms fall below the tolerance.

    Two would not do: at resonance (linear, pulse frequency p) pairs of terms vanish.
    """
    order, log2 = len(coefficients) - 1, block.arithmetic.log2
    allowed = float(log2(block.tolerance))
    last = [(k, coefficients[k]) for k in range(order - 3, order + 1) if coefficients[k]]
    return min((2.0 ** min(((allowed - float(log2(abs(c)))) / k), 900.0) for k, c in last), default=math.inf)


def shorten(block, coefficients, unit, whole):
    """Rescale coefficients to the step within which they converge; return its length, and `whole` if it is all of one.

    A series that converges throughout its step stays as it is.
    """
    step = step_length(block, coefficients)
    if step >= 1:
        return unit, whole
    step, power = block.arithmetic.number(step), 1
    for k in range(1, len(coefficients)):
        power = power * step
        coefficients[k] = coefficients[k] * power
    return unit * step, False


def longest(block, path, motion):
    """Longest step worth trying [s]: to the end of the piece, within reach of its series, not far beyond a hop."""
    number = block.arithmetic.number
    room = motion.length(path.piece) - path.local
    unit = min(room, number(min(10 / float(block.p), motion.reach(path.piece, path.local, block.order))))
    if not path.x and not path.continuous:
        forcing = motion.series(path.piece, path.local, 1, 0)
        term = expand(block, path, block.p, path.v, forcing, 2)[0][2]
        if term < 0:
            unit = min(unit, 2 * path.v / -term)
    return unit, unit == room


def note_extremes(block, path, unit, c, rough, end):
    """Turning points and the greatest speed on a step of one unit up to `end`."""
    arithmetic, v = block.arithmetic, slopes_of(c)
    rough_v = rough[1:] * np.arange(1, len(rough))
    for root in roots(arithmetic, v, rough_v):
        if root > end:
            break
        x = value_at(c, root)
        if value_at(slopes_of(v), root) > 0:
            path.dip = min(path.dip, x)
        path.turns += 1
        path.height = max(path.height, x)
        path.top(x, path.time + root * unit, block.tie)
    path.fastest = max(path.fastest, abs(value_at(v, end)) / unit)
    bounds, error = rough_bernstein(rough_v)
    if np.abs(bounds).max() + error > float(path.fastest * unit) * (1 + 1e-12):
        a = slopes_of(v)
        inner = [root for root in roots(arithmetic, a) if root < end]
        path.fastest = max([path.fastest, *(abs(value_at(v, root)) / unit for root in inner)])


def note_states(path, until, rotation, velocity):
    """States at the times asked for up to `until`, from functions of the time since the path's."""
    while len(path.states) < len(path.times) and path.times[len(path.states)] <= until:
        since = path.times[len(path.states)] - path.time
        path.states.append((rotation(since), velocity(since)))


def wait(block, path, motion):
    """At rest: go to the uplift, or to the next piece."""
    local = motion.uplift(path.piece, path.local, block.threshold)
    until = path.start + (motion.length(path.piece) if local is None else local)
    note_states(path, until, lambda since: 0 * block.alpha, lambda since: 0 * block.alpha)
    if local is None:
        path.next_piece(motion)
        return
    acceleration = motion.series(path.piece, local, 1, 0)[0]
    path.local, path.side, path.x, path.v = local + 0 * block.alpha, -sign(acceleration), 0 * block.p, 0 * block.p
    path.continuous = abs(abs(acceleration) - block.threshold) < block.tolerance * 10**4


def rock(block, path, motion):
    """One Taylor step, cut at the first event: impact, fallen flat, or the end of the piece."""
    unit, whole = longest(block, path, motion)
    if unit <= 0:
        path.next_piece(motion)
        return
    order = SHORT_ORDER if block.p * unit < SHORT_STEP else block.order
    forcing = motion.series(path.piece, path.local, unit, order)
    c, converged = expand(block, path, block.p * unit, path.v * unit, forcing, order)
    if not converged:
        unit, whole = shorten(block, c, unit, whole)
    path.continuous = False
    rough = np.array([float(a) for a in c])
    impact = next(iter(roots(block.arithmetic, c, rough)), None)
    flat = None
    if not block.linear and rough_bernstein(rough)[0].max() > 1.57:
        flat = next(iter(roots(block.arithmetic, [c[0] - block.half_turn, *c[1:]])), None)
    if flat is not None and (impact is None or flat < impact):
        path.overturned, impact = True, None
    end = flat if path.overturned else block.arithmetic.number(1) if impact is None else impact
    note_extremes(block, path, unit, c, rough, end)
    slopes, side = slopes_of(c), path.side
    if path.times:
        rotation = lambda since: side * value_at(c, since / unit)  # noqa: E731
        note_states(path, path.time + end * unit, rotation, lambda since: side * value_at(slopes, since / unit) / unit)
    path.x, path.v, path.local = value_at(c, end), value_at(slopes, end) / unit, path.local + end * unit
    if impact is not None:
        land(block, path)
    elif path.x < 0:
        raise ArithmeticError("The block fell through the floor.")
    elif whole and not path.overturned:
        path.next_piece(motion)


def land(block, path):
    """Impact: lose speed and change the side, or come to rest."""
    speed, scale = -path.v, block.p * block.alpha
    path.impacts += 1
    path.impact_times.append(path.time)
    path.impact_velocities.append(path.side * path.v)
    path.slowest = min(path.slowest, speed)
    if path.height > 0:
        path.grazing = min(path.grazing, speed / (block.p * block.arithmetic.sqrt(block.alpha * path.height)))
    path.x, path.v, path.side, path.height = 0 * speed, block.restitution * speed, -path.side, 0
    if path.v < block.arithmetic.power_of_ten(REST) * scale:
        path.side, path.v = 0, 0 * speed


def lost(block, path, motion):
    """Return whether no acceleration still to come can bring a block of the linear model back."""
    growth = path.x - block.alpha + path.v / block.p
    return block.linear and path.side != 0 and growth > motion.bound(path.piece)


def free_rocking(block, path):
    """After the motion: the energy gives the verdict, the last peak and the greatest speed."""
    missing, balanced = block.deficit(path.x, path.v), block.deficit(0 * path.x, 0 * path.v)
    path.top(path.x, path.time, block.tie)
    path.fastest = max(path.fastest, abs(path.v))
    after, outward = missing, path.v >= 0
    if not outward and (path.x < block.alpha or missing < 0):  # it gets to an impact
        path.fastest = max(path.fastest, block.p * block.arithmetic.sqrt(balanced - missing))
        after = balanced - block.restitution**2 * (balanced - missing)
        path.impacts += after < 0
    elif path.x >= block.alpha:  # outward, or turning back outward
        path.overturned = True
        return
    path.overturned = after < 0
    if not path.overturned:
        if outward:
            path.fastest = max(path.fastest, block.p * block.arithmetic.sqrt(balanced - missing))
        path.top(block.apex(after), None, block.tie)


def free_peak_time(block, path):
    """Time of the first outward turning point of the free rocking, by Taylor steps (None: not found)."""
    path, quiet = copy.deepcopy(path), Quiet()
    path.start, path.piece, path.local, path.times = path.time, 0, 0 * path.x, []
    path.turns, path.peak = 0, 0 * path.x
    for _ in range(1000):
        rock(block, path, quiet)
        if path.turns or path.overturned:
            return path.peak_time if path.turns else None
    return None


def respond(block, motion, initial=(0, 0), times=()):
    """Follow a block from its initial rotation and velocity through a motion and the free rocking after it.

    **Arguments:** `times`: where states are wanted [s], rising, also after the motion.

    **Returns:** a `Path`: its peak [rad] counts unless overturned; `states` to the last time before overturning.
    """
    zero = 0 * block.alpha
    rotation, velocity = (block.arithmetic.number(value) for value in initial)
    side = sign(rotation) or sign(velocity)
    path = Path(local=zero, start=zero, side=side, x=side * rotation, v=side * velocity, times=list(times))
    path.peak = path.height = path.x = path.x + zero
    path.fastest = abs(path.v)
    path.overturned = not block.linear and path.x >= block.half_turn
    note_states(path, zero, lambda since: rotation, lambda since: velocity)
    while path.piece < motion.pieces and not path.overturned:
        if path.side == 0:
            wait(block, path, motion)
        elif not path.times and lost(block, path, motion):
            path.overturned = True
        else:
            rock(block, path, motion)
    end = copy.deepcopy(path)
    if path.side != 0 and not path.overturned:
        free_rocking(block, path)
        if not path.overturned and path.peak_time is None:
            path.peak_time = free_peak_time(block, end)
    if len(path.states) < len(path.times):
        end = _on_for_states(block, end)
        path.states, path.impact_times, path.impact_velocities = end.states, end.impact_times, end.impact_velocities
    return path


def _on_for_states(block, path):
    """Go on after the motion, by Taylor steps, to the last time asked for."""
    quiet = Quiet()
    path.start, path.piece, path.local = path.time, 0, 0 * path.x
    while len(path.states) < len(path.times) and not path.overturned:
        if path.side:
            rock(block, path, quiet)
        else:
            note_states(path, math.inf, lambda since: 0 * path.x, lambda since: 0 * path.x)
    return path
