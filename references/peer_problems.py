"""The problems: blocks at rest, their motions, and what is asked for.

    nonlinear: theta'' = -p^2 [sin(s alpha - theta) + u(t) cos(s alpha - theta)], uplift at |u| > tan(alpha)
    linear:    theta'' = -p^2 [s alpha - theta + u(t)],                           uplift at |u| > alpha
    theta' *= restitution at theta = 0

Asked for is peak |theta|/alpha over the motion and the free rocking after it; infinite when overturned.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

ALPHA, RESTITUTION, SEED, POINTS = 0.2, 0.9, 20261121, 1000
RECORD_POINTS = 400  # of them with a reference; `POINTS` of a map
SHAPE = 1.5  # of the exponential pulses
RECORD_SCALE = 1.5  # of the record: every block uplifts


@dataclass(frozen=True)
class Problem:
    """Many scenes of one kind; the arrays hold one number a scene.

    Maps run over `restitutions` (slowest), `intensities` and `rates` (fastest); p = 1 there.
    """

    name: str
    title: str
    model: str  # "nonlinear" or "linear"
    motion: str  # "sine", "exponential" or "record"
    alpha: np.ndarray
    p: np.ndarray  # [rad/s]
    restitution: np.ndarray
    intensity: np.ndarray  # amplitude over the uplift threshold (of a record: its scale)
    rate: np.ndarray  # omega/p of a sine; 2 pi/(p duration) of an exponential pulse
    restitutions: tuple = ()
    intensities: np.ndarray | None = None
    rates: np.ndarray | None = None
    samples: np.ndarray = field(default_factory=lambda: np.zeros(2))  # of the record, scaled [g]
    dt: float = 1.0
    drawn: bool = True  # whether points were drawn for references

    @property
    def size(self) -> int:
        """Number of scenes."""
        return self.alpha.size

    @property
    def amplitude(self) -> np.ndarray:
        """Amplitude of the motion [g]; of a record its scale."""
        if self.motion == "record":
            return self.intensity
        return self.intensity * (self.alpha if self.model == "linear" else np.tan(self.alpha))

    @property
    def points(self) -> np.ndarray:
        """Indices of the scenes with a reference."""
        count = RECORD_POINTS if self.motion == "record" else POINTS
        return np.sort(np.random.default_rng(SEED).choice(self.size, min(count, self.size), replace=False))

    def columns(self, chosen=slice(None)) -> tuple[np.ndarray, ...]:
        """alpha, p, restitution, amplitude and rate of the chosen scenes, contiguous."""
        every = (self.alpha, self.p, self.restitution, self.amplitude, self.rate)
        return tuple(np.ascontiguousarray(values[chosen]) for values in every)


def surface(name, title, model, motion, intensities, rates, restitutions=(RESTITUTION,), drawn=True):
    """A map over restitutions, intensities and rates."""
    e, a, w = (x.ravel() for x in np.meshgrid(restitutions, intensities, rates, indexing="ij"))
    alpha, p = np.full(e.size, ALPHA), np.ones(e.size)
    return Problem(name, title, model, motion, alpha, p, e, a, w, restitutions, intensities, rates, drawn=drawn)


def sines(name, title, model, side, drawn):
    """A map of sine pulses with `side` x `side` points."""
    return surface(name, title, model, "sine", np.linspace(1.05, 10, side), np.linspace(0.3, 8, side), drawn=drawn)


def record_blocks(name, model, size=1000):
    """Blocks under the built-in record."""
    import jax

    jax.config.update("jax_enable_x64", True)  # also in the worker processes of a peer
    import jaxrock as rk

    record = rk.example_record()
    samples, dt = np.asarray(record.samples, float) * RECORD_SCALE, float(record.dt)
    random = np.random.default_rng(SEED)
    alpha, p = random.uniform(0.08, 0.3, size), random.uniform(0.8, 4.0, size)
    full = np.full(size, RESTITUTION)
    title = f"{size:,} blocks under a record of {samples.size:,} samples, {model}"
    one = np.full(size, 1.0)
    return Problem(name, title, model, "record", alpha, p, full, one, one, samples=samples, dt=dt)


def record_scales(size=200):
    """One block under the built-in record at many scales, between the first that lifts it and the first that is sure to
    overturn it."""
    blocks, full = record_blocks("P7", "nonlinear", 1), np.full(size, 1.0)
    scale = np.linspace(0.4, 2.4, size)
    alpha, p, restitution = ALPHA * full, 2.0 * full, RESTITUTION * full
    title = f"One block under {size} scales of a record of {blocks.samples.size:,} samples, nonlinear"
    return replace(
        blocks, title=title, alpha=alpha, p=p, restitution=restitution, intensity=scale, rate=full
    )  # fmt: skip


def load(name: str, quick: bool = False) -> list[Problem]:
    """A problem by its name; a map with references first, then the same on a coarser grid (speed only)."""
    if name in ("P1", "P2"):
        model = "linear" if name == "P2" else "nonlinear"
        title = f"Sine pulses, {model}"
        sizes = (256,) if quick else (256, 128)
        return [sines(name, f"{title}, {n} x {n}", model, n, n == 256) for n in sizes]
    if name == "P3":
        durations = np.linspace(0.5, 8, 128)
        title = f"Exponential pulses of shape {SHAPE:g}, nonlinear, 128 x 128"
        return [surface(name, title, "nonlinear", "exponential", np.linspace(1.05, 6, 128), 2 * math.pi / durations)]
    if name in ("P4", "P6"):
        return [record_blocks(name, "linear" if name == "P6" else "nonlinear")]
    if name == "P7":
        return [record_scales()]
    if name == "P5":
        title = "Chattering to rest, sine pulses, nonlinear, 4 x 64 x 64"
        intensities, rates = np.linspace(1.0005, 1.3, 64), np.linspace(0.1, 0.5, 64)
        return [surface(name, title, "nonlinear", "sine", intensities, rates, (0.5, 0.65, 0.8, 0.95))]
    raise ValueError(f"There is no problem {name!r}.")
