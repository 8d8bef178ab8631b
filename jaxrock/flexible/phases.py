"""The two linear phases of a flexible block, locked and rocking, solved by their modes.

Modal coordinates q of the clamped column, with u = L (shapes @ q), and the base rotation theta obey

    q'' + (a0 + d) q' + k q = rotation (k theta + d theta') - translation cos(alpha) a_g/L,   k = frequencies^2
    locked:  theta = 0 while |moment| <= strength,  moment = sum of rotation (k q + d q')
    rocking: sum of rotation (k w + d w') = strength side - spring_rate theta,  w = q - rotation theta

in units of m L^2. While the base rocks this is linear in (q, q', theta), about the unstable equilibrium at theta =
balance side. Its rates are the zeros of one function; left and right vectors follow from them in closed form.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Inexact

from jaxrock._core.types import Scalar
from jaxrock.blocks.cantilever import unit_column
from jaxrock.blocks.flexible import FlexibleBlock
from jaxrock.numerics.derivatives_of import with_derivatives_of
from jaxrock.numerics.exponential_sums import Curve, powers
from jaxrock.numerics.roots import implicit


class _Damping(NamedTuple):
    """Damping ratios at which the computation changes."""

    felt: float  # below it the base follows the column at once
    least: float  # the least in computations
    easy: float  # from this on eigenvalues need no continuation


_IN_DOUBLE, _IN_SINGLE = _Damping(1e-9, 1e-13, 1e-8), _Damping(1e-5, 1e-6, 1e-5)  # found by trial: rounding decides
_TERMS = 21  # of the Taylor series of modes that hardly turn within a step
_FACTORIALS = np.array([float(math.factorial(k)) for k in range(_TERMS)])


def _limits(dtype) -> _Damping:
    return _IN_DOUBLE if jnp.finfo(dtype).eps < 1e-10 else _IN_SINGLE


class Numbers(eqx.Module):
    """The constants of a block in the equations, in units of m L^2 and seconds."""

    squares: Inexact[Array, " modes"]
    damping: Inexact[Array, " modes"]
    damping_at_rest: Inexact[Array, " modes"]  # in the moment at a locked base; differs where weight couples modes
    mass_damping: Scalar
    rotation: Inexact[Array, " modes"]
    load: Inexact[Array, " modes"]  # translation cos(alpha) g/L: per ground acceleration in g
    tip: Inexact[Array, " modes"]
    strength: Scalar
    spring_rate: Scalar
    balance: Scalar  # rotation of the unstable equilibrium [rad]
    alpha: Scalar
    damped: Bool[Array, ""]
    lean: Scalar  # displacement of the top with a unit rotation, over L, less 1
    center: Inexact[Array, " states"]  # (q, q', theta) of the unstable equilibrium
    offsets: Inexact[Array, " outputs"]  # outputs at the unstable equilibrium

    @classmethod
    def of(cls, block: FlexibleBlock) -> "Numbers":
        """Reduce a block of scalars."""
        column = unit_column(block.masses)
        dtype = jnp.result_type(block.width, block.youngs_modulus)
        limits = _limits(dtype)
        # An undamped column is the limit of damped ones, with the same derivative by the damping.
        ratio = with_derivatives_of(jnp.maximum(block.damping_ratio, limits.least), block.damping_ratio)
        damped = block.damping_ratio >= limits.felt
        block = eqx.tree_at(lambda b: b.damping_ratio, block, ratio)
        mass_damping, damping = block.damping_rates
        squares = block.frequencies**2
        # At critical damping two rates coincide and the modes do not span the motion: keep clear of it.
        decay = mass_damping + damping
        critical = jnp.abs(decay**2 - 4 * squares) < 1e-11 * squares
        damping = jnp.where(critical, damping * (1 + 1e-10), damping)
        rotation = jnp.asarray(column.rotation, dtype)
        return cls(
            squares=squares,
            damping=damping,
            damping_at_rest=damping,
            mass_damping=mass_damping,
            rotation=rotation,
            load=jnp.asarray(column.translation, dtype) * jnp.cos(block.alpha) * block.gravity / block.length,
            tip=jnp.asarray(column.tip, dtype),
            strength=block.strength,
            spring_rate=block.spring_rate,
            balance=block.balance,
            alpha=block.alpha,
            damped=damped,
            lean=jnp.zeros((), dtype),
            center=block.balance * jnp.concatenate([rotation, 0 * rotation, jnp.ones(1, dtype)]),
            offsets=block.balance * jnp.array([1.0, 1.0, 0.0, 0.0], dtype),
        )

    def moment(self, state: Inexact[Array, " states"]) -> Scalar:
        """Return the moment of the column on a locked base, over m L^2."""
        q, v = jnp.split(state[:-1], 2)
        return jnp.sum(self.rotation * (self.squares * q + self.damping_at_rest * v))


class Phase(eqx.Module):
    """A linear phase: state = center + Re(modes @ c), c' = rates c + drive a_g, c = project @ (state - center).

    The modes are in the order of their frequencies, so that sums of the first of them are slow. `outputs`: rotation;
    displacement of the top over L, its bending part; base moment over m L^2.
    """

    rates: Complex[Array, " modes"]
    modes: Complex[Array, "states modes"]
    project: Complex[Array, "modes states"]
    drive: Complex[Array, " modes"]
    outputs: Complex[Array, "outputs modes"]

    def in_order(self) -> "Phase":
        """Sort the modes by their frequencies."""
        order = jnp.argsort(jnp.abs(jax.lax.stop_gradient(self.rates.imag)))
        return Phase(
            self.rates[order], self.modes[:, order], self.project[order], self.drive[order], self.outputs[:, order]
        )

    @classmethod
    def where(cls, condition, one: "Phase", other: "Phase") -> "Phase":
        """Select `one` where the condition holds, else `other`."""
        return jax.tree.map(lambda a, b: jnp.where(condition, a, b), one, other)


def locked_phase(numbers: Numbers) -> Phase:
    """Compute the clamped modes, with one more rate for the shape of the rocking phase."""
    n = numbers.squares.size
    decay = numbers.mass_damping + numbers.damping
    root = jnp.sqrt((decay**2 / 4 - numbers.squares).astype(jnp.result_type(decay, 1j)))
    # The slower of two real rates comes from the product: no cancellation.
    fast = -decay / 2 - root
    rates = jnp.stack([numbers.squares / fast, fast])
    spread = 2 * rates + decay
    eye = jnp.eye(n)
    zero = jnp.zeros((n, 1))
    modes = jnp.block([[eye + 0j, eye + 0j, zero], [jnp.diag(rates[0]), jnp.diag(rates[1]), zero]])
    modes = jnp.concatenate([modes, jnp.zeros((1, 2 * n + 1))])
    project = jnp.concatenate(
        [jnp.concatenate([jnp.diag((r + decay) / s), jnp.diag(1 / s), zero], axis=1) for r, s in zip(rates, spread)]
        + [jnp.zeros((1, 2 * n + 1))]
    )

    def both(first, second):
        return jnp.concatenate([first, second, jnp.zeros(1)]) + 0j

    moment = numbers.rotation * (numbers.squares + numbers.damping_at_rest * rates)
    top = both(numbers.tip, numbers.tip)
    return Phase(
        rates=jnp.concatenate([rates.ravel(), -jnp.ones(1)]),
        modes=modes,
        project=project,
        drive=both(*(-numbers.load / spread)),
        outputs=jnp.stack([0 * top, top, top, both(*moment)]),
    ).in_order()


def rocking_phase(numbers: Numbers) -> tuple[Phase, Bool[Array, ""]]:
    """Compute the modes of column and turning base; and whether all of them were found."""
    rates = _rocking_rates(numbers)
    square, decay = numbers.squares, numbers.mass_damping
    at = rates[:, None]
    stiffness = square + numbers.damping * at  # k + d rate
    inertia = at * (at + decay)
    denominator = inertia + stiffness
    _, slope = _characteristic(numbers, rates)
    slope = slope[:, None]
    shape = numbers.rotation * stiffness / denominator
    ones = jnp.ones_like(at)
    modes = jnp.concatenate([shape, at * shape, ones], axis=1).T
    of_rotation = jnp.sum(numbers.rotation**2 * numbers.damping * inertia / denominator, 1, keepdims=True)
    project = (
        jnp.concatenate([numbers.rotation * square * (at + decay) / denominator, shape, of_rotation], axis=1) / slope
    )
    whole = jnp.abs(project @ modes - jnp.eye(rates.size)).max() < 1e-4  # the correction below squares the error
    # Without damping the base has no motion of its own: it follows the column.
    relaxing = (rates.imag == 0) & (rates.real == jnp.min(rates.real))
    dropped = relaxing & ~numbers.damped
    project = jnp.where(dropped[:, None], 0.0, project)
    # Strong damping in proportion to stiffness crowds rates together: correct the inverse of the modes once.
    project = 2 * project - (project @ modes) @ project
    bending = numbers.lean - jnp.sum(numbers.tip * numbers.rotation * inertia / denominator, 1)
    phase = Phase(
        rates=jnp.where(dropped, -1.0, rates),
        modes=modes,
        project=project,
        drive=-jnp.sum(project[:, rates.size // 2 : -1] * numbers.load, 1),
        outputs=jnp.stack([ones[:, 0], shape @ numbers.tip, bending, -numbers.spring_rate * ones[:, 0]]),
    )
    return phase.in_order(), whole


def _characteristic(numbers: Numbers, rates) -> tuple:
    """Return the function whose zeros are the rates, and its derivative.

    sum of rotation^2 (k + d s) s (s + a0)/(s (s + a0) + k + d s) - spring_rate: its poles are the clamped column's.
    """
    s = rates[:, None]
    stiffness, inertia = numbers.squares + numbers.damping * s, s * (s + numbers.mass_damping)
    denominator = inertia + stiffness
    weights = numbers.rotation**2
    # This form, a sum of weights over 1/stiffness + 1/inertia, has no cancellation.
    value = jnp.sum(weights * stiffness * inertia / denominator, 1) - numbers.spring_rate
    slope = weights * (numbers.damping * inertia**2 + (2 * s + numbers.mass_damping) * stiffness**2) / denominator**2
    return value, jnp.sum(slope, 1)


def _rocking_rates(numbers: Numbers) -> Complex[Array, " rates"]:
    """Find the zeros of the characteristic function: eigenvalues, polished by Newton's method, which carries
    derivatives."""
    held = jax.lax.stop_gradient(numbers)
    limits = _limits(held.squares.dtype)
    # The matrix of (q, q', theta) is singular without damping: start from a little, and continue the rates from there.
    easier = jnp.maximum(limits.easy / jnp.maximum(_ratio(held), limits.least), 1.0)
    damping, n = held.damping * easier, held.squares.size
    looseness = jnp.sum(held.rotation**2 * damping)
    stiffness = jnp.sum(held.rotation**2 * held.squares) - held.spring_rate
    push = held.rotation * held.squares
    turning = jnp.concatenate([push, held.rotation * damping, -stiffness[None]]) / looseness
    eye = jnp.eye(n)
    coupling = jnp.concatenate(
        [-jnp.diag(held.squares), -jnp.diag(damping + held.mass_damping), push[:, None]], axis=1
    ) + jnp.outer(held.rotation * damping, turning)
    matrix = jnp.concatenate(
        [jnp.concatenate([jnp.zeros((n, n)), eye, jnp.zeros((n, 1))], axis=1), coupling, turning[None]]
    )
    rates = jnp.linalg.eigvals(matrix)
    relaxing = (easier > 1) & (rates.real == jnp.min(rates.real))
    rates = jnp.where(relaxing, -stiffness / jnp.sum(held.rotation**2 * held.damping), rates)

    rates = jax.lax.fori_loop(0, 6, lambda _, rates: rates - _to_rates(held, rates), rates)
    return implicit(_to_rates, rates, numbers)


def _to_rates(numbers: Numbers, rates: Complex[Array, " rates"]) -> Complex[Array, " rates"]:
    value, slope = _characteristic(numbers, rates)
    return value / slope


def _ratio(numbers: Numbers) -> Scalar:
    """Return the damping ratio of the first clamped mode by the column's own damping."""
    return numbers.damping[0] / (2 * jnp.sqrt(numbers.squares[0]))


