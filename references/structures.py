"""Scenes of rocking structures and their responses by two independent solvers; `structures.json` keeps a table.

`python -m references.structures` makes the table. `random_scenes(kind, count, seed)` and `solve(scene)` give more.
Nothing is of jaxrock.

**Units.** R, m and p are those of the block alone, of one column in a frame: half its diagonal, its mass, and
p^2 = kappa g/R, kappa = `inertia_ratio` = m R^2/I about a corner (3/4 unless given). Lengths are in R, forces in m g,
stiffnesses in m g/R, dampers in m g/(R p) (rotational ones in m g R per dx/d(p t)), masses in m. Times are in seconds,
`p` in rad/s, `alpha` in rad, accelerations in g = 9.81 m/s^2. x >= 0 is the opening, w = dx/d(p t).

**Equation.** For a plain block on side s (the sign of its rotation; +1 tips towards +X)

    x'' = -[(1 + v) sin(alpha - x) + s u cos(alpha - x)] - (moments of restraints over m g R)

with ground accelerations u (horizontal, to +X) and v (up); u > tan(alpha) lifts it to side -1. An impact multiplies w
by -e, and a two-sided structure changes its side. Restraints are not multiplied by 1 + v.

**A scene** has `alpha`, `p`, `restitution` (always a number), `structure`, `motion` and perhaps `vertical` (a motion).

Structures (`structure["kind"]`), each with `sides` (2; or 1 with `side`) and `restraints`:

- "block";
- "frame": `columns`, `beam_ratio` (mass of the beam over that of all columns); restraints are those of each column;
- "pinned": a point of mass `mass_ratio` at the centre of the top;
- "inerter": `inertance_ratio`, inertance over m, of the centre's horizontal motion relative to the ground;
- "oscillator": tied rigidly to the top corner far from the pivot: `mass_ratio`, `frequency_ratio` (omega/p), `damping`
  (ratio); it moves horizontally only;
- "strip": a wall from floor to floor cracked in two; the upper part's height is `height_ratio` (at least 1) of the
  lower's, which is the block, `load_ratio` the mass on top, which moves vertically only.

Restraints (`kind`), as moments over m g R:

- "tendon" (`stiffness` K, `prestress` P0): [P0 + K 2 sin(alpha) sin(x/2)] sin(alpha) cos(x/2), found from geometry
  (with `damping` c as the "damper" at the `centre`);
- "tie" (`height` d, `stiffness` k, perhaps `yields` or `breaks` [m g], `damping` c): T d cos x + c (d cos x)^2 w, one
  on each side of two, tension only. T = k d sin x; with `yields` F: k (d sin x - r) within [0, F], slack
  r = max(greatest elongation on this side - F/k, 0); with `breaks` F: T and damping end for good where k d sin x = F;
- "damper" (`rotational` c, `centre` c, `horizontal` c at `height` d):
  c w, c sin^2(alpha) cos^2(x/2) w, c d^2 cos^2(x) w;
- "link" (`ground`, `body`: points from the centre of the base, to +X and up; `stiffness`, `prestress`, `damping`).

Motions (`kind`):

- "sine", "cosine" (one cycle), "half sine", "harmonic" (a sine of many `cycles`): `amplitude` [g], `period` [s] of the
  whole sine, so a half sine lasts period/2;
- "ricker": A (1 - 2 y^2) exp(-y^2), y = pi (t - `center`)/`period`, up to 2 `center`;
- "record": `samples` [g], `dt` [s], straight lines between;
- "floor": `ground` (a motion) moves an oscillator (`period`, `damping_ratio`) or a chain (`masses`, `stiffnesses`
  [1/s^2], `dampings` [1/s], `storey` counted from 1). The absolute acceleration of the storey moves the block for the
  length of `ground` and `after` seconds more; then it is zero.

**A result** has

- `overturned`: x reaches pi/2;
- `peak` [rad], `time_of_peak` [s], `max_velocity` [rad/s]: free stage included; None if overturned;
- `impacts`: during the motion, faster than 1e-6 p alpha; None if overturned;
- `uplift` [g]: the horizontal acceleration that lifts it at rest; `natural_restitution`: of ideal impulses;
- `near`: whether the verdict changes within 1e-6 of the amplitude;
- `agreement`: relative difference of the peak between the two solvers.

Numbers are those of `Extrapolation("long")`.
"""

