"""What a user of diffrax writes: `diffeqsolve` with an `Event` from impact to impact, under `jit` and `vmap`.

One solve for each arc: the opening angle with the side frozen, the deflated event x/(t - start) (its limit, the
velocity, at the start), the turning point by a second event in the same solve: an arc ends there too. Signs are
compared at the ends of steps only, so steps are bounded.
"""

import functools
import math

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from references import peer_problems as problems

ARCS = 500  # solves of one scene at most
FEW = {"P4": 4, "P5": 16}  # scenes; else 200
NEGLIGIBLE = 1e-9  # speed over alpha below which a block rests


def ground(problem):
    """The ground acceleration u(t, amplitude, rate) in time p t, and the end of the motion."""
    if problem.motion == "sine":
        return lambda t, a, w: a * jnp.sin(w * t), lambda w: 2 * jnp.pi / w

    def pulse(t, amplitude, rate):
        x = t * rate / (2 * jnp.pi)
        shape = problems.SHAPE
        return amplitude * (1 - jnp.exp(2 * shape * jnp.minimum(x, 1 - x))) / (1 - math.exp(shape))

    return pulse, lambda w: 2 * jnp.pi / w


def uplift(problem, alpha, amplitude, rate, t):
    """The next uplift of a block at rest from time t on, and its side; infinite if there is none."""
    threshold = alpha if problem.model == "linear" else jnp.tan(alpha)
    if problem.motion == "sine":
        first = jnp.arcsin(threshold / amplitude) / rate
        second = first + jnp.pi / rate
        return jnp.where(t <= first, first, jnp.where(t <= second, second, jnp.inf)), jnp.where(t <= first, -1.0, 1.0)
    shape = problems.SHAPE
    x = jnp.log1p(-threshold / amplitude * (1 - math.exp(shape))) / (2 * shape)
    first = x * 2 * jnp.pi / rate
    return jnp.where(t <= first, first, jnp.inf), -1.0


def arc(problem, rtol, u, side, alpha, amplitude, rate, start, x, v, stop):
    """One solve from (start, x, v), to an impact, a turning point or `stop`."""
    linear = problem.model == "linear"

    def flow(t, y, args):
        force = side * u(t, amplitude, rate)
        angle = alpha - y[0]
        return jnp.stack([y[1], -(angle + force) if linear else -(jnp.sin(angle) + force * jnp.cos(angle))])

    def height(t, y, args, **kwargs):
        since = t - start
        return jnp.where(x > 0, y[0], jnp.where(since > 0, y[0] / jnp.where(since > 0, since, 1.0), v))

    def speed(t, y, args, **kwargs):
        return y[1]

    pull = -flow(start, jnp.stack([x, v]), None)[1]
    first = jnp.where((x <= 0) & (v > 0) & (pull > 0), v / (2 * jnp.maximum(pull, 1e-12)), 0.02)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(flow), diffrax.Tsit5(), start, stop, jnp.minimum(first, 0.5 * (stop - start)),
        jnp.stack([x, v]), saveat=diffrax.SaveAt(t1=True), max_steps=100_000, throw=False,
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=1e-3 * rtol, dtmax=0.2),
        event=diffrax.Event([height, speed], _newton(), direction=[False, False]),
    )  # fmt: skip
    return solution.ts[-1], solution.ys[-1], solution.event_mask


def _newton():
    import optimistix

    return optimistix.Newton(1e-13, 1e-13)


def free(problem, alpha, restitution, x, v):
    """After the motion: the largest angle still to come, infinite if it overturns."""
    linear = problem.model == "linear"
    distance = (lambda y: alpha - y) if linear else (lambda y: 2 * jnp.sin((alpha - y) / 2))
    missing, balanced = distance(x) ** 2 - v**2, distance(0.0) ** 2
    inward = (v < 0) & ((x < alpha) | (missing < 0))
    missing = jnp.where(inward, balanced - restitution**2 * (balanced - missing), missing)
    lost = (missing < 0) | ((x >= alpha) & ~inward)
    root = jnp.sqrt(jnp.maximum(missing, 0))
    return jnp.where(lost, jnp.inf, jnp.maximum(x, alpha - (root if linear else 2 * jnp.arcsin(root / 2))))


def scene(problem, rtol, alpha, restitution, amplitude, rate):
    """Peak over alpha of one scene."""
    u, end_of = ground(problem)
    end = end_of(rate)
    middle = end / 2
    escape = jnp.inf if problem.model == "linear" else jnp.minimum(alpha + jnp.arctan(amplitude), jnp.pi / 2)

    def going(state):
        t, x, v, side, peak, count = state
        return (t < end) & jnp.isfinite(peak) & (count < ARCS)

    def step(state):
        t, x, v, side, peak, count = state
        lift, new = uplift(problem, alpha, amplitude, rate, t)
        rest = side == 0
        t, side = jnp.where(rest, jnp.minimum(lift, end), t), jnp.where(rest, new, side)
        stop = jnp.where((t < middle) & (problem.motion != "sine"), middle, end)
        time, (angle, speed), (hit, turned) = arc(
            problem, rtol, u, side, alpha, amplitude, rate, t, x, v, jnp.maximum(stop, t + 1e-12)
        )
        late = rest & ~(lift < end)
        peak = jnp.where(turned & ~late, jnp.maximum(peak, angle), peak)
        speed = jnp.where(hit, -restitution * speed, jnp.where(turned, -1e-300, speed))
        held = jnp.abs(u(time, amplitude, rate)) < (alpha if problem.model == "linear" else jnp.tan(alpha))
        rests = (hit & held & (speed < NEGLIGIBLE * alpha)) | late
        lost = (angle > escape) & (speed > 0)
        lost = lost | ((problem.model == "linear") & (angle - alpha + speed > amplitude))
        side = jnp.where(rests, 0.0, jnp.where(hit, -side, side))
        angle, speed = jnp.where(hit | rests, 0.0, angle), jnp.where(rests, 0.0, speed)
        return jnp.where(late, end, time), angle, speed, side, jnp.where(lost, jnp.inf, peak), count + 1

    zero = jnp.zeros_like(alpha)
    t, x, v, side, peak, count = jax.lax.while_loop(going, step, (zero, zero, zero, zero, zero, 0))
    last = jnp.where(side == 0, 0.0, free(problem, alpha, restitution, x, v))
    return jnp.where(count < ARCS, jnp.maximum(peak, last) / alpha, jnp.nan)


@functools.cache
def compiled(model, motion, rtol):
    """The scenes of a kind of problem, compiled."""
    kind = problems.Problem("", "", model, motion, *[np.zeros(1)] * 5)
    return jax.jit(jax.vmap(functools.partial(scene, kind, rtol)))


SETTINGS = ((1e-6, 1e-8), (1e-10, 1e-12))


def ways(problem):
    """The ways to solve a problem under a pulse: (goal of the error, label, function of the chosen scenes)."""
    if problem.motion == "record":
        return []

    def solve(rtol, chosen):
        alpha, _, *rest = problem.columns(chosen)
        run, devices = compiled(problem.model, problem.motion, rtol), jax.devices()
        # A part for every device; they run at the same time.
        parts = [[c[k :: len(devices)] for c in (alpha, *rest)] for k in range(len(devices))]
        found = [run(*jax.device_put(part, device)) for part, device in zip(parts, devices)]
        peaks = np.empty(alpha.size)
        for k, part in enumerate(found):
            peaks[k :: len(devices)] = part
        return peaks

    return [(goal, f"rtol {rtol:g}", functools.partial(solve, rtol)) for goal, rtol in SETTINGS]
