"""Derivatives of rocking responses from 40-digit Taylor series: random scenes, central differences with Richardson.

Writes `derivatives.json`: for each scene the greatest rotation [rad], the greatest angular velocity [rad/s] and
the time of the greatest rotation [s], with their first derivatives with respect to the block's and the motion's
parameters; for some the Hessian of the greatest rotation, for some records derivatives with respect to single samples.
The integrator is `taylor`; the parameters of its runs are changed in 40 digits by 1e-9 and 2e-9 of their
size, and a scene is kept only where both differences agree (which shows that no impact appears and no other peak
takes over within the step). Nothing but the samples of the built-in record comes from jaxrock.

    python -m references.derivatives          # goes on where an earlier run stopped
    python -m references.derivatives check    # 20 scenes again, in 60 digits with order 44 and another step
"""

import collections
import hashlib
import itertools
import json
import math
import pathlib
import sys
import time

import numpy as np

from references.arithmetic import Arithmetic
from references.differences import (
    NAMES,
    OUTPUTS,
    Scene,
    deviations,
    gradient,
    hessian,
    record,
    single_samples,
    texts,
)
from references.taylor import SMALL_HOP

ANSWERS = pathlib.Path(__file__).with_suffix(".json")
SEED = 20240611
AGREE = 1e-12  # of the differences with the step and twice the step
NEAR = 1e-3  # scenes nearer to grazing than this are left out
TIE = 1e-6  # second greatest peak relative to the greatest
COUNTS = {
    "sine": 280,
    "exponential": 100,
    "half sine": 50,
    "cosine": 50,
    "ricker symmetric": 50,
    "triangle": 30,
    "record": 70,
}
HESSIANS = 6  # every sixth pulse has a Hessian
SAMPLED = 7  # every seventh record has derivatives with respect to single samples

ABOUT = (
    "Derivatives of rocking responses by references/derivatives.py: 40-digit Taylor series, central "
    "differences with relative steps 1e-9 and 2e-9 and Richardson extrapolation. `block`: alpha, p, restitution; "
    "`motion`: its numbers in the order of `names` (a record: the factor of all samples of jaxrock.example_record()), "
    "all float64 taken as exact. Ricker: the centre is 5.7/pi periods (the float64 quotient), and moves with the "
    "period. `max_rotation` [rad], `max_velocity` [rad/s], `time_of_max` [s] have a `value` and a `gradient` in the "
    "order of `names`. `hessian`: of max_rotation, for the first five names. `samples`: derivatives with respect to "
    "samples of the record before the factor, so motion = factor * samples. `impacts`: with every hop; "
    "`impacts_large`: above 1e-6 p alpha, in the motion; `impacts_before_peak`: of those; `rests_before_peak`: "
    "whether hops died out before the peak. `disagreement`: worst relative difference of the two differences, in "
    "elasticities."
)


def judge(scene, path, many):
    """Why a scene is not wanted, or None; and what is noted of it."""
    if path.overturned:
        return "overturned", None
    if not path.peak:
        return "no uplift", None
    if path.peak_time is None:
        return "no peak time", None
    scale, peak_time = scene.parameters[0] * scene.parameters[1], path.peak_time
    large = [t for t, v in zip(path.impact_times, path.impact_velocities) if abs(v) > SMALL_HOP * scale]
    before = [abs(v) / scale for t, v in zip(path.impact_times, path.impact_velocities) if t < peak_time]
    notes = {
        "impacts": int(path.impacts),
        "impacts_large": len(large),
        "impacts_before_peak": sum(t < peak_time for t in large),
        "rests_before_peak": bool(before) and float(min(before)) < 1e-20,
        "slowest_before_peak": float(min(before)) if before else None,
        "grazing": float(path.grazing) if path.grazing < math.inf else None,
        "dip": float(path.dip / scene.parameters[0]) if path.dip < math.inf else None,
    }
    if path.grazing < NEAR or path.dip < NEAR * scene.parameters[0]:
        return "grazing", None
    if before and 1e-20 < min(before) < NEAR and not notes["rests_before_peak"]:
        return "slow impact", None
    close = [x for x in path.tops if x > path.peak * (1 - TIE)]
    if len(close) > 1:
        return "tie", None
    if scene.kind == "record":
        return ("impacts" if len(large) > 150 else None), notes
    if not (5 if many else 0) <= len(large) <= 20:
        return "impacts", None
    return None, notes


def draw(rng, model, kind, many, peak):
    """Float64 parameters of a random scene."""
    alpha, restitution = rng.uniform(0.1, 0.35), rng.uniform(0.8, 0.97)
    p = math.exp(rng.uniform(0, math.log(4)))
    top, ratios = (1.6, (0.15, 1.5)) if many and kind != "record" else (6, (0.3, 6))
    intensity = math.exp(rng.uniform(math.log(1.05), math.log(top)))
    ratio = math.exp(rng.uniform(*map(math.log, ratios)))
    amplitude = intensity * (alpha if model == "linear" else math.tan(alpha))
    if kind == "record":
        return [alpha, p, restitution, amplitude / peak]
    names = NAMES[kind]
    length = (2 if "period" in names else 1) * math.pi / (ratio * p)
    shape = rng.uniform(-30, 10)
    if rng.random() < 0.1:
        shape = [0.0, 1e-3, -1e-3, 1.0, -1.0][rng.integers(5)]
    return [alpha, p, restitution, amplitude, length] + [shape] * ("shape" in names)


