"""Ten thousand random scenes on an edge, and their references: `python -m references.edge_cases` (ten minutes).

Half of the scenes lie within 1e-14 to 1e-3 of the overturning boundary, half of them within that of a change of their
impacts: a grazing touch of the ground, an impact at the end of the pulse, or hops just above the uplift threshold.
jaxrock finds the edges, the Taylor reference judges the scenes. All is kept in `edge_cases.npz`.
"""

import functools
import math
import pathlib
import time
from dataclasses import dataclass

import jax
import numpy as np
from mpmath import mp, mpf

import jaxrock as rk
from references.in_jaxrock import MODELS, PULSES
from references.responses import answers

FILE = pathlib.Path(__file__).with_suffix(".npz")
SEED, POINTS, BATCH = 20261121, 32, 256
TUNER = rk.Series(max_steps=3000)  # finds the edges
COLUMNS = ("alpha", "p", "restitution", "amplitude", "duration", "shape", "delay", "rotation", "velocity")


@dataclass(frozen=True)
class Group:
    """One kind of scene: how many, where its edge is, and which number is tuned to it."""

    model: str
    kind: str
    edge: str  # "boundary": the verdict changes; "impacts": their number does; "hops": just above the threshold
    count: int
    tuned: str = "amplitude"

    @property
    def delayed(self):
        """Return whether the motion waits first."""
        return self.tuned == "delay"

    @property
    def name(self):
        """Name of the group in the tables."""
        where = {"boundary": "boundary", "impacts": "touch", "hops": "small hops"}[self.edge]
        return f"{self.model}, {self.kind}, {where}" + (f" by {self.tuned}" if self.edge == "impacts" else "")


GROUPS = [
    Group(model, kind, edge, count, tuned)
    for model in MODELS
    for kind, edge, count, tuned in (
        ("sine", "boundary", 625, "amplitude"),
        ("cosine", "boundary", 625, "amplitude"),
        ("exponential", "boundary", 625, "amplitude"),
        ("rectangle", "boundary", 625, "amplitude"),
        ("rectangle", "impacts", 500, "delay"),
        ("half sine", "impacts", 500, "delay"),
        ("rectangle", "impacts", 500, "velocity"),
        ("sine", "impacts", 214, "amplitude"),
        ("cosine", "impacts", 214, "amplitude"),
        ("exponential", "impacts", 214, "amplitude"),
        ("sine", "hops", 358, "amplitude"),
    )
]


def spread_out(random, low, high, count):
    """Numbers whose logarithms are uniform."""
    return np.exp(random.uniform(math.log(low), math.log(high), count))


def draw(group, random, count):
    """Random scenes, (count, columns), whose tuned number is still to be found."""
    alpha, p = spread_out(random, 0.03, 1.0, count), spread_out(random, 0.5, 5.0, count)
    threshold = alpha if group.model == "linear" else np.tan(alpha)
    restitution, shape, zero = random.uniform(0.3, 1.0, count), random.uniform(-20, 20, count), np.zeros(count)
    if group.kind in ("sine", "cosine"):
        duration = 2 * np.pi / (p * spread_out(random, 0.3, 8.0, count))
    else:
        duration = spread_out(random, 0.05, 15.0, count) / p
    amplitude, delay, rotation, velocity = threshold.copy(), zero, zero, zero
    if group.edge == "impacts":
        fallen = random.random(count) < (0.6 if group.tuned == "amplitude" else 1.1)
        rotation = np.where(fallen, alpha * spread_out(random, 1e-3, 0.9, count), 0.0)
        amplitude = np.where(fallen, -threshold, threshold)
        if group.tuned != "amplitude":
            amplitude = amplitude * spread_out(random, 1.2, 10.0, count)
            duration = spread_out(random, 0.1, 3.0, count) / p
    if group.edge == "hops":
        excess = spread_out(random, 1e-8, 1e-1, count)
        amplitude = threshold * (1 + excess)
        restitution = np.where(excess > 1e-2, random.uniform(0.8, 0.99, count), random.uniform(0.6, 0.9, count))
    return np.stack([alpha, p, restitution, amplitude, duration, shape, delay, rotation, velocity], axis=1)


def tuning(group, scenes):
    """A grid of the tuned number for each scene, (scenes, points)."""
    alpha, p, _, amplitude, _, _, _, rotation, _ = scenes.T
    if group.tuned == "amplitude":
        return amplitude[:, None] * np.geomspace(1.001, 100.0, POINTS)
    if group.tuned == "delay":  # in times of the free fall
        fall = np.arccosh(alpha / (alpha - rotation)) / p
        return fall[:, None] * np.linspace(0.02, 1.5, POINTS)
    threshold = alpha if group.model == "linear" else np.tan(alpha)
    speed = p * np.sqrt(2 * rotation * (np.abs(amplitude) - threshold))  # stopped about at the ground
    return -speed[:, None] * np.linspace(0.2, 4.0, POINTS)


def pulse(kind, amplitude, duration, shape):
    """The motion of a scene."""
    return PULSES[kind](amplitude, duration, *([shape] if kind == "exponential" else []))