class Arc(eqx.Module):
    """The motion from a state on, within a step in which the ground acceleration is a polynomial of x on [0, 1]."""

    phase: Phase
    center: Inexact[Array, " states"]
    offsets: Inexact[Array, " outputs"]
    amplitudes: Complex[Array, " modes"]
    exponents: Complex[Array, " modes"]  # rates times the step
    coefficients: Complex[Array, "terms modes"]
    errors: Inexact[Array, " modes"]  # rounding errors of the modes at the start

    def state(self, x: Scalar) -> Inexact[Array, " states"]:
        """Return (q, q', theta) at x."""
        return self.center + (self.phase.modes @ self.mode_amplitudes(x)).real

    def outputs(self, x: Scalar) -> Inexact[Array, " outputs"]:
        """Return rotation, top displacement over L, its bending part, base moment over m L^2, at x."""
        return self.offsets + (self.phase.outputs @ self.mode_amplitudes(x)).real

    def mode_amplitudes(self, x: Scalar) -> Complex[Array, " modes"]:
        """Return the amplitudes of the modes at x."""
        return self.amplitudes * jnp.exp(self.exponents * x) + powers(x, len(self.coefficients)) @ self.coefficients

    def curves(self) -> Curve:
        """Return the outputs as curves (one axis more)."""
        rows = self.phase.outputs
        coefficients = (rows @ self.coefficients.T).real.at[:, 0].add(self.offsets)
        exponents = jnp.broadcast_to(self.exponents, rows.shape)
        return Curve(rows * self.amplitudes, exponents, coefficients, jnp.abs(rows) * self.errors)