def plan():
    """Model, kind, whether many impacts are wanted and whether a Hessian is, of every scene; well mixed."""
    kinds = [kind for kind, count in COUNTS.items() for _ in range(count)]
    kinds = [kinds[i] for i in np.random.default_rng(SEED).permutation(len(kinds))]
    seen, pulses = collections.Counter(), 0
    for kind in kinds:
        nth, pulses = seen[kind], pulses + (kind != "record")
        seen[kind] += 1
        yield (
            ("nonlinear", "linear")[nth % 2],
            kind,
            nth % 4 >= 2 and kind != "record",
            kind != "record" and pulses % HESSIANS == 0,
            kind == "record" and nth % SAMPLED == 0,
        )


def first(scene, many, dropped):
    """The path of a scene, what is noted of it and its gradient; without the gradient where it is not wanted."""
    try:
        path = scene.run()
        reason, notes = judge(scene, path, many)
        slopes = None if reason else gradient(scene, path)
    except ArithmeticError as error:
        dropped[str(error)] += 1
        return None, None, None
    if slopes is None:
        dropped[reason or "impact within the step"] += 1
    return path, notes, slopes


def find(a, index, model, kind, many, second, sampled, samples, dropped):
    """One scene with all that is stored of it."""
    rng = np.random.default_rng([SEED, index])
    peak = max(abs(u) for u in samples[0])
    while True:
        parameters = draw(rng, model, kind, many, peak)
        scene = Scene(a, model, kind, parameters, samples)
        path, notes, slopes = first(scene, many, dropped)
        if slopes is None:
            continue
        rows, runs, worst = slopes
        if worst > AGREE:
            dropped["differences disagree"] += 1
            continue
        known = {
            "index": index,
            "model": model,
            "kind": kind,
            "block": [float(x) for x in parameters[:3]],
            "motion": [float(x) for x in parameters[3:]],
            "names": list(scene.names),
        }
        values = (path.peak, path.fastest, path.peak_time + 0 * path.peak)
        for name, value, row in zip(OUTPUTS, values, rows):
            known[name] = {"value": a.text(value, 20), "gradient": texts(a, row)}
        known |= notes | {"disagreement": worst}
        if second:
            found = hessian(scene, path, runs)
            if found is None or found[1] > 1e-9:
                dropped["Hessian"] += 1
                continue
            known |= {"hessian": [texts(a, row) for row in found[0]], "hessian_disagreement": found[1]}
        if sampled:
            found = single_samples(scene, path)
            if found is None or found[2] > AGREE:
                dropped["samples"] += 1
                continue
            chosen, pairs, worst = found
            known["samples"] = {
                "moving": chosen["moving"],
                "rest": chosen["rest"],
                "after": chosen["after"],
                "indices": [i for i, _ in pairs],
                **{name: texts(a, [row[k] for _, row in pairs]) for k, name in enumerate(OUTPUTS)},
                "disagreement": worst,
            }
        return known


def main():
    """Compute what is missing."""
    samples = record()
    digest = hashlib.sha256(repr(samples[0]).encode()).hexdigest()[:16]
    stored = json.loads(ANSWERS.read_text()) if ANSWERS.exists() else {}
    scenes, dropped = stored.get("scenes", []), collections.Counter(stored.get("dropped", {}))
    done, begin, a = {scene["index"] for scene in scenes}, time.time(), Arithmetic(40)

    def write():
        head = {"about": ABOUT, "record": {"count": len(samples[0]), "dt": samples[1], "sha256": digest}}
        head["dropped"] = dict(sorted(dropped.items()))
        lines = ",\n".join(json.dumps(scene) for scene in sorted(scenes, key=lambda scene: scene["index"]))
        text = json.dumps(head)[:-1] + ', "scenes": [\n' + lines + "\n]}\n"
        fresh = ANSWERS.with_suffix(".part")
        fresh.write_text(text)
        fresh.replace(ANSWERS)

    tasks = [(i, *what) for i, what in enumerate(plan()) if i not in done]
    for count, task in enumerate(tasks, 1):
        with a.context():
            scenes.append(find(a, *task, samples, dropped))
        if count % 20 == 0 or count == len(tasks):
            write()
            print(f"{len(scenes)} scenes, {time.time() - begin:.0f} s, dropped {dict(dropped)}", flush=True)


def check(count=20):
    """Some of the stored scenes in 60 digits with another order and step: prints the worst relative differences."""
    samples, scenes, a = record(), json.loads(ANSWERS.read_text())["scenes"], Arithmetic(60)
    pick = np.random.default_rng(1).choice(len(scenes), count, replace=False)
    chosen = [scenes[i] for i in pick] + [next(s for s in scenes if "samples" in s)]
    for known in chosen:
        with a.context():
            scene = Scene(a, known["model"], known["kind"], known["block"] + known["motion"], samples, 44)
            path = scene.run()
            rows, runs, worst = gradient(scene, path, -12)
            errors = deviations(a, known, scene, path, rows)
            words = f"{known['model']} {known['kind']}: values and gradients {max(errors):.1e}"
            if "hessian" in known:
                table, _ = hessian(scene, path, runs, -12)
                flat = zip(itertools.chain(*table), itertools.chain(*known["hessian"]))
                words += f", Hessian {max(float(abs(b - a.number(c)) / (abs(b) or 1)) for b, c in flat):.1e}"
            if "samples" in known:
                _, pairs, _ = single_samples(scene, path, -12)
                for k, name in enumerate(OUTPUTS):
                    both = [(row[k], a.number(c)) for (_, row), c in zip(pairs, known["samples"][name])]
                    words += f", samples {max(float(abs(b - c) / (abs(b) or 1)) for b, c in both):.1e}"
            print(words, flush=True)


if __name__ == "__main__":
    check() if "check" in sys.argv else main()