import concurrent.futures
import json
import multiprocessing
import pathlib

from references.structures_path import Path
from references.structures_physics import Structure, numbers
from references.structures_scenes import KINDS, random_scenes, scaled, uplift
from references.structures_steps import Extrapolation, Runge

FILE = pathlib.Path(__file__).with_suffix(".json")
COUNT = 20  # of scenes of each kind in the table
AGREEMENT = 1e-11  # of the solvers, in the table; scenes that agree worse are left out
__all__ = ["KINDS", "follow", "random_scenes", "solve", "table", "uplift"]


def follow(scene, solver="extrapolation"):
    """Follow a scene: by "extrapolation" in 80 bits, "runge" (SciPy's DOP853), or "mpmath" (30 digits, slow)."""
    steppers = {
        "runge": Runge,
        "extrapolation": lambda: Extrapolation("long"),
        "mpmath": lambda: Extrapolation("mpmath"),
    }
    return Path(scene, steppers[solver]()).follow()


def solve(scene, solver="runge", near=False):
    """Response to a scene; see the module for what it holds. `near`: try 1e-6 more and less of the motion, too."""
    path = follow(scene, solver)
    stands = not path.overturned
    if path.unsettled:
        raise ArithmeticError("The structure neither falls nor comes down; it may stand on a second equilibrium.")
    result = {
        "overturned": path.overturned,
        "peak": float(path.peak) if stands else None,
        "time_of_peak": float(path.peak_tau / path.p) if stands else None,
        "max_velocity": float(path.fastest * path.p) if stands else None,
        "impacts": path.impacts if stands else None,
        "uplift": uplift(scene),
        "natural_restitution": float(Structure(scene, numbers("long")).natural_restitution()),
    }
    if near:
        verdicts = [follow(scaled(scene, factor), "runge").overturned for factor in (1 - 1e-6, 1 + 1e-6)]
        result["near"] = verdicts != [path.overturned] * 2
    return result


def checked(scene):
    """Response to a scene by both solvers, or None where they do not agree."""
    try:
        exact, other = solve(scene, "extrapolation", near=True), solve(scene, "runge")
    except ArithmeticError:
        return None
    for name in ("uplift", "natural_restitution"):
        exact[name] = float(f"{exact[name]:.13g}")
    if exact["overturned"] or other["overturned"]:
        exact["agreement"] = None
        return exact if exact["overturned"] == other["overturned"] and not exact["near"] else None
    if not exact["peak"]:
        return None  # it never lifts
    exact["agreement"] = abs(other["peak"] / exact["peak"] - 1)
    same = exact["agreement"] < AGREEMENT and exact["impacts"] == other["impacts"]
    same = same and abs(other["max_velocity"] / exact["max_velocity"] - 1) < AGREEMENT
    for name in ("peak", "time_of_peak", "max_velocity"):
        exact[name] = float(f"{exact[name]:.13g}")
    exact["agreement"] = float(f"{exact['agreement']:.1e}")
    return exact if same else None


def table(count=COUNT, workers=2, announce=print):
    """Scenes and results of each kind: the first ones on whose responses the solvers agree."""
    found = {}
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(workers, mp_context=context) as pool:
        for kind in KINDS:
            scenes, good, tried = random_scenes(kind, 3 * count, seed=1), [], 0
            while len(good) < count and tried < len(scenes):
                some = scenes[tried : tried + max(workers, count - len(good))]
                results = pool.map(checked, some)
                good += [{**scene, "result": result} for scene, result in zip(some, results) if result]
                tried += len(some)
            stands = sum(not scene["result"]["overturned"] for scene in good)
            announce(f"{kind}: {tried - len(good)} of {tried} left out; {stands} of {len(good)} stand", flush=True)
            found[kind] = good[:count]
    return found


if __name__ == "__main__":
    FILE.write_text(json.dumps(table(), separators=(",", ":")).replace('{"alpha"', '\n{"alpha"') + "\n")
