"""Checks of the Taylor reference against closed forms, energy, other precisions and, if given, a table of the papers.

Run it by `python -m references.taylor_checks [papers.json]`.
"""

import json
import math
import random
import sys

from mpmath import mp, mpf

from references import peer_problems, peers
from references.arithmetic import Arithmetic
from references.motions import motion
from references.responses import follow, history
from references.taylor import Block

PULSES = (
    "sine", "cosine", "half sine", "rectangle", "triangle", "exponential", "ricker symmetric", "ricker antisymmetric",
)  # fmt: skip
LINEAR = {"model": "linear"}


def random_scenes(count, seed=1):
    """Scenes of all pulses, both models, some with initial motion or a delay."""
    draw = random.Random(seed)
    scenes = []
    for i in range(count):
        kind, alpha, p = PULSES[i % len(PULSES)], draw.uniform(0.05, 0.5), draw.uniform(0.5, 5.0)
        numbers = [draw.choice((-1, 1)) * math.tan(alpha) * draw.uniform(0.8, 6.0), draw.uniform(0.3, 6.0) / p]
        options = {"model": draw.choice(("nonlinear", "linear"))}
        if kind == "exponential":
            numbers.append(draw.choice((-60.0, -3.0, -1e-9, 0.0, 1e-12, 2.0, 80.0)))
        if i % 3 == 0:
            options["initial"] = (draw.uniform(-0.9, 0.9) * alpha, draw.uniform(-0.4, 0.4) * p * alpha)
        if i % 5 == 0:
            options["delay"] = draw.uniform(0.1, 1.0)
        scenes.append(((alpha, p, draw.uniform(0.5, 1.0)), kind, tuple(numbers), options))
    return scenes


def outcome(scene, arithmetic, order):
    """Verdict, number of impacts, and (peak over alpha, greatest speed over p alpha, p time of peak) if it is safe."""
    with arithmetic.context():
        path, (alpha, p, _) = follow(scene, arithmetic=arithmetic, order=order), scene[0]
        numbers = () if path.overturned else (path.peak / alpha, path.fastest / (p * alpha), path.peak_time * p)
        numbers = [arithmetic.mpf(x + 0 * path.x) for x in numbers]
    return path.overturned, path.impacts, numbers


def against_others(count=400, slow_count=48):
    """Worst differences from order 42 and 60 digits, and from plain mpmath, over random scenes."""
    worst, safe = [mpf(0), mpf(0)], 0
    for i, scene in enumerate(random_scenes(count)):
        own = outcome(scene, Arithmetic(40), 30)
        others = [outcome(scene, Arithmetic(60), 42)]
        if i < slow_count:
            others.append(outcome(scene, Arithmetic(40, "mpmath"), 30))
        safe += not own[0]
        for k, other in enumerate(others):
            if other[:2] != own[:2]:
                raise AssertionError(f"Another verdict or number of impacts: {scene}")
            worst[k] = max([worst[k], *(abs(x - y) for x, y in zip(own[2], other[2]))])
    names = f"order 42 and 60 digits, {count} scenes, {safe} safe", f"plain mpmath, {slow_count} scenes"
    return dict(zip(names, worst))


def direct(kind, numbers, t):
    """Acceleration of a pulse by its definition [g]."""
    amplitude, length = mpf(numbers[0]), mpf(numbers[1])
    x, whole = t / length, 2 * mp.pi * t / length
    if kind.startswith("ricker"):
        center = mpf((5.7 / math.pi if kind == "ricker symmetric" else 8.2 * math.sqrt(3) / (2 * math.pi)) * numbers[1])
        y = mp.pi * (t - center) / length
        if kind == "ricker symmetric":
            return amplitude * (1 - 2 * y**2) * mp.exp(-(y**2))
        y, top = 2 * y / mp.sqrt(3), mp.sqrt(3 - mp.sqrt(6))
        return amplitude * (y**3 - 3 * y) * mp.exp(-(y**2) / 2) / (top * mp.sqrt(6) * mp.exp(-(top**2) / 2))
    near = min(x, 1 - x)
    if kind == "exponential" and numbers[2]:
        with mp.workdps(100):
            return amplitude * (1 - mp.exp(2 * mpf(numbers[2]) * near)) / (1 - mp.exp(mpf(numbers[2])))
    return amplitude * {
        "sine": mp.sin(whole), "cosine": mp.cos(whole), "half sine": mp.sin(whole / 2), "rectangle": 1,
        "triangle": 2 * near, "exponential": 2 * near,
    }[kind]  # fmt: skip


