"""Ends of overturning intervals in intensity: where the 40-digit verdict changes, and how that point moves.

Writes `critical.json`. jaxrock's series engine scans the amplitudes finely in float64, and more finely where its
margin comes near zero or jumps or where its impact count changes; from there on the 40-digit Taylor reference alone
decides: every stretch between two unlike verdicts is searched for all changes between them (so a gap between two
overturning intervals is found however narrow it is), and each change is bisected to 1e-26 of the amplitude. The
derivatives of an amplitude are Richardson extrapolations of central differences of bisected amplitudes.

    python -m references.critical          # goes on where an earlier run stopped
"""

import json
import math
import pathlib
import time

import numpy as np

from references.arithmetic import Arithmetic
from references.motions import motion
from references.taylor import Block, respond

ANSWERS = pathlib.Path(__file__).with_suffix(".json")
BLOCKS = (
    (0.2, 2.0, 0.9),
    (0.3, 2.0, 1 - 1.5 * math.sin(0.3) ** 2),
    (0.15, 2.0, 0.85),
)
MOTIONS = (
    ("sine", ()),
    ("exponential", (-5.0,)),
    ("exponential", (0.0,)),
    ("exponential", (2.0,)),
    ("half sine", ()),
)
RATIOS = (0.4, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
SLOW = (0.3, 0.25)  # more ratios, for the sine: the gap below overturning without impact is 1e-8 and less
LOWEST, HIGHEST = 1.001, 12.0
POINTS = 2**18  # of the first scan
FINER, ROUNDS, MOST = 256, 4, 1200  # points into which a suspicious stretch is divided, how often, how many stretches
EXACT = -26  # log10 of the relative width of the last bracket
STEP = -8  # log10 of the relative step of derivatives
PARAMETERS = ("alpha", "p", "restitution", "length")

ABOUT = (
    "Ends of overturning intervals by references/critical.py: nonlinear block under one pulse, amplitudes "
    "between 1.001 and 12 tan(alpha). `block`: alpha, p, restitution; `length`: period of the sine, duration of the "
    "others [s], 2 pi/(frequency_ratio p); all float64 taken as exact. Each of `ends`: `amplitude` [g], bisected in "
    "40 digits to 1e-26; `kind`: below (safe below, lost above) or above (lost below, safe above); `impacts` of the "
    "overturned side (with that after the motion if it overturns from there); `safe_peak`: greatest rotation over "
    "alpha on the safe side, `grazing` and `dip` as in references/responses.py there (None: none; near 0: the verdict "
    "changes because an impact appears, not at the balance); `gradient`: of the amplitude with respect to alpha, p, "
    "restitution, length, `disagreement`: worst relative difference of the differences with steps 1e-8 and 2e-8 (below "
    "ratio 0.4 only for the last four ends). "
    "`changes`: amplitudes at which lost neighbours differ in impacts without a safe gap of 1e-26 between them."
)


# ---- Float64: where to look ----


def scanner(kind, shape):
    """A function of (block, length, amplitudes) that gives jaxrock's verdicts, impact counts, margins, trust."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jaxrock as rk

    pulse = {
        "sine": rk.SinePulse,
        "half sine": rk.HalfSinePulse,
        "exponential": lambda amplitude, duration: rk.ExponentialPulse(amplitude, duration, *shape),
    }[kind]

    def scan(block, length, amplitudes):
        alpha, p, restitution = block
        ratio = 2 * math.pi / length / p
        parts = []
        for first in range(0, len(amplitudes), POINTS):
            chosen = amplitudes[first : first + POINTS] / math.tan(alpha)
            found = rk.overturning_map(
                [ratio], chosen, alpha=alpha, restitution=restitution, pulse=pulse, progress=False
            )
            columns = (found.state, found.impact_count, found.margin)
            parts.append([np.asarray(column).ravel() for column in columns])
        state, impacts, margin = (np.concatenate(column) for column in zip(*parts))
        return np.where(state > 0, impacts, -1), margin, state >= 0

    return scan


def scanned(scan, block, length):
    """Amplitudes and labels (impacts of the overturned, -1: safe), finer where something happens."""
    threshold = math.tan(block[0])
    amplitudes = threshold * np.exp(np.linspace(math.log(LOWEST), math.log(HIGHEST), POINTS))
    label, margin, sure = scan(block, length, amplitudes)
    for _ in range(ROUNDS):
        near = np.abs(margin)
        inner = np.flatnonzero(
            (near[1:-1] <= near[:-2]) & (near[1:-1] <= near[2:]) & (near[1:-1] < 0.5)
            & (label[1:-1] == label[:-2]) & (label[1:-1] == label[2:])
        )  # fmt: skip
        jumps = np.flatnonzero((np.abs(np.diff(margin)) > 0.03) & (label[1:] == label[:-1]))
        odd = np.flatnonzero(~sure)
        stretches = np.unique(np.concatenate([inner, inner + 1, jumps, odd, odd - 1]))
        stretches = stretches[(stretches >= 0) & (stretches < len(amplitudes) - 1)]
        wide = amplitudes[stretches + 1] / amplitudes[stretches] - 1 > 1e-13
        stretches = stretches[wide]
        if len(stretches) > MOST:  # those nearest to the balance
            score = np.minimum(near[stretches], near[stretches + 1])
            stretches = np.sort(stretches[np.argsort(score)[:MOST]])
        if not len(stretches):
            break
        grid = np.linspace(0, 1, FINER + 1)[1:-1]
        low, high = amplitudes[stretches], amplitudes[stretches + 1]
        fresh = np.unique((low[:, None] + grid * (high - low)[:, None]).ravel())
        more = scan(block, length, fresh)
        amplitudes = np.concatenate([amplitudes, fresh])
        order = np.argsort(amplitudes, kind="stable")
        amplitudes = amplitudes[order]
        label, margin, sure = (np.concatenate(pair)[order] for pair in zip((label, margin, sure), more))
    return amplitudes[sure], label[sure]


# ---- 40 digits ----


class Scene:
    """A block under a pulse of any amplitude; its parameters may be changed."""

    def __init__(self, arithmetic, block, kind, shape, length):
        self.a, self.kind, self.shape = arithmetic, kind, shape
        self.parameters = [arithmetic.number(x) for x in (*block, length)]
        self.runs = 0

    def path(self, amplitude, parameters=None):
        """The response."""
        self.runs += 1
        *block, length = parameters or self.parameters
        return respond(Block(self.a, *block), motion(self.a, self.kind, (amplitude, length, *self.shape)))

    def label(self, amplitude, parameters=None):
        """Impacts of the overturned, -1 if safe."""
        path = self.path(amplitude, parameters)
        return path.impacts if path.overturned else -1

    def bisect(self, low, high, inside, parameters=None, exact=EXACT):
        """The bracket of a change of `inside(label)`, which holds at `low` and not at `high`."""
        close = self.a.power_of_ten(exact) * abs(high)
        while abs(high - low) > close:
            middle = (low + high) / 2
            if inside(self.label(middle, parameters)):
                low = middle
            else:
                high = middle
        return low, high

    def changes(self, low, high):
        """All changes that a bisection between two amplitudes meets: (below, above, label below, label above)."""
        found, start, end = [], self.label(low), self.label(high)
        while start != end:
            below, above = self.bisect(low, high, lambda label: label == start)  # noqa: B023
            after = self.label(above)
            found.append((below, above, start, after))
            low, start = above, after
        return found

    def gradient(self, amplitude, label):
        """Derivatives of an end's amplitude and the worst disagreement of two steps.

        The end moves; what is followed is the change of "overturns with this number of impacts".
        """
        a, h, rows, worst = self.a, self.a.power_of_ten(STEP), [], 0.0
        rises = self.label(amplitude * (1 + a.power_of_ten(EXACT + 2))) == label
        for j, x in enumerate(self.parameters):
            size, at = h * abs(x), {0: amplitude}
            # Where the end is expected from those already found, as sums of them, and how far off it may be.
            for k, weights, room in (
                (1, {0: 1}, 3),
                (-1, {0: 2, 1: -1}, 1e-6),
                (2, {1: 3, 0: -3, -1: 1}, 1e-12),
                (-2, {-1: 3, 0: -3, 1: 1}, 1e-12),
            ):
                changed = [y + k * size * (i == j) for i, y in enumerate(self.parameters)]
                guess = sum(weight * at[n] for n, weight in weights.items())
                at[k] = self._moved(guess, h * a.number(room) * amplitude, label, rises, changed)
            near, far = ((at[k] - at[-k]) / (2 * k * size) for k in (1, 2))
            rows.append((4 * near - far) / 3)
            scale = max(abs(rows[-1]), amplitude / abs(x) / 1000)
            worst = max(worst, float(abs(near - far) / scale))
        return rows, worst

    def _moved(self, guess, room, label, rises, parameters):
        """The end near a guess with other parameters."""
        low = high = None
        while low is None or high is None:
            if room > abs(guess) / 100:
                raise ArithmeticError("The end was lost from sight.")
            for point in (guess - room, guess + room):
                if (self.label(point, parameters) == label) == rises:
                    high = point if high is None else min(high, point)
                else:
                    low = point if low is None else max(low, point)
            room = room * 8
        below, above = self.bisect(low, high, lambda it: (it == label) != rises, parameters, EXACT - 2)
        return (below + above) / 2


def ends_of(scene, amplitudes, labels, say):
    """Ends and other changes between the points of a scan."""
    a, ends, others, wrong = scene.a, [], [], 0
    for i in np.flatnonzero(labels[1:] != labels[:-1]):
        low, high = a.number(float(amplitudes[i])), a.number(float(amplitudes[i + 1]))
        for below, above, before, after in scene.changes(low, high):
            middle = (below + above) / 2
            if before >= 0 and after >= 0:
                others.append({"amplitude": a.text(middle, 22), "impacts": [before, after]})
                continue
            safe = scene.path(below if before < 0 else above)
            ends.append(
                {
                    "amplitude": a.text(middle, 26),
                    "intensity": float(middle / a.tan(scene.parameters[0])),
                    "kind": "below" if before < 0 else "above",
                    "impacts": max(before, after),
                    "safe_peak": float(safe.peak / scene.parameters[0]),
                    "grazing": float(safe.grazing) if safe.grazing < math.inf else None,
                    "dip": float(safe.dip / scene.parameters[0]) if safe.dip < math.inf else None,
                }
            )
        wrong += scene.label(low) != labels[i]
        wrong += scene.label(high) != labels[i + 1]
    if wrong:
        say(f"    {wrong} float64 labels beside a change differ from the 40-digit ones")
    return ends, others, wrong


def add_gradients(a, scenes, say, write):
    """Derivatives of the ends that have none."""
    for known in scenes:
        last = 4 if known["frequency_ratio"] in SLOW else len(known["ends"])
        missing = [end for end in known["ends"][-last:] if "gradient" not in end]
        with a.context():
            scene = Scene(a, known["block"], known["kind"], known["shape"], known["length"])
            for end in missing:
                try:
                    rows, worst = scene.gradient(a.number(end["amplitude"]), end["impacts"])
                except ArithmeticError as error:
                    end |= {"gradient": None, "disagreement": str(error)}
                    continue
                end |= {"gradient": [a.text(row, 16) if row else "0" for row in rows], "disagreement": worst}
        if missing:
            say(f"{known['kind']} {known['block']} {known['frequency_ratio']}: {len(missing)} gradients")
            write()


def main():
    """Compute what is missing."""
    stored = json.loads(ANSWERS.read_text()) if ANSWERS.exists() else {"scenes": []}
    scenes, a, begin = stored["scenes"], Arithmetic(40), time.time()
    done = {(tuple(s["block"]), s["kind"], tuple(s["shape"]), s["frequency_ratio"]) for s in scenes}

    def say(words):
        print(f"{time.time() - begin:6.0f} s  {words}", flush=True)

    def write():
        lines = ",\n".join(json.dumps(scene) for scene in scenes)
        fresh = ANSWERS.with_suffix(".part")
        fresh.write_text(json.dumps({"about": ABOUT})[:-1] + ', "scenes": [\n' + lines + "\n]}\n")
        fresh.replace(ANSWERS)

    for kind, shape in MOTIONS:
        scan = scanner(kind, shape)
        for block in BLOCKS:
            for ratio in RATIOS + (SLOW if kind == "sine" else ()):
                if (block, kind, shape, ratio) in done:
                    continue
                length = 2 * math.pi / ratio / block[1]
                amplitudes, labels = scanned(scan, block, length)
                with a.context():
                    scene = Scene(a, block, kind, shape, length)
                    ends, others, wrong = ends_of(scene, amplitudes, labels, say)
                scenes.append(
                    {
                        "block": list(block),
                        "kind": kind,
                        "shape": list(shape),
                        "frequency_ratio": ratio,
                        "length": length,
                        "scanned": len(amplitudes),
                        "float64_wrong": int(wrong),
                        "ends": ends,
                        "changes": others,
                    }
                )
                words = " ".join(f"{end['intensity']:.9f}{end['kind'][0]}{end['impacts']}" for end in ends)
                say(f"{kind} {shape} {block} {ratio}: {len(amplitudes)} points, {len(others)} other changes; {words}")
                write()
    add_gradients(a, scenes, say, write)


if __name__ == "__main__":
    main()
