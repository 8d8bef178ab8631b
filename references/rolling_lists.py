"""Reference responses of blocks that roll on edges told by lists, from 40-digit Taylor series, with derivatives.

A list of radii at angles is a chain of involutes. Let the radius be r on a straight line between two of them, with the
slope q. Let H and N be the height and the reach of the centre of mass over the point of contact (all over R),

    H = A cos x + B sin x + r,    N = B cos x - A sin x + q,

A and B are constant on a piece, and such that the block touches the ground at one point where two pieces meet. Newton's
law for the centre of mass, and about it, without slip (m = ratio I/R^2 about the corner):

    [1 + ratio (H^2 + N^2 - 1)] x'' = -[p^2 (N + s u H) + ratio r N x'^2]

A step ends where a piece does. `roots` isolates events, so that none is missed. Derivatives are differences of whole
runs in 40 digits, also by angles of lists. Only the names of parameters and outputs are jaxrock's.

    python -m references.rolling_lists          # writes rolling_lists.json
    python -m references.rolling_lists check    # every fourth scene, in 60 digits, of order 44 and with another step
"""

import json
import math
import pathlib
import sys
from dataclasses import dataclass

import numpy as np

from references.arithmetic import Arithmetic, dot
from references.motions import motion
from references.roots import roots, slopes_of, value_at
from references.taylor import ORDER, Path, Quiet, land, note_extremes, note_states, shorten, wait

ANSWERS = pathlib.Path(__file__).with_suffix(".json")
SEED, COUNT, CIRCLES = 20261128, 20, 3
STEP, AGREE = -9, 1e-12  # relative steps of differences; largest distance of those of one and of two steps
NEAR = 1e-3  # scenes nearer to a graze than this are left out
KINDS = ("sine", "cosine", "ricker symmetric")
OUTPUTS = ("max_rotation", "time_of_max", "margin", "rotation", "last_impact")
ABOUT = (
    "Symmetric blocks that roll on rounded edges, by references/rolling_lists.py: 40-digit Taylor series, central "
    "differences with relative steps 1e-9 and 2e-9 and Richardson extrapolation. `block`: alpha, p, restitution, "
    "m R^2/I; `motion`: amplitude and period or duration; `radius`, `angle`: of the edge (no angle: a circle). All "
    "float64 taken as exact. `rotation`: at the time `at`; `last_impact`: time of the last impact before `at`, "
    "`impacts` their number. Gradients are in the order of `names`."
)


class Piece:
    """A piece of an edge: the angles between which it is touched, and its numbers."""

    def __init__(self, low, high, radius, slope, inward, outward):
        self.low, self.high, self.radius, self.slope = low, high, radius, slope  # radius: at `low`
        self.of_cosine, self.of_sine = inward, outward  # A and B


