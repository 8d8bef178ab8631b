"""Scenes whose chatter float64 cannot follow, and their judgements: `python -m references.chaotic` (ten minutes).

Blocks under the package's example record and under made ones, that jaxrock refuses as undecided. `real_records` judges
them; copies of each, with alpha moved by a few units in its last place, tell what float64 may know. All is kept in
`chaotic.json`, and nobody needs data to rebuild a scene.
"""

import dataclasses
import json
import math
import pathlib
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import jaxrock as rk
from jaxrock.motions.record import with_room
from references.real_records import Scene, digits_of, follow, judge

FILE = pathlib.Path(__file__).with_suffix(".json")
HEIGHTS = (0.5, 1.0, 2.0, 4.0, 8.0, 15.0)  # [m]
SLENDERNESS = (2, 3, 4, 5, 8, 15, 30, 60)
SCALES = {
    name: tuple(round(0.3 * ratio**k, 3) for k in range(count))
    for name, ratio, count in (("example", 1.02, 160), ("made", 1.1, 30))
}
EACH = 12  # scenes of a record, at most; twice as many where a copy has another verdict
COPIES = (-8, -4, -2, -1, 1, 2, 4, 8)  # units in the last place of alpha
EXAMPLE = "example"


@dataclass(frozen=True)
class Made:
    """A made record: strong cycles from the start, noise from 5 s on, and perhaps a second shock.

    - `strong`: amplitude of three sine cycles [g] of a `period` [s].
    - `noise`: peak of normal noise [g], averaged over `width` samples.
    - `seconds`: duration of the record.
    - `again`: amplitude of three more cycles that end with the record, added to the noise [g].
    """

    seed: int
    strong: float = 0.7
    period: float = 0.5
    noise: float = 0.4
    seconds: float = 35.0
    width: int = 3
    again: float = 0.0
    dt: float = 0.01

    def samples(self):
        """Samples [g], rounded to 1e-6 g, so that every machine makes the same."""
        count, first, length = (round(t / self.dt) for t in (self.seconds, 5, 3 * self.period))
        cycles = np.sin(2 * np.pi * self.dt / self.period * np.arange(length))
        noise = np.random.default_rng(self.seed).standard_normal(count - first)
        noise = np.convolve(noise, np.ones(self.width) / self.width, "same")
        u = np.zeros(count)
        u[first:] = self.noise * noise / np.abs(noise).max()
        u[:length] += self.strong * cycles
        u[-length:] += self.again * cycles
        return np.round(u, 6)


MADE = {
    "strong": Made(0),
    "slow": Made(1, strong=0.5, period=1.0, noise=0.3),
    "noisy": Made(2, strong=1.0, period=0.4, noise=0.6),
    "weak": Made(3, strong=0.4, period=0.8),
    "long": Made(9, strong=0.5, period=0.8, noise=0.3, seconds=90.0),
    "white": Made(10, strong=0.5, period=0.8, noise=0.3, seconds=90.0, width=1),
    "twice": Made(11, seconds=30.0, again=0.7),
    "twice slow": Made(12, strong=0.5, period=1.0, noise=0.3, seconds=40.0, again=0.5),
    "growing": Made(13, strong=0.3, period=0.6, noise=0.25, seconds=60.0, again=0.9),
}


def record(name):
    """Samples [g] and dt [s] of a record."""
    if name == EXAMPLE:
        example = rk.example_record()
        return np.asarray(example.samples, float), float(example.dt)
    return MADE[name].samples(), MADE[name].dt


def scene(kept):
    """The `Scene` of a kept one."""
    samples, dt = record(kept["record"])
    return Scene(samples, dt, *(kept[name] for name in ("scale", "alpha", "p", "restitution")))


def refused(name):
    """Blocks and scales that jaxrock refuses under a record: alpha, p, restitution and scale of each."""
    samples, dt = record(name)
    scales = SCALES["example" if name == EXAMPLE else "made"]
    height, slenderness = (x.ravel() for x in np.meshgrid(HEIGHTS, SLENDERNESS, indexing="ij"))
    blocks = jax.vmap(lambda width, height: rk.Block.from_dimensions(width=width, height=height))(
        jnp.array(height / slenderness), jnp.array(height)
    )

    def undecided(motion, block, scale):
        return rk.outcome(block, scale * motion).status == rk.Status.undecided

    every_scale = jax.vmap(undecided, in_axes=(None, None, 0))
    run = jax.jit(jax.vmap(every_scale, in_axes=(None, 0, None)))
    found = run(with_room(rk.Record(samples, dt)), blocks, jnp.array(scales))
    numbers = [np.asarray(x) for x in (blocks.alpha, blocks.p, jax.vmap(lambda block: block.restitution)(blocks))]
    return [(*(float(x[i]) for x in numbers), scales[k]) for i, k in zip(*np.nonzero(np.asarray(found)))]


def copies(one, limbs):
    """Runs of a scene with alpha moved by a few units in its last place."""
    unit = np.spacing(one.alpha)
    return [follow(dataclasses.replace(one, alpha=one.alpha + k * unit), limbs) for k in COPIES]


def kept(name, alpha, p, restitution, scale):
    """A scene, its judgement, and what its copies do, as kept."""
    one = Scene(*record(name), scale, alpha, p, restitution)
    known = judge(one)
    limbs = min(n for n in (2, 3, 4, 6, 8, 12, 16) if digits_of(n) >= known.digits)
    runs = copies(one, limbs)
    peaks = [run.peak for run in runs if run.overturned is False]
    return {
        "record": name,
        "scale": scale,
        "alpha": alpha,
        "p": p,
        "restitution": restitution,
        "overturned": known.overturned,
        "peak": None if not math.isfinite(known.peak) else float(f"{known.peak:.12g}"),
        "time_of_peak": None if not math.isfinite(known.time_of_peak) else float(f"{known.time_of_peak:.10g}"),
        "digits": known.digits,
        "copies_overturned": sum(run.overturned is True for run in runs),
        "copies_peaks": [float(f"{end(peaks):.12g}") for end in (min, max)] if peaks else None,
    }


def new_scenes():
    """Find refused scenes under every record, judge them, and keep some: mixed ones first."""
    chosen = []
    for i, name in enumerate([EXAMPLE, *MADE]):
        found = refused(name)
        order = np.random.default_rng(i).permutation(len(found))[: 2 * EACH]
        judged = [kept(name, *found[k]) for k in order]
        mixed = [one for one in judged if 0 < one["copies_overturned"] < len(COPIES)]
        others = [one for one in judged if one not in mixed]
        chosen += [*mixed, *others[: max(EACH - len(mixed) // 2, 0)]]
        print(f"{name}: {len(found)} refused, {len(judged)} judged, {len(mixed)} mixed", flush=True)
    FILE.write_text("[\n" + ",\n".join(json.dumps(one) for one in chosen) + "\n]\n")


def kept_scenes():
    """All kept scenes, as dicts: `scene` makes one."""
    return json.loads(FILE.read_text())


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_enable_x64", True)
    new_scenes()