def arc(numbers: Numbers, phase: Phase, side: Scalar, state, load: Inexact[Array, " order"], length: Scalar) -> Arc:
    """Compute the arc from `state` on one side (0: locked) under a_g = sum of load[k] x^k, x = time/length."""
    center, offsets = side * numbers.center, side * numbers.offsets
    start = phase.project @ (state - center)
    exponents = phase.rates * length
    slow = jnp.abs(exponents) < 1
    series = _series(jnp.where(slow, exponents, 0.0), start, phase.drive * length, load)
    follows = _follows(jnp.where(slow, 1.0, exponents), phase.drive * length, load)
    amplitudes = jnp.where(slow, 0.0, start - follows[0])
    errors = 8 * jnp.finfo(center.dtype).eps * (jnp.abs(phase.project) @ (jnp.abs(state) + jnp.abs(center)))
    return Arc(phase, center, offsets, amplitudes, exponents, jnp.where(slow, series, follows), errors)


def answers(exponents: Complex[Array, " modes"], count: int) -> Complex[Array, "count terms modes"]:
    """Return the response of modes that start at zero to x^0, x^1, ...

    It is a Taylor series for modes that hardly turn, and the polynomial solution for others.
    """
    slow = jnp.abs(exponents) < 1
    series, follows = jnp.where(slow, exponents, 0.0), jnp.where(slow, 1.0, exponents)

    def answer(load):
        return jnp.where(slow, _series(series, 0.0, 1.0, load), _follows(follows, 1.0, load))

    return jax.vmap(answer)(jnp.eye(count))