@dataclass
class Rolling:
    """A block on one of its edges."""

    arithmetic: Arithmetic
    alpha: object
    p: object
    restitution: object
    ratio: object
    radius: list
    angle: list  # empty: a circle
    order: int = ORDER

    def __post_init__(self):
        a = self.arithmetic
        self.alpha, self.p, self.restitution, self.ratio = map(
            a.number, (self.alpha, self.p, self.restitution, self.ratio)
        )
        self.threshold, self.half_turn = a.tan(self.alpha), a.pi / 2
        self.tolerance = a.power_of_ten(4 - a.digits)
        self.tie = 1 + a.power_of_ten(10 - a.digits)
        radius, angle = [a.number(r) for r in self.radius], [a.number(x) for x in self.angle]
        slopes = [0 * self.alpha]
        slopes += [(r - q) / (y - x) for q, r, x, y in zip(radius, radius[1:], angle, angle[1:])]
        slopes += [0 * self.alpha] * bool(angle)
        starts = [0 * self.alpha, *angle]
        # The block stands on the corner: there A + r and B + q are its cosine and sine, on the first piece.
        sine, cosine = a.sin_cos(self.alpha)
        inward, outward, self.pieces = cosine - radius[0], sine, []
        for k, (start, slope) in enumerate(zip(starts, slopes)):
            if k:
                (s, c), change = a.sin_cos(start), slope - slopes[k - 1]
                inward, outward = inward + change * s, outward - change * c
            end = starts[k + 1] if k + 1 < len(starts) else a.number(math.inf)
            self.pieces.append(Piece(start, end, radius[max(k - 1, 0)], slope, inward, outward))

    def piece(self, x, outward):
        """Return the piece on which the block rolls on from an angle."""
        inside = [piece for piece in self.pieces if (piece.low <= x < piece.high if outward else piece.low < x)]
        return inside[-1] if inside else self.pieces[0]

    def expand(self, path, piece, unit, forcing, order):
        """Return Taylor coefficients of the opening angle in units of time, and whether they converge within one."""
        number, square, ratio = self.arithmetic.number, (self.p * unit) ** 2, self.ratio
        push = [path.side * u for u in forcing]
        x, v = [path.x, path.v * unit], [path.v * unit]
        sine, cosine = ([s] for s in self.arithmetic.sin_cos(path.x))
        height, reach, radius, inertia, energy, moment, turned = [], [], [], [], [], [], []
        small, tolerance = 0, self.tolerance * min(number(1), abs(x[0]) + abs(v[0]))
        for k in range(order - 1):
            if k:
                back = sine[::-1]
                sine.append(dot(v, cosine[::-1]) / k)
                cosine.append(-dot(v, back) / k)
            radius.append(piece.slope * x[k] if k else piece.radius + piece.slope * (x[0] - piece.low))
            height.append(piece.of_cosine * cosine[k] + piece.of_sine * sine[k] + radius[k])
            reach.append(piece.of_sine * cosine[k] - piece.of_cosine * sine[k] + (0 if k else piece.slope))
            inertia.append(ratio * (dot(height, height[::-1]) + dot(reach, reach[::-1])) + (0 if k else 1 - ratio))
            energy.append(dot(v, v[::-1]))
            moment.append(dot(radius, reach[::-1]))
            pull = square * (reach[k] + dot(push, height[::-1])) + ratio * dot(moment, energy[::-1])
            term = -(pull + dot(inertia[1:], turned[::-1])) / inertia[0]
            turned.append(number(0) if path.continuous and k == 0 else term)
            x.append(turned[k] / ((k + 1) * (k + 2)))
            v.append((k + 2) * x[-1])
            small = small + 1 if abs(x[-1]) < tolerance else 0
            if small == 4 and k > 7:
                return x, True
        return x, small >= 4

    def strength(self, x):
        """Return the restoring moment over m g R, over the moment of inertia at the angle."""
        piece = self.piece(x, True)
        sine, cosine = self.arithmetic.sin_cos(x)
        height = piece.of_cosine * cosine + piece.of_sine * sine + piece.radius + piece.slope * (x - piece.low)
        reach = piece.of_sine * cosine - piece.of_cosine * sine + piece.slope
        return reach / (1 + self.ratio * (height**2 + reach**2 - 1))


def longest(block, path, piece, motion):
    """Return the longest step worth trying [s], and whether it reaches the end of a piece of the motion."""
    room = motion.length(path.piece) - path.local
    unit = min(
        room, block.arithmetic.number(min(5 / float(block.p), motion.reach(path.piece, path.local, block.order)))
    )
    if not path.x and not path.continuous:
        forcing = motion.series(path.piece, path.local, 1, 0)
        term = block.expand(path, piece, block.arithmetic.number(1), forcing, 2)[0][2]
        if term < 0:
            unit = min(unit, 2 * path.v / -term)
    return unit, unit == room


def roll(block, path, motion):
    """One Taylor step, cut at the first event: impact, the end of a piece of the edge or of the motion, fallen flat."""
    piece = block.piece(path.x, path.v >= 0)
    unit, whole = longest(block, path, piece, motion)
    if unit <= 0:
        path.next_piece(motion)
        return
    forcing = motion.series(path.piece, path.local, unit, block.order)
    c, converged = block.expand(path, piece, unit, forcing, block.order)
    if not converged:
        unit, whole = shorten(block, c, unit, whole)
    path.continuous = False
    first, end, level = _event(block, piece, c)
    known = len(path.tops)
    note_extremes(block, path, unit, c, np.array([float(a) for a in c]), end)
    slopes, side = slopes_of(c), path.side
    if len(path.tops) > known:
        _note_closeness(block, path, unit, c, end)
    if path.times:
        rotation = lambda since: side * value_at(c, since / unit)  # noqa: E731
        note_states(path, path.time + end * unit, rotation, lambda since: side * value_at(slopes, since / unit) / unit)
    path.x, path.v, path.local = value_at(c, end), value_at(slopes, end) / unit, path.local + end * unit
    path.x = path.x if first is None else level
    if first == "impact":
        land(block, path)
    elif first == "flat":
        path.overturned = True
    elif first is None and whole:
        path.next_piece(motion)


