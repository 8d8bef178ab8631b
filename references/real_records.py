"""Judge of blocks under records: verdict and peak of one scene, in as many digits as its chaos needs.

Under real records blocks chatter, and a small change grows until float64 cannot follow the motion. Here a scene runs
in fixed-point numbers of 38 digits (`real_records.c`, compiled on demand by `cc`), twice: as it is, and with another
slenderness and steps half as long. The change of slenderness is far above the rounding errors and small beside the
precision. Where both motions stay together to the end the digits sufficed; otherwise more digits follow, up to 308,
and then the scene is open.

It shares nothing with jaxrock: a scene is its float64 numbers, taken as exact. The samples times the scale are the
exact products, as `scale * record` means. `references.taylor` is its independent check, and `references.chaotic` the
scenes that anyone can rebuild.
"""

import ctypes
import functools
import math
import os
import pathlib
import subprocess
import tempfile
from dataclasses import dataclass

import numpy as np

SOURCE = pathlib.Path(__file__).with_suffix(".c")
LIMBS = (2, 3, 4, 6, 8, 12, 16)  # words of 64 bits behind the point, from few digits to many
CHANGE = 2**20  # of alpha, in units of the last bit; a million roundings
SAME_PEAK = 1e-6  # relative difference of two peaks that count as one
TOGETHER = 1e-6  # distance over alpha up to which two motions are one
BUDGET = 20_000_000  # steps of one run
BUILD = ("-O3", "-shared", "-fPIC", "-w")


@dataclass(frozen=True)
class Scene:
    """A block and a record.

    - `samples`: of the ground's acceleration [g], the first at time 0, straight lines between them.
    - `dt`: time between samples [s].
    - `scale`: factor of the samples.
    - `alpha`, `p`, `restitution`: of the block; a number each.
    """

    samples: np.ndarray
    dt: float
    scale: float
    alpha: float
    p: float
    restitution: float


@dataclass(frozen=True)
class Run:
    """One run of a scene.

    - `overturned`: None where the step budget was used up.
    - `peak`: greatest rotation over alpha, the first top after the record included; if it overturns, before that.
    - `time_of_peak`: [s].
    - `impacts`, `steps`: numbers of them, the free stage included.
    - `rotations`: at the samples [rad]; 0 after it has fallen flat.
    """

    overturned: bool | None
    peak: float
    time_of_peak: float
    impacts: int
    steps: int
    rotations: np.ndarray


@dataclass(frozen=True)
class Judgement:
    """The truth about a scene, as far as it was found.

    - `overturned`: None where it is open.
    - `peak`: over alpha, inf if it overturns; `time_of_peak`: [s], NaN if it overturns. NaN where it is open.
    - `digits`: with which it was decided, or the most that were tried.
    - `distance`: greatest distance of the two motions over alpha, in those digits.
    - `runs`: the last two.
    """

    overturned: bool | None
    peak: float
    time_of_peak: float
    digits: int
    distance: float
    runs: tuple[Run, Run]


def digits_of(limbs):
    """Decimal digits behind the point of numbers with so many words."""
    return int(64 * limbs * math.log10(2))


@functools.cache
def _folder():
    """Folder of what is compiled, removed when the process ends."""
    return tempfile.TemporaryDirectory(prefix="real_records")


@functools.cache
def compiled(limbs):
    """Compile the solver for numbers with so many words behind the point."""
    file = pathlib.Path(_folder().name) / f"real_records_{limbs}.so"
    words = [os.environ.get("CC", "cc"), *BUILD, f"-DLIMBS={limbs}", "-o", str(file), str(SOURCE), "-lm"]
    subprocess.run(words, check=True)
    function = ctypes.CDLL(str(file)).follow
    numbers, real, whole = np.ctypeslib.ndpointer(float, flags="C"), ctypes.c_double, ctypes.c_int
    function.argtypes = [numbers, whole, *[real] * 5, ctypes.c_int64, whole, ctypes.c_long, numbers, numbers]
    function.restype = whole
    return function


def follow(scene, limbs=LIMBS[0], change=0, parts=1, budget=BUDGET):
    """Follow a scene through its record and to the first top after it.

    **Arguments:**

    - `limbs`: words of 64 bits behind the point.
    - `change`: of alpha, in units of the last bit.
    - `parts`: steps between two samples, at least.
    - `budget`: most steps.
    """
    samples = np.ascontiguousarray(scene.samples, float)
    block = [float(x) for x in (scene.dt, scene.scale, scene.alpha, scene.p, scene.restitution)]
    rotations, found = np.zeros(len(samples)), np.zeros(4)
    verdict = compiled(limbs)(samples, len(samples), *block, change, parts, budget, rotations, found)
    peak, time, impacts, steps = found
    return Run(None if verdict < 0 else bool(verdict), peak, time, int(impacts), int(steps), rotations)


def distance(scene, one, other):
    """Greatest distance of two runs at the samples, over alpha, or over the rotation where that is larger."""
    size = np.maximum(scene.alpha, np.minimum(abs(one.rotations), abs(other.rotations)))
    return float(np.max(abs(one.rotations - other.rotations) / size))


def agree(scene, one, other):
    """Return whether two runs have one verdict and one peak, and stay together from the first sample to the last."""
    if one.overturned is None or one.overturned != other.overturned:
        return False
    same = one.overturned or abs(one.peak - other.peak) <= SAME_PEAK * max(one.peak, other.peak)
    return bool(same and distance(scene, one, other) <= TOGETHER)


def judge(scene, ladder=LIMBS, budget=BUDGET):
    """Decide a scene with the fewest digits of the ladder that suffice.

    **Returns:** a `Judgement`.
    """
    for limbs in ladder:
        runs = follow(scene, limbs, budget=budget), follow(scene, limbs, CHANGE, 2, 2 * budget)
        if agree(scene, *runs):
            fallen, (first, _) = runs[0].overturned, runs
            peak, time = (math.inf, math.nan) if fallen else (first.peak, first.time_of_peak)
            return Judgement(fallen, peak, time, digits_of(limbs), distance(scene, *runs), runs)
        if any(run.overturned is None for run in runs):
            break
    return Judgement(None, math.nan, math.nan, digits_of(limbs), distance(scene, *runs), runs)