def rising_terms(exponents: Complex[Array, " modes"]) -> Complex[Array, "terms modes"]:
    """Return the series of e^(exponent x), for modes that hardly turn."""
    return powers(jnp.where(jnp.abs(exponents) < 1, exponents, 0.0), _TERMS) / _FACTORIALS[:, None]


def _series(exponents, start, drive, load) -> Complex[Array, "terms modes"]:
    """Return Taylor coefficients of c' = exponent c + drive load(x), for modes that hardly turn within the step."""
    rising = powers(exponents, _TERMS)
    derivatives = _FACTORIALS[: load.size] * load
    # Coefficient k + 1 of the answer, times its factorial: sum over j of load's derivative j times exponent^(k - j).
    lag = np.subtract.outer(np.arange(_TERMS - 1), np.arange(_TERMS - 1))
    known = (lag >= 0) & (lag < load.size)
    answer = jnp.where(known, derivatives[np.where(known, lag, 0)], 0.0) @ rising[:-1]
    answer = jnp.concatenate([jnp.zeros_like(rising[:1]), answer])
    return (rising * start + answer * drive) / _FACTORIALS[:, None]


def _follows(exponents, drive, load) -> Complex[Array, "terms modes"]:
    """Return the polynomial that solves c' = exponent c + drive load(x), for modes that turn."""
    derivatives = _FACTORIALS[: load.size] * load
    order = np.add.outer(np.arange(_TERMS), np.arange(load.size))
    known = order < load.size
    answer = jnp.where(known, derivatives[np.where(known, order, 0)], 0.0) @ powers(1 / exponents, load.size)
    return -answer * drive / exponents / _FACTORIALS[:, None]
