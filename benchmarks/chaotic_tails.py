"""The picture of chaotic tails in the documentation: `python benchmarks/chaotic_tails.py` writes `chaotic_tails.png`.

Histories of three blocks beside those of copies, whose slenderness differs by about 1e-14. The first
stands under the package's example record, a real one; the others under made records of `references.chaotic`.
"""

import pathlib
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from common import table

import jaxrock as rk
from references import chaotic

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = pathlib.Path(__file__).resolve().parent
COPIES, CHANGE = 24, 1e-14  # number, and standard deviation of their slenderness over that of the block
SAMPLES, AFTER = 12001, 2.0  # of a history; seconds after the record
OWN, OTHER, END = "#205a8c", "#cfa75b", "#b5352b"


@dataclass(frozen=True)
class Tail:
    """A block under a record, and from when to when its picture goes [s]."""

    record: str
    scale: float
    alpha: float
    p: float
    begin: float
    end: float


TAILS = (
    Tail(chaotic.EXAMPLE, 0.33, 0.079, 7.8, 36.8, 40.0),
    Tail("twice", 1.5, 0.27, 1.4, 24.0, 32.0),
    Tail("twice", 1.0, 0.21, 2.2, 20.0, 32.0),
)


@jax.jit
def histories(record, alpha, p, end):
    """Histories of blocks of many slendernesses."""
    return jax.vmap(lambda alpha: rk.simulate(rk.Block(alpha, p), record, duration=end, samples=SAMPLES))(alpha)


def draw(axes, tail):
    """Draw a history and its copies, and return a row of the table."""
    samples, dt = chaotic.record(tail.record)
    record = tail.scale * rk.Record(samples, dt)
    changes = np.concatenate([[0], CHANGE * np.random.default_rng(0).standard_normal(COPIES)])
    found = histories(record, jnp.array(tail.alpha * (1 + changes)), tail.p, len(samples) * dt + AFTER)
    told = rk.outcome(rk.Block(tail.alpha, tail.p), record)
    ratio = np.clip(np.asarray(found.rotation) / tail.alpha, -1.5, 1.5)
    time = np.asarray(found.time)[0]
    for one in ratio[1:]:
        axes.plot(time, one, color=OTHER, linewidth=0.5)
    axes.plot(time, ratio[0], color=OWN, linewidth=0.9)
    axes.axvline(float(told.known_until), color=END, linestyle="--", linewidth=1)
    shown = abs(ratio[:, (time >= tail.begin) & (time <= tail.end)]).max()
    axes.set(xlim=(tail.begin, tail.end), ylim=(-1.05 * shown, 1.05 * shown), ylabel="rotation/α")
    name = next(name for name in ("successful", "chaotic", "undecided") if told.status == getattr(rk.Status, name))
    share = float(told.overturned_share)
    axes.set_title(f"{name}: share that overturns {share:.2g}, known until {float(told.known_until):.1f} s", fontsize=9)
    top = np.where(np.asarray(told.overturned), np.nan, told.max_rotation / tail.alpha)
    return [
        tail.record, f"{tail.scale}", f"{tail.alpha:.3f}", f"{tail.p}", f"`{name}`", f"{top:.3f}",
        f"{float(told.error) / tail.alpha:.1g}", f"{share:.2f}", f"{float(told.known_until):.1f} s",
        f"{np.sum(np.abs(ratio).max(axis=1) > 1.4)} of {len(ratio)}",
        f"{told.large_impact_count} of {told.impact_count}",
    ]  # fmt: skip


def main():
    """Draw the picture, and print what it shows."""
    figure, panels = plt.subplots(3, 1, figsize=(7.5, 6.6), layout="constrained")
    rows = [draw(axes, tail) for axes, tail in zip(panels, TAILS)]
    panels[-1].set_xlabel("time [s]")
    figure.savefig(HERE / "chaotic_tails.png", dpi=110)
    header = ["record", "scale", "alpha", "p", "status", "peak", "error", "share", "known", "fell", "large impacts"]
    print(table(header, rows))


if __name__ == "__main__":
    main()
