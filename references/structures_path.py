"""A structure on its way through a motion, from event to event, for `references.structures`."""

import math
from typing import Any, NamedTuple

from references.structures_motions import Floor, _nothing, pieces_of
from references.structures_physics import Structure, numbers
from references.structures_steps import SHARES, Runge, scan

REST = 1e-13  # a block slower than this times p alpha after an impact rests
SMALL_HOP = 1e-6  # impacts above this speed over p alpha are counted
LONGEST = 0.25  # of a step, times p
FREE = 400.0  # how long the block is followed after the motion, times p
FALLS = 0.05  # of the peak: the free stage ends with tops below this share of the highest


class Event(NamedTuple):
    """Where a function of time and state rises through zero, what then happens, and the exact opening there, if one."""

    function: Any
    action: Any
    speed: Any  # rate of the function, for Newton's method; None: by differences


class Path:
    """A structure on its way; `side` 0 at rest."""

    def __init__(self, scene, stepper):
        self.stepper, self.n = stepper, numbers(stepper.kind)
        n, motion = self.n, scene["motion"]
        self.structure, self.p = Structure(scene, n), n.of(scene["p"])
        floor = motion["kind"] == "floor"
        self.floor = Floor(motion, n) if floor else None
        ground = (motion["ground"], motion.get("ground_vertical")) if floor else (motion, scene.get("vertical"))
        self.pieces = pieces_of(*ground, n, motion.get("after", 0) if floor else 0)
        self.zero = n.of(0)
        self.tau, self.side, self.free = self.zero, 0, False
        self.state = [self.zero] * (2 + (2 * self.floor.count if self.floor else 0))
        count = len(self.structure.restraints)
        self.memories = {s: [{} for _ in range(count)] for s in (1, -1)}
        self.branches = [None] * count
        self.peak, self.peak_tau, self.fastest = self.zero, self.zero, self.zero
        self.impacts = self.free_impacts = self.hops = self.free_tops = 0
        self.overturned = self.done = self.unsettled = False
        self.guess = LONGEST

    # Equations

    def rates(self, tau, y):
        """Rates of the state with p t."""
        t, p = tau / self.p, self.p
        u, v = self.piece.u(t), self.piece.v(t)
        floor = []
        if self.floor and not self.free:
            floor, u = self.floor.rates(y[2:], u)
            floor = [rate / p for rate in floor]
        elif self.floor:
            floor = [self.zero] * (len(y) - 2)
        if self.side == 0:
            return [self.zero, self.zero, *floor]
        return [y[1], self.pull(y[0], y[1], self.side, u, v, self.branches), *floor]

    def pull(self, x, w, side, u, v, branches):
        return self.structure.acceleration(x, w, side, u, v, branches, self.memories[side])

    def drive(self, side):
        """Return the acceleration at x = 0 of a block at rest, on a side, as a function of time and state."""
        branches = [r.landed(m) for r, m in zip(self.structure.restraints, self.memories[side])]

        def function(tau, y):
            u, v = self.piece.u(tau / self.p), self.piece.v(tau / self.p)
            if self.floor and not self.free:
                u = self.floor.rates(y[2:], u)[1]
            return self.pull(self.zero, self.zero, side, u, v, branches)

        return function

    # Events and what they do

    def events(self):
        """Events that end the present mode."""
        if self.side == 0:
            return [Event(self.drive(s), lambda s=s: self.lift(s), None) for s in self.structure.sides]
        flat = self.n.pi / 2
        found = [
            Event(lambda tau, y: -y[0], self.land, lambda y, a: -y[1]),
            Event(lambda tau, y: -y[1], self.top, lambda y, a: -a),
            Event(lambda tau, y: y[0] - flat, self.fall, lambda y, a: y[1]),
        ]
        for i, (restraint, branch) in enumerate(zip(self.structure.restraints, self.branches)):
            for level, direction, then in restraint.levels(branch, self.memories[self.side][i]):
                found.append(
                    Event(
                        lambda tau, y, d=direction, level=level: d * (y[0] - level),
                        lambda i=i, level=level, then=then: self.switch(i, level, then),
                        lambda y, a, d=direction: d * y[1],
                    )
                )
        return found

    def lift(self, side):
        self.side = side
        self.start_branches()

    def start_branches(self):
        self.branches = [r.landed(m) for r, m in zip(self.structure.restraints, self.memories[self.side])]

    def land(self):
        speed = abs(self.state[1])
        least = float(speed / self.structure.alpha)
        self.fastest = max(self.fastest, speed)
        if self.free:
            self.free_impacts += 1
        elif least > SMALL_HOP:
            self.impacts += 1
        self.hops += 1
        self.state[0], self.state[1] = self.zero, self.structure.restitution * speed
        if -self.side in self.structure.sides:
            self.side = -self.side
        self.start_branches()
        if least * float(self.structure.restitution) < REST:
            self.state[1], self.side = self.zero, 0
        if self.free and self.free_tops and self.settled():
            self.done = True

    def settled(self):
        """Return whether no later opening or speed of the free stage can be the greatest."""
        remembers = any(restraint.remembers for restraint in self.structure.restraints)
        return not remembers or self.last_top < FALLS * self.peak

    def top(self):
        self.state[1] = self.zero
        self.last_top = self.state[0]
        if self.state[0] > self.peak * (1 + 1e-14):
            self.peak, self.peak_tau = self.state[0], self.tau
        for i, restraint in enumerate(self.structure.restraints):
            self.branches[i] = restraint.topped(self.branches[i], self.state[0], self.memories[self.side][i])
        self.free_tops += self.free

    def fall(self):
        self.overturned = self.done = True

    def switch(self, i, level, then):
        self.state[0], self.branches[i] = level, then
        if then == "broken":
            self.memories[self.side][i]["broken"] = True

    # Steps

    def follow(self):
        """Follow the structure through the motion and the free stage."""
        for piece in self.pieces:
            self.piece = piece
            self.through(piece.end * self.p, min(LONGEST, float(self.p) * min(piece.scale, self.own_scale()) / 12))
            if self.done:
                return self
        end = self.pieces[-1].end
        self.free, self.floor_count = True, len(self.state)
        self.piece = self.piece._replace(start=end, end=math.inf, u=_nothing, v=_nothing, straight=True)
        if self.side:
            self.through(self.tau + self.n.of(FREE), LONGEST)
            self.unsettled = not self.done and self.side != 0
        return self

    def own_scale(self):
        return self.floor.scale if self.floor else math.inf

    def through(self, end, longest):
        """Follow the structure to a time p t, in steps no longer than given."""
        while not self.done and self.tau < end:
            if self.side == 0 and self.free:
                return
            room = end - self.tau
            if self.side == 0 and self.at_rest(end):
                continue
            length = min(room, self.n.of(min(longest, self.guess)))
            if self.side and self.state[0] == 0:
                length = min(length, self.hop())
            self.step(length, end)

    def at_rest(self, end):
        """Lift at once where the block is driven; skip a straight piece that drives it nowhere."""
        for event, side in zip(self.events(), self.structure.sides):
            now = event.function(self.tau, self.state)
            if now > 0:
                self.lift(side)
                return True
        if not self.floor and self.piece.straight:
            if all(event.function(end, self.state) <= 0 for event in self.events()):
                self.tau = end
                return True
        return False

    def hop(self):
        """Longest step worth trying from an impact: little beyond the hop."""
        pull = self.rates(self.tau, self.state)[1]
        return 1.3 * 2 * self.state[1] / -pull if pull < 0 and self.state[1] > 0 else self.n.of(LONGEST)

    def step(self, length, end):
        """One step, cut at the first event."""
        tau, state = self.tau, self.state
        made, after, at, self.guess = self.stepper.step(self.rates, tau, state, length)
        self.guess = max(float(self.guess), 1e-3)
        first = None
        for event in self.events():
            share = scan(lambda s, f=event.function: f(tau + s * made, at(s)), at_once=self.side == 0)
            if share is not None and (first is None or share < first[0]):
                first = share, event
        if first is None:
            self.note_speed(tau, state, made, made, at)
            self.tau, self.state = (end if made == end - tau else tau + made), list(after)
            if after[0] < 0:
                raise ArithmeticError("The block fell through the ground.")
            return
        used = self.polish(tau, state, made, *first)
        self.note_speed(tau, state, used, made, at)
        self.state = list(self.stepper.exactly(self.rates, tau, state, used))
        self.tau = tau + used
        first[1].action()

    def polish(self, tau, state, made, share, event):
        """Length of the step to an event, by Newton's method or secants on states of exact steps."""
        used = self.n.of(share) * made
        other = None
        for _ in range(12):
            y = self.stepper.exactly(self.rates, tau, state, used)
            value = event.function(tau + used, y)
            if event.speed:
                slope = event.speed(y, self.rates(tau + used, y)[1])
            else:
                old = other or (used * (1 - 1e-4), None)
                before = old[1]
                if before is None:
                    y = self.stepper.exactly(self.rates, tau, state, old[0])
                    before = event.function(tau + old[0], y)
                slope = (value - before) / (used - old[0]) if used != old[0] else 0
                other = used, value
            change = -value / slope if slope else self.zero
            new = min(max(used + change, self.zero), made)
            # Newton's method doubles the digits, so a small change need not be tried.
            if abs(new - used) <= made * (self.n.close**0.5 if event.speed else 4 * self.n.close):
                return new
            used = new
        return used

    def note_speed(self, tau, state, used, made, at):
        """Greatest angular velocity on the used part of a step."""
        if self.side == 0 or used <= 0:
            return
        shares = [share for share in SHARES if share * made < used] + [float(used / made)]
        speeds = [abs(float(at(share)[1])) for share in shares]
        i = max(range(len(shares)), key=speeds.__getitem__)
        if speeds[i] > float(self.fastest) * 0.99:
            low, high = shares[max(i - 1, 0)], shares[min(i + 1, len(shares) - 1)]
            self.greatest_speed(tau, state, made * self.n.of(low), min(made * self.n.of(high), used))
        self.fastest = max(self.fastest, abs(state[1]))

    def greatest_speed(self, tau, state, low, high):
        """Greatest angular velocity between two times after a state: the top of parabolas through exact states."""

        def speed(since):
            found = abs(self.stepper.exactly(self.rates, tau, state, since)[1])
            self.fastest = max(self.fastest, found)
            return found

        middle, half = (low + high) / 2, (high - low) / 2
        for _ in range(4):
            left, right = max(middle - half, low), min(middle + half, high)
            a, b, c = speed(left), speed(middle), speed(right)
            h, k = middle - left, right - middle
            if h <= 0 or k <= 0:
                return
            first, second = (b - a) / h, (c - b) / k
            bend = (second - first) / (right - left)
            if bend >= 0:
                return
            top = left + h / 2 - first / (2 * bend)
            middle, half = min(max(top, low), high), half / 8
        speed(middle)


def follow(scene, stepper=None):
    """Follow a scene to its end."""
    return Path(scene, stepper or Runge()).follow()
