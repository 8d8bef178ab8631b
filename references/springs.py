"""References for the spring models of a rigid block: 40-digit Taylor series and central differences.

Writes `springs.json`: random scenes with the greatest rotation [rad], the greatest angular velocity [rad/s] and
the time of the greatest rotation [s], and their derivatives with respect to the block's and the motion's parameters.
The integrator and the differences are those of `taylor` and `derivatives`, with the equations of
Diamantopoulos & Fragiadakis (2017): opening angle x, side s,

    x''/p^2 = -moment(x) - s u(t) cos(alpha) cos(x),   uplift at |u| > tan(alpha), x' *= restitution at x = 0,
    moment: sin(alpha - x) (4, 7, 10); sin(alpha) (1 - x/alpha) (5, 8, 11); sin(alpha) - sin(x) (6);
    sin(alpha) - cos(alpha) sin(x) (9, 12)

    python -m references.springs          # a few minutes on one core
    python -m references.springs check    # every fifth scene again: 60 digits, order 44, other steps
"""

import collections
import json
import math
import pathlib
import sys
import time
from dataclasses import dataclass

import numpy as np

from references.arithmetic import Arithmetic, dot
from references.derivatives import AGREE, draw, judge
from references.differences import OUTPUTS, Scene, deviations, gradient, record, texts
from references.taylor import Block

ANSWERS = pathlib.Path(__file__).with_suffix(".json")
SEED = 20261122
SPRINGS = (("SM1", "sine"), ("SM1", "linear"), ("SM1", "plastic"), ("SM3", "plastic"))
MOTIONS = ("sine", "exponential", "sine", "ricker symmetric", "record")
EACH = 10  # scenes of each spring

ABOUT = (
    "Spring models of a rigid block by references/springs.py: 40-digit Taylor series, central differences "
    "with steps 1e-9 and 2e-9 and Richardson extrapolation. `block`: alpha, p, restitution; `motion`: its numbers in "
    " the order of `names` (a record: the factor of all samples of jaxrock.example_record()), all float64 taken as "
    "exact. Ricker: the centre is 5.7/pi periods (the float64 quotient), and moves with the period. Each output has a "
    "`value` and a `gradient` in the order of `names`."
)


@dataclass
class SpringBlock(Block):
    """A column on a spring. What the integrator calls its `alpha` is the angle at which it balances."""

    spring: tuple = ("SM1", "sine")

    def __post_init__(self):
        super().__post_init__()
        a = self.arithmetic
        self.law, self.slenderness = self.spring[1], self.alpha
        self.sine, self.cosine = a.sin(self.alpha), a.cos(self.alpha)
        self.weight = 1 + 0 * self.cosine if self.spring[0] == "SM1" else self.cosine
        if self.law == "plastic":
            self.alpha = a.asin(self.sine / self.weight)

    def angle(self, x):
        """As in `Block`: of the opening angle itself."""
        return ([s] for s in self.arithmetic.sin_cos(x))

    def turn(self, k, slopes, sine, cosine):
        """As in `Block`: this angle grows by the slopes."""
        back = sine[::-1]
        sine.append(dot(slopes, cosine[::-1]) / k)
        cosine.append(-dot(slopes, back) / k)

    def moment(self, k, opening, sine, cosine, push):
        """As in `Block`."""
        pushed = self.cosine * dot(push, cosine[::-1])
        if self.law == "sine":
            return self.sine * cosine[k] - self.cosine * sine[k] + pushed
        constant, linear = self.sine if k == 0 else 0, self.law == "linear"
        return constant - (self.sine * opening[k] / self.slenderness if linear else self.weight * sine[k]) + pushed

    def work(self, x):
        """Integral of the restoring moment from 0 to x."""
        cos = self.arithmetic.cos
        if self.law == "sine":
            return cos(self.slenderness - x) - self.cosine
        linear = self.law == "linear"
        return self.sine * x - (self.sine * x**2 / (2 * self.slenderness) if linear else self.weight * (1 - cos(x)))

    def deficit(self, x, v):
        """2 (energy of the balanced block - energy)/p^2."""
        return 2 * (self.work(self.alpha) - self.work(x)) - (v / self.p) ** 2

    def apex(self, deficit):
        """Opening angle at which a block of this deficit turns back: bisection."""
        low, high = 0 * self.alpha, self.alpha
        while high - low > self.tolerance * self.alpha:
            middle = (low + high) / 2
            low, high = (middle, high) if self.deficit(middle, 0) > deficit else (low, middle)
        return (low + high) / 2


class SpringScene(Scene):
    """A spring model in place of a block."""

    def block(self, *numbers):
        """The column."""
        return SpringBlock(self.a, *numbers, order=self.order, spring=self.model)


def find(a, index, spring, kind, samples, dropped):
    """One scene with all that is stored of it."""
    rng = np.random.default_rng([SEED, index])
    peak = max(abs(u) for u in samples[0])
    while True:
        parameters = draw(rng, "spring", kind, False, peak)
        parameters[0] = rng.uniform(0.05, 0.7)  # stout blocks, too: there the models differ
        if kind == "record":
            parameters[3] = rng.uniform(1.1, 2.5) * math.tan(parameters[0]) / peak
        else:
            parameters[3] = rng.uniform(1.05, 3.0) * math.tan(parameters[0])
        scene = SpringScene(a, spring, kind, parameters, samples)
        try:
            path = scene.run()
            reason, notes = judge(scene, path, False)
            slopes = None if reason else gradient(scene, path)
        except ArithmeticError as error:
            reason, slopes = str(error), None
        if slopes is None or slopes[2] > AGREE:
            dropped[reason or "differences"] += 1
            continue
        known = {
            "spring": spring,
            "kind": kind,
            "block": [float(x) for x in parameters[:3]],
            "motion": [float(x) for x in parameters[3:]],
            "names": list(scene.names),
            "impacts_large": notes["impacts_large"],
        }
        for name, value, row in zip(OUTPUTS, (path.peak, path.fastest, path.peak_time + 0 * path.peak), slopes[0]):
            known[name] = {"value": a.text(value, 22), "gradient": texts(a, row)}
        return known


def main():
    """Compute all scenes."""
    samples, dropped, a, begin, scenes = record(), collections.Counter(), Arithmetic(40), time.time(), []
    for index in range(EACH * len(SPRINGS)):
        with a.context():
            kind = MOTIONS[index // len(SPRINGS) % len(MOTIONS)]
            scenes.append(find(a, index, SPRINGS[index % len(SPRINGS)], kind, samples, dropped))
        print(f"{len(scenes)} scenes, {time.time() - begin:.0f} s, dropped {dict(dropped)}", flush=True)
    lines = ",\n".join(json.dumps(scene) for scene in scenes)
    ANSWERS.write_text(json.dumps({"about": ABOUT})[:-1] + ', "scenes": [\n' + lines + "\n]}\n")


def check():
    """Some of the stored scenes in 60 digits with another order and step: prints the worst relative differences."""
    samples, a = record(), Arithmetic(60)
    for known in json.loads(ANSWERS.read_text())["scenes"][::5]:
        with a.context():
            scene = SpringScene(a, tuple(known["spring"]), known["kind"], known["block"] + known["motion"], samples, 44)
            path = scene.run()
            rows, _, _ = gradient(scene, path, -12)
            errors = deviations(a, known, scene, path, rows)
            print(f"{known['spring']} {known['kind']}: values and gradients {max(errors):.1e}", flush=True)


if __name__ == "__main__":
    check() if "check" in sys.argv else main()