def against_definitions(count=80):
    """Worst difference of the accelerations' series from the definitions, and of the uplift from a plain search."""
    a, worst, late = Arithmetic(40), mpf(0), mpf(0)
    draw = random.Random(2)
    for block, kind, numbers, _ in random_scenes(count, 3):
        with a.context():
            own = motion(a, kind, numbers)
            for piece in range(own.pieces):
                local, unit = own.length(piece) * draw.random(), own.length(piece) / 1000
                series = own.series(piece, local, unit, 30)
                now = a.mpf(own.start(piece) + local)
                value = a.mpf(sum(series))
                worst = max(worst, abs(value - direct(kind, numbers, now + a.mpf(unit))))
                worst = max(worst, abs(a.mpf(series[0]) - direct(kind, numbers, now)))
                threshold = a.number(block[0])
                time = own.uplift(piece, local, threshold)
                end = own.length(piece) if time is None else time
                tops = [abs(own.series(piece, local + (end - local) * k / 200, 1, 0)[0]) for k in range(1, 200)]
                if end > local:
                    late = max(late, a.mpf(max(tops) - threshold))
                if time is not None and time > local:
                    worst = max(worst, abs(a.mpf(abs(own.series(piece, time, 1, 0)[0]) - threshold)))
    if late > 0:
        raise AssertionError("An uplift was missed.")
    return {"accelerations": worst}


def free_linear():
    """Worst difference of impact times of a linear block released at rest (Housner's closed form)."""
    worst, mp.dps = mpf(0), 80  # the closed form cancels at small hops
    for alpha, p, restitution, part in ((0.2, 1.5, 0.9, 0.6), (0.1, 3.0, 0.7, 0.99), (0.3, 1.0, 1.0, 0.01)):
        found = history(((alpha, p, restitution), "quiet", (6.0,), {"model": "linear", "initial": (part * alpha, 0)}))
        peak, time = mpf(part * alpha) / mpf(alpha), mpf(0)
        for impact in found["impact_times"]:
            time += mp.acosh(1 / (1 - peak)) / p
            worst = max(worst, abs(impact - time))
            peak = 1 - mp.sqrt(1 - mpf(restitution) ** 2 * (1 - (1 - peak) ** 2))
            time += mp.acosh(1 / (1 - peak)) / p
    mp.dps = 40
    return {"linear free rocking, impact times": worst}


def sine_linear():
    """Worst difference of states of a linear block under a sine pulse before any impact."""
    alpha, p, amplitude, period = (mpf(x) for x in (0.2, 1.5, 0.9, 1.25))
    rate, times = 2 * mp.pi / period, [mpf(k) / 16 for k in range(2, 20)]
    scene = ((0.2, 1.5, 0.9), "sine", (0.9, 1.25), {"model": "linear"})
    found = history(scene, times=[float(t) for t in times])
    start, forced = mp.asin(alpha / amplitude) / rate, amplitude * p**2 / (rate**2 + p**2)
    first, worst = found["impact_times"][0] if found["impact_times"] else mp.inf, mpf(0)
    for t, (x, v) in zip(times, found["states"]):
        if start < t < first:
            c = alpha - forced * mp.sin(rate * start)
            d = -forced * rate * mp.cos(rate * start) / p
            grown, slope = p * (t - start), forced * rate * mp.cos(rate * t)
            exact = -alpha + forced * mp.sin(rate * t) + c * mp.cosh(grown) + d * mp.sinh(grown)
            worst = max(worst, abs(x - exact), abs(v - slope - p * (c * mp.sinh(grown) + d * mp.cosh(grown))))
    return {"linear sine pulse, states": worst}


def energy():
    """Worst change of the energy between impacts, under constant acceleration."""
    worst = mpf(0)
    for linear in (False, True):
        alpha, p, u = mpf(0.25), mpf(2.0), mpf(0.1)
        options = {"model": "linear" if linear else "nonlinear", "initial": (0.15, -0.1)}
        found = history(((0.25, 2.0, 0.8), "rectangle", (0.1, 5.0), options), [k / 64 for k in range(1, 320)])
        impacts, before = found["impact_times"], {}
        for k, (x, v) in enumerate(found["states"], 1):
            s, arc = mp.sign(x), sum(time < mpf(k) / 64 for time in impacts)
            potential = mp.cos(s * alpha - x) - u * mp.sin(s * alpha - x)
            if linear:
                potential = s * alpha * x - x**2 / 2 + u * x
            total = v**2 / (2 * p**2) + potential
            worst = max(worst, abs(total - before.setdefault(arc, total)) if s else 0)
    return {"energy between impacts": worst}


