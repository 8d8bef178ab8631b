"""The motion of a nonlinear column: the linear phase about its balance, and a polynomial of the remainder.

The linear phase consists of the tangents at the unstable equilibrium. It is exact near there, and has the frequency and
decay of every mode. The remainder, the part of the equations beside it, is small or slow.

It is evaluated at Chebyshev points of a step and becomes a polynomial. The response of the modes to that is exact; a
fixed-point iteration repeats both. So steps are as long as the polynomial is accurate, however stiff the column is.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact

from jaxrock._core.types import Scalar
from jaxrock.flexible.column import ColumnConstants
from jaxrock.flexible.phases import Arc, Numbers, answers, rising_terms
from jaxrock.numerics.exponential_sums import Curve, powers

States = Inexact[Array, "points states"]

POINTS = 11
_ROUNDS = 8  # fixed-point iterations of remainder and response
_PLACES = (1 - np.cos(np.pi * np.arange(POINTS) / (POINTS - 1))) / 2


def _tables() -> tuple[np.ndarray, np.ndarray]:
    """Compute the matrices from values at the points to Chebyshev coefficients, and to those of powers."""
    k = np.arange(POINTS)
    weight = np.where((k == 0) | (k == POINTS - 1), 0.5, 1.0)
    waves = np.cos(np.pi * np.outer(k, (POINTS - 1) - k) / (POINTS - 1))
    spectrum = 2 / (POINTS - 1) * weight[:, None] * waves * weight
    # T_k(2 x - 1) in powers of x has integer coefficients.
    shapes = [np.polynomial.Polynomial([1.0]), np.polynomial.Polynomial([-1.0, 2.0])]
    for _ in range(POINTS - 2):
        shapes.append(2 * shapes[1] * shapes[-1] - shapes[-2])
    to_powers = np.stack([np.pad(s.coef, (0, POINTS - s.coef.size)) for s in shapes], 1)
    return spectrum, np.asarray(to_powers, float) @ spectrum


_SPECTRUM, _POWERS = _tables()
_SLOPE = np.diag(np.arange(1.0, POINTS), 1)  # maps coefficients to those of the derivative


class Tangents(eqx.Module):
    """The linear column about its unstable equilibrium, in modes that its weight does not couple."""

    column: ColumnConstants
    numbers: Numbers
    turn: Inexact[Array, "modes modes"]  # columns: these modes in terms of the clamped modes
    pull: Inexact[Array, "modes modes"]  # stiffness of the weight in these modes
    force: Inexact[Array, " modes"]  # force of the weight on clamped modes, in balance
    moment: Scalar  # moment of the spring, in balance
    slope: Scalar  # slope of that moment, in balance

    @classmethod
    def of(cls, column: ColumnConstants) -> "Tangents":
        """Linearise a column."""
        numbers, n = column.numbers, column.numbers.rotation.size
        one, none = jnp.ones(()), jnp.zeros(n)
        q, rotation = column.saddle()
        moment, slope = jax.jvp(lambda x: column.spring(x, one), (rotation,), (one,))
        force, eye = jnp.zeros(n), jnp.eye(n)
        if not column.p_delta:
            return cls(column, numbers, eye, 0 * eye, force, moment, slope)
        force = column.remaining_force(q, none, none, 0 * rotation)
        pull = jax.jacfwd(lambda q: column.remaining_force(q, none, none, 0 * rotation))(q)
        pull = (pull + pull.T) / 2
        squares, turn = jnp.linalg.eigh(jnp.diag(numbers.squares) - pull)
        turn = turn * jnp.where(jnp.diag(turn) < 0, -1, 1)
        lever = (numbers.squares * numbers.rotation) @ turn / squares
        tip = numbers.tip @ turn
        place = q @ turn
        offsets = jnp.stack([rotation, tip @ place, tip @ place - rotation, 0 * rotation])
        about = Numbers(
            squares=squares,
            damping=numbers.damping @ turn**2,
            damping_at_rest=(numbers.rotation * numbers.damping) @ turn / lever,
            mass_damping=numbers.mass_damping,
            rotation=lever,
            load=numbers.load @ turn,
            tip=tip,
            strength=numbers.strength,
            spring_rate=(turn @ lever) @ pull @ numbers.rotation - slope,
            balance=rotation,
            alpha=numbers.alpha,
            damped=numbers.damped,
            lean=tip @ lever - 1,
            center=jnp.concatenate([place, none, rotation[None]]),
            offsets=offsets,
        )
        return cls(column, about, turn, turn.T @ pull @ turn, force, moment, slope)

    def remainder(self, state, rate, ground: Scalar, side: Scalar) -> "Remainder":
        """Return the remainder at a state (q, q', theta) and its rate of change."""
        column, about, n = self.column, self.numbers, self.numbers.rotation.size
        q, v, rotation = state[:n], state[n:-1], state[-1]
        amplitudes, speeds, rates = (self.turn @ x for x in (q, v, rate[n:-1]))
        force = (column.remaining_force(amplitudes, speeds, rates, ground) - side * self.force) @ self.turn
        force = force - self.pull @ (q - side * about.center[:n])
        away = rotation - side * about.center[-1]
        moment = column.spring(rotation, side) - side * self.moment - self.slope * away
        lost = jnp.zeros(())
        if column.p_delta:
            # Damping couples the modes of the column under its weight a little.
            own = column.numbers.damping * (self.turn @ v - column.numbers.rotation * rate[-1])
            shared = about.damping * (v - about.rotation * rate[-1])
            force, lost = force + shared - own @ self.turn, about.rotation @ shared - column.numbers.rotation @ own
        displaced = column.displacements(self.turn @ q)[-1]
        straight = jnp.sum(about.tip * q)
        bending = (displaced - column.sine(rotation)) - (straight - rotation)
        return Remainder(force, moment + lost, displaced - straight, bending)


class Remainder(NamedTuple):
    """The part of the equations beside the linear phase: forces on modes, moment at the base; and its part of the
    outputs."""

    force: Inexact[Array, "*points modes"]
    moment: Inexact[Array, "*points"]
    displacement: Inexact[Array, "*points"]
    bending: Inexact[Array, "*points"]


class NonlinearArc(Arc):
    """The motion from a state on, with the remainder."""

    shift: Inexact[Array, " terms"]  # of the rotation, by powers of x
    remainder: Inexact[Array, "outputs terms"]  # of the outputs, by powers of x
    doubts: Inexact[Array, " outputs"]  # errors of these polynomials
    error: Scalar  # error of the whole step [rad]

    def mode_amplitudes(self, x: Scalar) -> Inexact[Array, " modes"]:
        """Return the amplitudes of the modes at x, with their share of the shift of the rotation."""
        return super().mode_amplitudes(x) + self.phase.project[:, -1] * self._shift(x)

    def _shift(self, x: Scalar) -> Scalar:
        return powers(x, self.shift.size) @ self.shift

    def state(self, x: Scalar) -> Inexact[Array, " states"]:
        """Return (q, q', theta) at x."""
        state = self.center + (self.phase.modes @ super().mode_amplitudes(x)).real
        return state.at[-1].add(self._shift(x))

    def outputs(self, x: Scalar) -> Inexact[Array, " outputs"]:
        """Return rotation, top displacement over L cos(alpha), its bending part, base moment over m L^2, at x."""
        linear = self.offsets + (self.phase.outputs @ super().mode_amplitudes(x)).real
        return linear + self.remainder @ powers(x, self.shift.size)

    def curves(self) -> Curve:
        """Return the outputs as curves. The errors of polynomials appear as those of an absent mode that turns fast."""
        linear, none = super().curves(), jnp.zeros((len(self.doubts), 1))
        return Curve(
            jnp.concatenate([linear.amplitudes, none], 1),
            jnp.concatenate([linear.rates, none + 1j * POINTS**2], 1),
            linear.coefficients + self.remainder,
            jnp.concatenate([linear.errors, self.doubts[:, None]], 1),
        )


class _Step(eqx.Module):
    """One step of a linear phase, with tables of the response of its modes to powers of x."""

    tangents: Tangents
    path: Arc
    side: Scalar
    ground: Inexact[Array, " points"]
    length: Scalar
    answers: Inexact[Array, "points terms modes"]
    rising: Inexact[Array, "terms modes"]

    def arc(self, force, shift) -> tuple:
        """Return amplitudes and coefficients of the modes under these forces and this shift of the rotation (powers of
        x)."""
        numbers, path, n = self.tangents.numbers, self.path, self.tangents.numbers.rotation.size
        onto, turned = path.phase.project[:, n:-1], path.phase.project[:, -1]
        total = force + shift[:, None] * (numbers.rotation * numbers.squares)
        drive = self.length * (total @ onto.T) - (jnp.asarray(_SLOPE, shift.dtype) @ shift)[:, None] * turned
        answer = jnp.einsum("jtm,jm->tm", self.answers, drive)
        slow, start = jnp.abs(path.exponents) < 1, -turned * shift[0]
        amplitudes = path.amplitudes + jnp.where(slow, 0.0, start - answer[0])
        return amplitudes, path.coefficients + answer + jnp.where(slow, start * self.rising, 0.0)

    def remainder(self, amplitudes, coefficients, shift) -> tuple[Remainder, Inexact[Array, "points modes"]]:
        """Return the remainder at the points, and the modes there."""
        path, x = self.path, jnp.asarray(_PLACES, coefficients.real.dtype)
        terms = np.arange(len(coefficients))
        waves = amplitudes * jnp.exp(path.exponents * x[:, None])
        table = powers(x, terms.size).T
        slopes = jnp.concatenate([jnp.zeros((POINTS, 1)), table[:, :-1]], 1) * terms
        modes = waves + table @ coefficients
        state = path.center + (modes @ path.phase.modes.T).real
        rate = ((waves * path.exponents + slopes @ coefficients) @ path.phase.modes.T).real
        state = state.at[:, -1].add(table[:, :POINTS] @ shift)
        rate = rate.at[:, -1].add(table[:, :POINTS] @ (jnp.asarray(_SLOPE, shift.dtype) @ shift))
        found = jax.vmap(self.tangents.remainder, (0, 0, 0, None))(state, rate / self.length, self.ground, self.side)
        return found, modes

    def shift(self, found: Remainder) -> Inexact[Array, " points"]:
        """Return the rotation of the base against the column that balances the moment of the remainder."""
        numbers = self.tangents.numbers
        stiffness = jnp.sum(numbers.rotation**2 * numbers.squares) - numbers.spring_rate
        return jnp.where(self.side == 0, 0.0, -found.moment / stiffness)


def nonlinear_arc(
    tangents: Tangents, path: Arc, side: Scalar, load: Inexact[Array, " order"], length: Scalar
) -> NonlinearArc:
    """Compute the arc with its remainder; `load`: the ground acceleration [g] by powers of x."""
    terms = len(path.coefficients)
    ground = powers(jnp.asarray(_PLACES, load.dtype), load.size).T @ load
    step = _Step(tangents, path, side, ground, length, answers(path.exponents, POINTS), rising_terms(path.exponents))
    n = tangents.numbers.rotation.size
    force, shift = jnp.zeros((POINTS, n)), jnp.zeros(POINTS)

    def followed(carry):
        """Compute the modes under the present forces and shift, and the remainder there."""
        (force, shift, *_), _ = carry
        amplitudes, coefficients = step.arc(force, shift)
        return amplitudes, coefficients, *step.remainder(amplitudes, coefficients, shift)

    def round_(number, carry):
        held, _ = carry
        led = followed(carry)
        *_, found, modes = led
        moved = jnp.max(jnp.abs(modes - held[2]))
        following = _POWERS @ found.force, _POWERS @ step.shift(found), modes, moved
        # The last round only compares. At rounding level, stiff modes make the change grow again.
        better = (number < _ROUNDS) & ((number < 3) | (moved < held[3]))
        return tuple(jnp.where(better, new, old) for new, old in zip(following, held)), led

    held = force, shift, jnp.zeros((POINTS, path.exponents.size), path.exponents.dtype), jnp.asarray(jnp.inf)
    nothing = jax.tree.map(jnp.zeros_like, jax.eval_shape(followed, (held, None)))
    (_, shift, before, change), (amplitudes, coefficients, found, modes) = jax.lax.fori_loop(
        0, _ROUNDS + 1, round_, (held, nothing)
    )
    unsettled = jax.lax.stop_gradient(jnp.max(jnp.abs(modes - before), 0))
    turned = step.shift(found)
    outputs = jnp.stack([turned, found.displacement, found.bending - turned, jnp.zeros(POINTS)], 1)
    tails = _tail(outputs)
    onto = jnp.abs(path.phase.project[:, n:-1])
    rounding = 8 * jnp.finfo(tails.dtype).eps * tangents.numbers.balance  # no shorter step makes it smaller
    turns = jnp.maximum(tails[0] - rounding, 0.0)
    forced = onto @ (_tail(found.force) + turns * jnp.abs(tangents.numbers.rotation * tangents.numbers.squares))
    forced = jnp.max(forced * length / (1 + jnp.abs(path.exponents)))
    change = jnp.maximum(change - 8 * jnp.max(path.errors), 0.0)
    error = jax.lax.stop_gradient(forced + change + jnp.max(tails[:3]))
    remainder = jnp.pad((_POWERS @ outputs).T, ((0, 0), (0, terms - POINTS)))
    return NonlinearArc(
        path.phase, path.center, path.offsets, amplitudes, path.exponents, coefficients, path.errors + unsettled,
        shift=jnp.pad(shift, (0, terms - POINTS)), remainder=remainder, doubts=jax.lax.stop_gradient(tails),
        error=error,
    )  # fmt: skip


def _tail(values: Inexact[Array, "points *more"]) -> Inexact[Array, "*more"]:
    """Return the size of the last two Chebyshev coefficients."""
    return jnp.max(jnp.abs(_SPECTRUM[-2:] @ values), 0)