def _event(block, piece, c):
    """Return the event that ends a step of one unit, if any, its time, and the opening angle there."""
    levels = {"impact": 0 * c[0], "flat": block.half_turn, "low": piece.low, "high": piece.high}
    if not piece.low:
        del levels["low"]
    found = {}
    for name, level in levels.items():
        root = next(iter(roots(block.arithmetic, [c[0] - level, *c[1:]])), None) if level < math.pi else None
        if root is not None:
            found[name] = root
    first = min(found, key=found.get, default=None)
    return first, found.get(first, block.arithmetic.number(1)), levels.get(first)


def _note_closeness(block, path, unit, c, end):
    """Note how close a turning block came to standing still in balance, on a step of one unit up to `end`."""
    slopes = slopes_of(c)
    bent = slopes_of(slopes)
    for root in roots(block.arithmetic, slopes):
        if root <= end and value_at(bent, root) < 0:
            pull = max(-value_at(bent, root) / (block.p * unit) ** 2, abs(block.strength(value_at(c, root))))
            path.closeness = min(path.closeness, (pull / block.arithmetic.sin(block.alpha)) ** 2)


def respond(sides, motion, initial=(0, 0), times=()):
    """Follow a block from an initial rotation and velocity through a motion, and then to its next turning point.

    **Arguments:** `sides`: a `Rolling` for either side; at rest both must uplift alike. `times`: where states are
    wanted [s], rising, within the motion.

    **Returns:** a `Path` with its `closeness`, of which the margin is the least, 1 at most.
    """
    one = sides[0]
    zero = 0 * one.alpha
    rotation, velocity = (one.arithmetic.number(value) for value in initial)
    side = (rotation > 0) - (rotation < 0) or (velocity > 0) - (velocity < 0)
    path = Path(local=zero, start=zero, side=side, x=side * rotation, v=side * velocity, times=list(times))
    path.x = path.peak = path.height = path.x + zero
    path.closeness = zero + 1
    while path.piece < motion.pieces and not path.overturned:
        if path.side == 0:
            wait(one, path, motion)
        else:
            roll(sides[path.side < 0], path, motion)
    path.shaken, turns = len(path.impact_times), path.turns
    path.start, path.piece, path.local, path.times = path.time, 0, zero, []
    while path.side and path.turns == turns and not path.overturned:
        roll(sides[path.side < 0], path, Quiet())
    return path


class Scene:
    """A block on an edge and a pulse, by float64 numbers in the order of `names`; it runs with others, too."""

    def __init__(self, a, known, order=ORDER):
        self.a, self.known, self.order = a, known, order
        self.edge = ["radius"] * len(known["radius"]) + ["angle"] * len(known["angle"])
        self.names = ["alpha", "p", "restitution", "inertia_ratio", "amplitude", "length", *self.edge]
        numbers = known["block"] + known["motion"] + known["radius"] + known["angle"]
        self.numbers = [a.number(x) for x in numbers]

    def run(self, numbers):
        """Return the path of the scene with these numbers."""
        count = len(self.known["radius"])
        block = Rolling(self.a, *numbers[:4], numbers[6 : 6 + count], numbers[6 + count :], self.order)
        moving = list(numbers[4:6])
        if self.known["kind"] == "ricker symmetric":
            moving.append(self.a.number(5.7 / math.pi) * moving[1])
        return respond(
            (block, block), motion(self.a, self.known["kind"], moving), times=[self.a.number(self.known["at"])]
        )

    def outputs(self, numbers):
        """Return outputs of the path, in the order of `OUTPUTS`, and discrete results that differences must not
        change."""
        path = self.run(numbers)
        before = [time for time in path.impact_times if time < self.known["at"]]
        if path.overturned or path.peak_time is None or not before or not path.states:
            return None, path
        told = path.peak, path.peak_time + 0 * path.peak, path.closeness, path.states[0][0], before[-1]
        path.known = len(before), path.shaken
        return told, path

    def gradient(self, values, path, exponent=STEP):
        """Return derivatives by all numbers, a row for each output, and the largest distance of the differences; or
        None."""
        rows, worst = [], 0.0
        for j, number in enumerate(self.numbers):
            if self.names[j] == "angle" and not number:
                rows.append([0 * number for _ in values])
                continue
            size, told = self.a.power_of_ten(exponent) * abs(number), {}
            for k in (1, -1, 2, -2):
                changed = [x + k * size * (i == j) for i, x in enumerate(self.numbers)]
                told[k], other = self.outputs(changed)
                if told[k] is None or other.known != path.known:
                    return None, None
            row = []
            for i, value in enumerate(values):
                near, far = ((told[k][i] - told[-k][i]) / (2 * k * size) for k in (1, 2))
                row.append((4 * near - far) / 3)
                worst = max(worst, float(abs(near - far) / max(abs(row[-1]), abs(value / number) / 100)))
            rows.append(row)
        return list(zip(*rows)), worst