def against_stored(count=20):
    """Worst difference of peak over alpha from references that are stored, with 60 digits."""
    a, worst = Arithmetic(60), mpf(0)
    problem, stored = peer_problems.load("P1")[0], json.loads(peers.FILE.read_text())["P1"]
    for known in stored[:: len(stored) // count]:
        with a.context():
            block, path = peers.path_of(a, problem, known["index"])
            if path.overturned != (known["peak"] is None):
                raise AssertionError(f"Another verdict: {known['index']}")
            if not path.overturned:
                worst = max(worst, abs(a.mpf(path.peak / block.alpha) - mpf(known["peak"])))
    return {"stored references": worst}


# The table of the papers


def voyagaki(table):
    """Linear exponential pulses: verdicts at the safety wall (1 -+ 1e-12), peaks, their times, first impacts."""
    a, worst = Arithmetic(40), mpf(0)
    for row in table["data"]:
        with a.context():
            f, shape = a.number(row["f"]), row["beta"].split()[0]
            kind = "rectangle" if shape == "rect" else "exponential"
            shape = {"pi": a.pi, "-pi": -a.pi, "rect": 0}.get(shape) or shape
            alpha = a.number("0.2")

            def scene(strength, alpha=alpha, f=f, shape=shape, kind=kind):
                return (alpha, f, "0.9"), kind, (-alpha / strength, 1, shape)[: 3 if kind[0] == "e" else 2], LINEAR

            wall = a.number(row["eta_crit"])
            for side in (-1, 1):
                if follow(scene(wall * (1 + side * a.number("1e-12"))), arithmetic=a).overturned != (side < 0):
                    raise AssertionError(f"Another verdict at the wall: {row['beta']} {row['f']}")
            for point in row["points"]:
                path = follow(scene(a.number(point["eta"])), 1, [a.number(point["first_impact_tau"])], a)
                pairs = [
                    (path.peak / alpha, point["theta_max_over_alpha"]), (path.peak_time, point["tau_m"]),
                    (path.impact_times[0], point["first_impact_tau"]),
                    (path.impact_velocities[0] / (f * alpha), point["pre_impact_dtheta_dt_over_p_alpha"]),
                ]  # fmt: skip
                worst = max([worst, *(abs(a.mpf(own / a.number(text) - 1)) for own, text in pairs)])
    return {"papers, exponential pulses (relative)": worst}


def linear_sine(a, row, intensity):
    """Scene of a linear sine pulse: a = a_g/(g alpha)."""
    alpha = a.number("0.2")
    return (alpha, 1, row["restitution"]), "sine", (alpha * intensity, 2 * a.pi / a.number(row["omega"])), LINEAR


def intervals(table):
    """Linear sine pulses: verdicts on both sides of every interval's ends (1e-11)."""
    a, count = Arithmetic(40), 0
    ends = [(row, interval, name) for row in table["intervals"] for interval in row["overturning_intervals_in_a"]
            for name in ("lower", "upper") if interval[name]]  # fmt: skip
    with a.context():
        for row, interval, name in ends:
            for side in (-1, 1):
                edge = a.number(interval[name]["a"]) + side * a.number("1e-11")
                inside = (side > 0) == (name == "lower")
                count += follow(linear_sine(a, row, edge), arithmetic=a).overturned != inside
    return {f"papers, wrong verdicts beside {len(ends)} ends of overturning intervals": count}


def safe_points(table):
    """Linear sine pulses: peaks and all impacts of safe points."""
    a, worst = Arithmetic(40), mpf(0)
    with a.context():
        for row, point in [(group, x) for group in table["safe_points"] for x in group["points"]]:
            path = follow(linear_sine(a, row, a.number(point["a"])), arithmetic=a)
            uplift = a.number(point["psi"]) / a.number(row["omega"])
            pairs = [(path.peak * 5, point["theta_max_over_alpha"])]
            late = path.peak_time - uplift - a.number(point["tau_theta_max"])
            half = a.pi / a.number(row["omega"])  # blocks that come to rest have the same peak half a cycle later
            worst = max(worst, a.mpf(min(abs(late), abs(abs(late) - half))))
            for time, velocity, impact in zip(path.impact_times, path.impact_velocities, point["impacts"]):
                pairs += [(time - uplift, impact["tau"]), (velocity * 5, impact["pre_impact_velocity"])]
            large = sum(abs(v) * 5 > 1e-6 for v in path.impact_velocities)
            if large != point["n_impacts_before_Tex_with_speed_gt_1e_6"]:
                raise AssertionError(f"Another number of impacts: {point['a']}")
            worst = max([worst, *(abs(a.mpf(own - a.number(text))) for own, text in pairs)])
    return {"papers, linear sine pulses": worst}


def compared_on(path, states, impacts, start):
    """Pairs of found and known numbers along a path: states, and impacts with their times since `start`."""
    for known, (x, v) in zip(states, path.states):
        yield from ((x, known["theta"]), (v, known["thetadot"]))
    for known, time, v in zip(impacts, path.impact_times, path.impact_velocities):
        yield from ((time - start, known["t"]), (v, known["pre_impact_thetadot"]))


def nonlinear(table):
    """Nonlinear sine and cosine pulses: verdicts, peaks, impacts, states."""
    a, worst = Arithmetic(40), mpf(0)
    for row in table["data"]:
        with a.context():
            rate, sine = a.number(row["omega_rad_s"]), row["pulse"] == "sine"
            amplitude = a.number(row["ap_over_g_tan_alpha"]) * a.tan(a.number(row["alpha"]))
            start = a.number(row["phase_rad"]) / rate if sine else 0
            block = Block(a, row["alpha"], row["p"], 1)
            keep = 1 - 3 * a.sin(block.alpha) ** 2 / 2 if row["restitution"] == "Housner" else row["restitution"]
            scene = (row["alpha"], row["p"], keep), row["pulse"], (amplitude, 2 * a.pi / rate)
            path = follow(scene, 1, [start + a.number(state["t"]) for state in row["states"]], a)
            # The table stops early: some blocks far beyond alpha are still falling.
            if path.overturned != (row["overturned"] or float(row["theta_max_rad"]) > 1):
                raise AssertionError(f"Another verdict: {row['alpha']} {row['pulse']}")
            pairs = []
            if not path.overturned:
                pairs.append((path.peak, row["theta_max_rad"]))
                same = [x["t"] for x in row["extrema"] if abs(abs(float(x["theta"])) - float(path.peak)) < 1e-12]
                # Without loss at impact the same peak comes again: the first one counts.
                if row["t_theta_max_s"] in same:
                    pairs.append((path.peak_time - start, same[0]))
            pairs += compared_on(path, row["states"], row["first_impacts"], start)
            worst = max([worst, *(abs(a.mpf(own - a.number(text))) for own, text in pairs)])
    return {"papers, nonlinear pulses": worst}


def ricker(table):
    """Ricker pulses without a tail cut off: peaks, impacts, states of the rigid block."""
    a, worst = Arithmetic(40), mpf(0)
    for row in table["data"]:
        with a.context():
            period, known = 2 * a.pi / a.number(row["omega_p_rad_s"]), row["models"]["RB"]
            center = 5 * period
            scene = (
                (row["alpha"], row["p"], row["restitution_value"]), "ricker symmetric",
                (a.number("3.6") * a.tan(a.number(row["alpha"])), period, center),
            )  # fmt: skip
            path = follow(scene, 1, [center + a.number(state["t"]) for state in known["states"]], a)
            pairs = [(path.peak, known["theta_max_rad"]), (path.peak_time - center, known["t_theta_max"])]
            pairs += compared_on(path, known["states"], known["impacts"], center)
            worst = max([worst, *(abs(a.mpf(own - a.number(text))) for own, text in pairs)])
    return {"papers, Ricker pulses": worst}


def main(papers=None):
    """Run all checks; print the worst difference of each."""
    mp.dps = 40
    checks = [against_stored, against_others, against_definitions, free_linear, sine_linear, energy]
    if papers:
        table = json.loads(open(papers).read())
        checks += [
            lambda: voyagaki(table["section1_voyagaki"]),
            lambda: intervals(table["section2_dimitrakopoulos_dejong"]),
            lambda: safe_points(table["section2_dimitrakopoulos_dejong"]),
            lambda: nonlinear(table["section3_nonlinear_housner"]),
            lambda: ricker(table["section4_ricker"]),
        ]
    for check in checks:
        for name, worst in check().items():
            print(f"{name}: {float(worst):.1e}", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
