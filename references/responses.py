"""Scenes and their responses by the Taylor reference: peak, verdict, impacts, condition, states.

A scene is (block, kind, numbers) or (block, kind, numbers, options), see `answers`; its float64 numbers are taken as
exact. `kept` keeps what it finds in `responses.json`, `answers` keeps nothing.
"""

import concurrent.futures
import functools
import hashlib
import json
import math
import multiprocessing
import pathlib

from references.arithmetic import Arithmetic
from references.motions import motion
from references.taylor import DIGITS, ORDER, SMALL_HOP, Block, respond

FILE = pathlib.Path(__file__).with_suffix(".json")
CHANGE = "1e-10"  # relative change of the amplitude for condition numbers


def _scene(scene):
    """A scene with all its four parts."""
    block, kind, numbers, *options = scene
    return block, kind, numbers, options[0] if options else {}


def follow(scene, factor=1, times=(), arithmetic=None, order=ORDER):
    """The `Path` of a scene, inside the arithmetic's context."""
    numbers, kind, shape, options = _scene(scene)
    a = arithmetic or Arithmetic(DIGITS)
    block = Block(a, *numbers, options.get("model", "nonlinear") == "linear", order)
    return respond(
        block, motion(a, kind, shape, factor, options.get("delay", 0)), options.get("initial", (0, 0)), times
    )


def answer(scene, condition=False, arithmetic=None, order=ORDER, change=CHANGE):
    """The response to one scene; see `answers`. `change`: relative, of the amplitude, for the condition."""
    a = arithmetic or Arithmetic(DIGITS)
    with a.context():
        path = follow(scene, 1, (), a, order)
        scale = a.number(scene[0][0]) * a.number(scene[0][1])
        safe = not path.overturned
        known = {
            "overturned": bool(path.overturned),
            "peak": a.text(path.peak) if safe else None,
            "impacts": int(path.impacts),
            "impacts_large": sum(abs(v) > SMALL_HOP * scale for v in path.impact_velocities),
            "max_velocity": a.text(path.fastest) if safe else None,
            "time_of_peak": a.text(path.peak_time + 0 * scale) if safe and path.peak_time is not None else None,
            "slowest_impact": float(path.slowest / scale) if path.impact_velocities else None,
            "grazing": float(path.grazing) if path.grazing < math.inf else None,
            "dip": float(path.dip / a.number(scene[0][0])) if path.dip < math.inf else None,
            "condition": None,
        }
        if condition and safe:
            known["condition"] = _condition(scene, path, a, order, change)
    return known


def _condition(scene, path, a, order, change):
    """|d ln peak/d ln amplitude| by a central difference (None: nothing moves, or it overturns within it)."""
    change = a.number(change)
    sides = [follow(scene, 1 + s * change, (), a, order) for s in (1, -1)]
    if not path.peak or any(side.overturned for side in sides):
        return None
    return float(abs(sides[0].peak - sides[1].peak) / (2 * change * path.peak))


def _answer_or_error(condition, scene):
    try:
        return answer(scene, condition)
    except ArithmeticError as error:
        return {"error": str(error)}


def answers(scenes, condition=False, workers=1):
    """Responses to many scenes, not kept.

    **Arguments:**

    - `scenes`: (block, kind, numbers) or (block, kind, numbers, options): block = (alpha, p, restitution); kind and
      numbers of the motion as in `motions.motion`; options a dict of `model` ("nonlinear" or "linear"),
      `initial` (rotation [rad], velocity [rad/s]) and `delay` (quiet time before the motion [s]).
    - `condition`: whether to find `condition` too, at three times the cost.
    - `workers`: processes.

    **Returns:** a dict each: `overturned`; `peak` [rad], `max_velocity` [rad/s] and `time_of_peak` [s], 28 digits as
    text, None if overturned; `impacts` (every hop of the motion, and one after it if it overturns from there) and
    `impacts_large` (of the motion, above 1e-6 p alpha); `slowest_impact` (least speed over p alpha), `grazing` (least
    speed over p sqrt(alpha height), height the greatest opening before that impact) and `dip` (least opening over
    alpha where it turns outward again without touching) of the motion, None where there is none; `condition`,
    |d ln peak/d ln amplitude| or None. Where it cannot decide: `error`, the reason, alone.
    """
    judge = functools.partial(_answer_or_error, condition)
    if workers == 1:
        return [judge(scene) for scene in scenes]
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(workers, mp_context=context) as pool:
        return list(pool.map(judge, scenes, chunksize=max(1, min(32, len(scenes) // (4 * workers)))))


def history(scene, times=(), arithmetic=None):
    """States and impacts of one scene.

    **Returns:** a dict: `states`, (rotation, velocity) at the rising `times` (fewer if it overturns before the last);
    `impact_times` [s] and `impact_velocities` (before impact), to the end of the motion or a little past the last
    time, whichever is later; `overturned`. Numbers are mpmath's.
    """
    a = arithmetic or Arithmetic(DIGITS)
    with a.context():
        path = follow(scene, 1, [a.number(time) for time in times], a)
    return {
        "states": [(a.mpf(x), a.mpf(v)) for x, v in path.states],
        "impact_times": [a.mpf(time) for time in path.impact_times],
        "impact_velocities": [a.mpf(v) for v in path.impact_velocities],
        "overturned": bool(path.overturned),
    }


def _key(scene):
    """Return a text of all inputs of an answer, exactly."""
    block, kind, numbers, options = _scene(scene)
    words = [kind, *(repr(float(x)) for x in block)]
    if kind == "record":
        digest = hashlib.sha256(repr([float(u) for u in numbers[0]]).encode()).hexdigest()[:16]
        words += [digest, repr(float(numbers[1]))]
    else:
        words += [repr(float(x)) for x in numbers]
    return " ".join(words + [f"{name}={options[name]!r}" for name in sorted(options)])


def kept(cases, announce=print, workers=1):
    """Answers for many scenes with their condition, from the cache where it has them; new ones are added to it.

    **Arguments:** `cases`: scenes as in `answers`.

    **Returns:** a dict each, as `answers`.
    """
    cache = json.loads(FILE.read_text()) if FILE.exists() else {}
    keys = [_key(case) for case in cases]
    missing = list({key: case for key, case in zip(keys, cases) if key not in cache}.items())
    for first in range(0, len(missing), 50):
        part = missing[first : first + 50]
        cache |= zip([key for key, _ in part], answers([case for _, case in part], True, workers))
        announce(f"references: {first + len(part)} of {len(missing)} new responses")
        FILE.write_text(json.dumps(cache, indent=0, sort_keys=True))
    return [cache[key] for key in keys]