def draw(random, kind, many):
    """Draw the numbers of a scene; `many`: number of angles with radii, 0 for a circle."""
    alpha, p = random.uniform(0.1, 0.35), math.exp(random.uniform(0, math.log(4)))
    intensity, ratio = math.exp(random.uniform(math.log(1.2), math.log(4))), random.uniform(0.8, 4)
    length = 2 * math.pi / (ratio * p)
    angle = np.sort(random.uniform(0.0, 1.2 * alpha, many))
    if many > 2:
        angle[0] = 0.0
    lasts = length * (2 * 5.7 / math.pi if kind == "ricker symmetric" else 1)
    return {
        "kind": kind,
        "block": [alpha, p, random.uniform(0.8, 0.97), random.uniform(0.6, 0.9)],
        "motion": [intensity * math.tan(alpha), length],
        "radius": random.uniform(0.0, 0.8, max(many, 1)).tolist(),
        "angle": angle.tolist(),
        "at": random.uniform(0.6, 1.0) * lasts,
    }


def wanted(scene, path):
    """Return whether a scene is clear enough for a reference: no graze, one peak."""
    block = scene.known["block"]
    slow = [abs(v) for v in path.impact_velocities]
    tops = sorted(path.tops)
    return (
        path.grazing > NEAR
        and path.dip > NEAR * block[0]
        and len(path.impact_times) <= 40
        and min(slow) > NEAR * block[0] * block[1]
        and 0.2 * block[0] < path.peak
        and (len(tops) < 2 or tops[-2] < path.peak * (1 - 1e-6))
    )


def find(a, index):
    """Find one scene, and return all that is stored of it."""
    random = np.random.default_rng([SEED, index])
    while True:
        many = 0 if index < CIRCLES else (2, 3, 5, 12)[index // 3 % 4]
        scene = Scene(a, draw(random, KINDS[index % len(KINDS)], many))
        try:
            values, path = scene.outputs(scene.numbers)
            if values is None or not wanted(scene, path):
                continue
            rows, worst = scene.gradient(values, path)
        except ArithmeticError:
            continue
        if rows is not None and worst < AGREE:
            told = {
                name: {"value": a.text(value, 30), "gradient": [a.text(x, 20) for x in row]}
                for name, value, row in zip(OUTPUTS, values, rows)
            }
            more = {"names": scene.names, "impacts": path.known[0], "tops": len(path.tops)}
            return {"index": index} | scene.known | more | told | {"disagreement": worst}


def main():
    """Write all scenes."""
    a, scenes = Arithmetic(40), []
    for index in range(COUNT):
        with a.context():
            scenes.append(find(a, index))
        print({name: scenes[-1][name] for name in ("index", "kind", "impacts", "tops", "disagreement")}, flush=True)
        lines = ",\n".join(json.dumps(scene) for scene in scenes)
        ANSWERS.write_text(json.dumps({"about": ABOUT})[:-1] + ', "scenes": [\n' + lines + "\n]}\n")


def check():
    """Check some of the stored scenes: print the worst relative differences of values and of gradients."""
    a = Arithmetic(60)
    for known in json.loads(ANSWERS.read_text())["scenes"][::4]:
        with a.context():
            scene = Scene(a, known, 44)
            values, path = scene.outputs(scene.numbers)
            rows, _ = scene.gradient(values, path, -12)
            of_values = max(float(abs(v / a.number(known[name]["value"]) - 1)) for name, v in zip(OUTPUTS, values))
            pairs = [(x, a.number(y)) for name, row in zip(OUTPUTS, rows) for x, y in zip(row, known[name]["gradient"])]
            print(known["index"], of_values, max(float(abs(x - y) / (abs(y) or 1)) for x, y in pairs), flush=True)


if __name__ == "__main__":
    check() if "check" in sys.argv else main()