@functools.cache
def solver(model, kind, delayed, engine):
    """Outcomes of scenes, (count, columns), all by one compiled batch."""

    def one(scene):
        alpha, p, restitution, amplitude, duration, shape, delay, rotation, velocity = scene
        motion = pulse(kind, amplitude, duration, shape)
        block, motion = rk.Block(alpha, p, restitution), motion.shifted(delay) if delayed else motion
        return rk.outcome(block, motion, MODELS[model], initial=(rotation, velocity), engine=engine)

    solve = jax.jit(jax.vmap(one))

    def in_batches(scenes):
        parts = []
        for first in range(0, len(scenes), BATCH):
            part = scenes[first : first + BATCH]
            found = solve(part[np.arange(BATCH) % len(part)])
            parts.append(jax.tree.map(lambda x: np.asarray(x)[: len(part)], found))  # noqa: B023
        return jax.tree.map(lambda *x: np.concatenate(x), *parts)

    return in_batches


def changes_within(group, found):
    """Where the edge lies between neighbours: verdicts, or numbers of impacts of safe blocks."""
    lost = np.asarray(found.overturned)
    return lost if group.edge == "boundary" else np.where(lost, -1, np.asarray(found.impact_count))


def on_the_edge(group, random):
    """Scenes tuned to their edge to the last digit, then moved off it by 1e-14 to 1e-3 of the tuned number.

    **Returns:** the scenes, and how far each was moved.
    """
    if group.edge == "hops":
        return draw(group, random, group.count), np.full(group.count, np.nan)
    solve, column = solver(group.model, group.kind, group.delayed, TUNER), COLUMNS.index(group.tuned)

    def value(scenes, tuned):
        scenes = scenes.copy()
        scenes[:, column] = tuned
        return changes_within(group, solve(scenes))

    chosen, lows, highs = [], [], []
    while sum(map(len, chosen)) < group.count:
        scenes = draw(group, random, group.count + group.count // 4)
        grid = tuning(group, scenes)
        values = value(np.repeat(scenes, POINTS, axis=0), grid.ravel()).reshape(grid.shape)
        change = values[:, 1:] != values[:, :-1]
        if group.edge == "impacts":
            change &= (values[:, 1:] >= 0) & (values[:, :-1] >= 0)
        some = np.flatnonzero(change.any(axis=1))
        index = np.argmax(change[some] * random.random(change[some].shape), axis=1)
        chosen.append(scenes[some])
        lows.append(grid[some, index])
        highs.append(grid[some, index + 1])
    scenes, low, high = (np.concatenate(x)[: group.count] for x in (chosen, lows, highs))
    before = value(scenes, low)
    for _ in range(60):
        middle = (low + high) / 2
        same = value(scenes, middle) == before
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    moved = spread_out(random, 1e-14, 1e-3, group.count) * random.choice([-1, 1], group.count)
    scenes[:, column] = high * (1 + moved)
    return scenes, moved


def as_reference(group, scene):
    """Convert a scene to the arguments of the Taylor reference."""
    alpha, p, restitution, amplitude, duration, shape, delay, rotation, velocity = (float(x) for x in scene)
    numbers = (amplitude, duration, shape)[: 3 if group.kind == "exponential" else 2]
    options = {"model": group.model, "initial": (rotation, velocity)} | ({"delay": delay} if group.delayed else {})
    return (alpha, p, restitution), group.kind, numbers, options


def in_two(text):
    """A decimal number as a sum of two float64."""
    with mp.workdps(40):
        value = mpf(text)
        return float(value), float(value - mpf(float(value)))


def references(group, scenes):
    """Verdict (-1: the reference cannot decide), peak in two parts, impacts, and how gentle a touch was, of scenes."""
    rows = []
    for known in answers([as_reference(group, scene) for scene in scenes]):
        if "error" in known:
            rows.append((-1, 0.0, 0.0, 0, np.inf, np.inf))
            continue
        peak = (np.inf, 0.0) if known["overturned"] else in_two(known["peak"])
        gentle = [np.inf if known[name] is None else known[name] for name in ("grazing", "dip")]
        rows.append((known["overturned"], *peak, known["impacts"], *gentle))
    return np.array(rows, float)


def new_cases():
    """Draw the scenes, tune them, and let the reference answer; keep all that."""
    groups, kept = np.repeat(np.arange(len(GROUPS)), [group.count for group in GROUPS]), []
    for i, group in enumerate(GROUPS):
        start = time.perf_counter()
        scenes, moved = on_the_edge(group, np.random.default_rng([SEED, i]))
        drawn = time.perf_counter()
        known = references(group, scenes)
        kept.append((scenes, moved, known))
        end = time.perf_counter()
        print(f"{group.name}: {group.count} scenes in {drawn - start:.0f} s, judged in {end - drawn:.0f} s", flush=True)
    scenes, moved, known = (np.concatenate(x) for x in zip(*kept))
    np.savez_compressed(FILE, groups=groups, scenes=scenes, moved=moved, known=known)


def kept_cases(again):
    """The kept scenes: group of each, scenes, how far they are from their edge, and the reference's answers."""
    if again or not FILE.exists():
        new_cases()
    with np.load(FILE) as kept:
        return kept["groups"], kept["scenes"], kept["moved"], kept["known"]


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_enable_x64", True)
    new_cases()
