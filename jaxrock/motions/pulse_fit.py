"""Fitting a pulse to a record: parameters of any class of pulses, by nonlinear least squares with exact derivatives.

Correlation finds the best begin of the pulse for a grid of its other parameters. SciPy's least squares descends from
the best points of the grid.
"""

import functools
import inspect
import itertools
from collections.abc import Callable, Mapping
from typing import Annotated, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrock._arguments.annotations import arguments, at_least, pair, word_of
from jaxrock._arguments.parameters import check_single
from jaxrock._arguments.ranges import finite, scalar
from jaxrock._arguments.repr import described
from jaxrock._core.arrays import shown
from jaxrock._core.one_program import check_known
from jaxrock.blocks.rigid import GRAVITY
from jaxrock.motions.motion import AbstractMotion
from jaxrock.motions.pulses import UNITS
from jaxrock.motions.record import Record, record_in_g
from jaxrock.numerics.gauss_legendre import gauss_legendre
from jaxrock.numerics.lookup import count_up_to
from jaxrock.status import Enumeration, item

_ORDER = 6  # nodes of the quadrature over parts of pieces
_PARTS = 64  # least number of parts of every smooth piece of a pulse
_PER_SCALE = 0.5  # parts per time scale of the acceleration: exact to 1e-9
_MOST = 1 << 14
_LENGTHS = 14  # grid points for a period or duration
_USUAL = {"oscillations": (1.01, 8.0), "shape": (-30.0, 30.0), "phase": (-np.pi, np.pi)}
_FIRST = {"oscillations": (1.2, 2.0, 3.0), "shape": (-4.0, 0.0, 4.0), "phase": (0.0, np.pi / 2)}  # points of the grid


class PulseStatus(Enumeration):
    """The outcome of a fit of a pulse; `PulseStatus[fit.status]` is the message."""

    successful = item("The sum of squares has a minimum there.")
    at_an_end = item("The least sum of squares lies at an end of a range: widen it, or take another pulse.")
    not_converged = item("The minimum of the sum of squares was not reached.")


class PulseFit(eqx.Module):
    """The result of `fit_pulse`.

    - `motion`: the pulse after its `delay` [s] in the record; `pulse`: the same from time 0.
    - `values`: its parameters by name, the delay among them; `at_ends`: names of those at an end of their range.
    - `explained`: share of the squares of the record's velocity (or acceleration) that the pulse explains, at most 1.
    - `residual`: the record without the pulse: fit another one to it.
    - `status`: a `PulseStatus`.
    """

    __repr__ = described

    pulse: AbstractMotion
    values: dict[str, float]
    explained: float
    residual: Record
    status: PulseStatus
    at_ends: tuple[str, ...] = eqx.field(static=True)

    @property
    def delay(self) -> float:
        """Time at which the pulse begins [s]."""
        return self.values["delay"]

    @property
    def motion(self) -> AbstractMotion:
        """The pulse after its delay in the record."""
        return self.pulse.shifted(self.delay)


@arguments
def fit_pulse(
    record: Record,
    pulse: Callable[..., AbstractMotion],
    ranges: Mapping | None = None,
    *,
    of: Annotated[str, word_of("velocity", "acceleration")] = "velocity",
    starts: Annotated[int, at_least(1, 100)] = 6,
) -> PulseFit:
    """Fit a pulse of a class to a record, by least squares.

    **Arguments:**

    - `record`: a `Record`, its baseline corrected.
    - `pulse`: makes a motion of its parameters, proportional to `amplitude`: a class such as
      `rk.MavroeidisPapageorgiouPulse`, or a function. Parameters that `functools.partial` sets by name are not fitted.
    - `ranges`: (low, high) of parameters by name, `delay` [s] among them. The default ranges are: times from four
      samples to the whole record, `oscillations` 1.01 to 8, `shape` -30 to 30, phases half a turn either way.
      Parameters of other names must have a range.
    - `of`: compared at all samples: "velocity", as is usual for pulses near faults, or "acceleration".
    - `starts`: number of descents, from the best points of a grid, each with its best-correlated delay.

    **Returns:** a `PulseFit`. There may be lower minima that no start leads to.

    **Raises:** ValueError for arguments outside their ranges, and for a record that does not move.

    **Source:** Mavroeidis & Papageorgiou (2003), fits to velocities; Branch, Coleman & Li (1999), the descent.
    """
    check_single(record=record)
    check_known(record=record)
    if ranges is not None and not isinstance(ranges, Mapping):
        raise ValueError(f"Argument `ranges` must hold pairs by name, but is {shown(ranges)}.")
    problem = _Problem.of(record, pulse, ranges or {}, of)
    found = min((problem.descend(place) for place in problem.starts(starts)), key=lambda result: result.cost)
    values = {name: float(value) for name, value in problem.kind.values(found.x).items()}
    best = pulse(**{name: value for name, value in values.items() if name != "delay"})
    slack = 1e-6 * (problem.upper - problem.lower)
    ended = (found.x - problem.lower < slack) | (problem.upper - found.x < slack)
    at_ends = tuple(name for name, end in zip(problem.kind.names, ended) if end and name not in ("amplitude", "phase"))
    status = PulseStatus.at_an_end if at_ends else PulseStatus.successful
    status = status if found.status > 0 else PulseStatus.not_converged
    explained = 1 - 2 * float(found.cost) / float(problem.target @ problem.target)
    rest = np.asarray(record.samples, float) - np.asarray(best.shifted(values["delay"]).acceleration(problem.times))
    residual = record_in_g(rest, record.dt, record.name, record.origin)
    return PulseFit(best, values, explained, residual, status, at_ends)


class _Kind(NamedTuple):
    """The map from a point of the search space to a pulse: parameters, of which durations enter as logarithms."""

    pulse: Callable[..., AbstractMotion]
    names: tuple[str, ...]
    logarithmic: tuple[bool, ...]
    of: str
    parts: int = _PARTS

    def values(self, place) -> dict:
        """Return the parameters by name."""
        return {name: jnp.exp(x) if log else x for name, x, log in zip(self.names, place, self.logarithmic)}


class _Problem(NamedTuple):
    """The least-squares problem: target values at `times`, and the bounds of the search space."""

    kind: _Kind
    target: Float[np.ndarray, " n"]
    times: Float[np.ndarray, " n"]
    lower: Float[np.ndarray, " parameters"]
    upper: Float[np.ndarray, " parameters"]

    @classmethod
    def of(cls, record: Record, pulse: Callable, ranges: Mapping, of: str) -> "_Problem":
        """Check the arguments and make the problem."""
        samples, dt = np.asarray(record.samples, float), float(record.dt)
        if samples.size < 8 or not np.abs(samples).max() > 0:
            raise ValueError("Argument `record` must move, and have 8 samples at least.")
        times, most = dt * np.arange(samples.size), 30 * np.abs(samples).max()
        velocity = GRAVITY * np.concatenate([[0.0], np.cumsum((samples[1:] + samples[:-1]) * dt / 2)])
        names = (*_parameters(pulse), "delay")
        for name in set(ranges) - set(names):
            raise ValueError(f"Argument `ranges` must hold {', '.join(names)}, but holds {shown(name)}.")
        usual = _USUAL | {name: (4 * dt, times[-1]) for name in names if UNITS.get(name) == "s"}
        usual |= {"delay": (0.0, times[-1]), "amplitude": (-most, most)}
        ends = np.array([_range(name, ranges.get(name, usual.get(name))) for name in names])
        logarithmic = tuple(
            name != "delay" and UNITS.get(name) == "s" and low > 0 for name, (low, _) in zip(names, ends)
        )
        ends = np.where(np.array(logarithmic)[:, None], np.log(np.where(ends > 0, ends, 1.0)), ends)
        kind = _Kind(pulse, names, logarithmic, of)
        kind = kind._replace(parts=_parts_of(kind, ends))
        return cls(kind, velocity if of == "velocity" else samples, times, *ends.T)

    def starts(self, count: int) -> list[np.ndarray]:
        """Return the best points of a grid, each with its best delay and amplitude."""
        from scipy.signal import correlate

        names = self.kind.names
        places = np.array(list(itertools.product(*map(self._tried, range(len(names))))))
        seen, size, found = np.asarray(_models(self.kind, places, self.times), float), self.target.size, []
        allowed = (self.times >= self.lower[-1] - 1e-9) & (self.times <= self.upper[-1] + 1e-9)
        for place, one in zip(places, seen):
            products = correlate(self.target, one, method="fft")[size - 1 :]
            squares = np.maximum(np.cumsum(one**2)[::-1], 1e-300)  # of the part within the record, for each delay
            gains = np.where(allowed & (squares > 1e-3 * squares[0]), products**2 / squares, -np.inf)
            at = int(np.argmax(gains))
            place[names.index("amplitude")], place[-1] = products[at] / squares[at], self.times[at]
            found.append((gains[at], place))
        found.sort(key=lambda each: -each[0])
        return [place for _, place in found[:count]]

    def _tried(self, index: int) -> np.ndarray:
        """Return the grid of one parameter; the best amplitude and delay follow from the others."""
        name, low, high = self.kind.names[index], self.lower[index], self.upper[index]
        if name in ("amplitude", "delay"):
            return np.array([1.0 if name == "amplitude" else 0.0])
        if UNITS.get(name) == "s":
            return np.linspace(low, high, _LENGTHS)
        first = np.array(_FIRST.get(name, ()))
        first = first[(first > low) & (first < high)]
        return first if first.size else low + (high - low) * np.array([0.25, 0.5, 0.75])

    def descend(self, place: np.ndarray):
        """Run SciPy's least squares from a point."""
        from scipy.optimize import least_squares

        room, known = 1e-9 * (self.upper - self.lower), {}

        def at(x):
            """Return values and Jacobian at a point, which SciPy asks for one after the other."""
            if x.tobytes() not in known:
                known.clear()
                known[x.tobytes()] = _with_slopes(self.kind, x, self.times)
            return known[x.tobytes()]

        return least_squares(
            lambda x: np.asarray(at(x)[0]) - self.target,
            np.clip(place, self.lower + room, self.upper - room),
            jac=lambda x: np.asarray(at(x)[1]),
            bounds=(self.lower, self.upper),
            x_scale="jac",
            xtol=1e-12,
            ftol=1e-12,
            gtol=1e-12,
            max_nfev=200,
        )


def _parts_of(kind: _Kind, ends: np.ndarray) -> int:
    """Return the number of parts of each piece, so that the acceleration of all pulses in the ranges changes little in
    each.

    **Raises:** ValueError for ranges of pulses with too many cycles.
    """
    changes = float(np.nanmax(np.asarray(_changes(kind, np.array(list(itertools.product(*ends)))))))
    if _PER_SCALE * changes > _MOST:
        told = (
            f"{_MOST / _PER_SCALE:g} times the time in which their acceleration changes, but hold {changes:.3g} times"
        )
        raise ValueError(f"Argument `ranges` must hold pulses that last at most {told} that.")
    return max(_PARTS, 1 << int(np.ceil(np.log2(max(_PER_SCALE * changes, 1.0)))))


@functools.partial(jax.jit, static_argnums=0)
def _changes(kind: _Kind, places):
    """Return, at some points, the largest ratio of a piece's length to the time scale of its acceleration."""

    def at(place):
        values = kind.values(place)
        del values["delay"]
        pulse = kind.pulse(**values)
        return jnp.zeros(()) if pulse.scales is None else jnp.max(pulse.lengths / pulse.scales)

    return jax.vmap(at)(places)


def _parameters(pulse: Callable) -> list[str]:
    """Return the names of the numeric parameters of a function that makes a pulse."""
    told = inspect.signature(pulse).parameters.values()
    names = [each.name for each in told
             if each.kind is each.POSITIONAL_OR_KEYWORD and not isinstance(each.default, str | None)]  # fmt: skip
    if "amplitude" not in names or "delay" in names:
        raise ValueError(f"Argument `pulse` must have an `amplitude`, and no `delay`, but has {', '.join(names)}.")
    return names


def _range(name: str, value) -> tuple[float, float]:
    """Return the checked ends of the range of a parameter."""
    if value is None:
        raise ValueError(f"Argument `ranges` must hold a range of `{name}`, but does not.")
    low, high = (float(scalar(f"ranges[{name}]", finite(f"ranges[{name}]", end))) for end in pair("ranges", value))
    if not low < high:
        raise ValueError(f"Argument `ranges` must rise, but that of `{name}` is {low:g} to {high:g}.")
    return low, high


def _model(kind: _Kind, place, times):
    """Return the compared quantity, velocity or acceleration, at all times."""
    values = kind.values(place)
    times = times - values.pop("delay")
    pulse = kind.pulse(**values)
    return GRAVITY * _velocity(pulse, times, kind.parts) if kind.of == "velocity" else pulse.acceleration(times)


@functools.partial(jax.jit, static_argnums=0)
def _models(kind: _Kind, places, times):
    return jax.lax.map(lambda place: _model(kind, place, times), places)


@functools.partial(jax.jit, static_argnums=0)
def _with_slopes(kind: _Kind, place, times):
    def twice(place):
        value = _model(kind, place, times)
        return value, value

    slopes, value = jax.jacfwd(twice, has_aux=True)(place)
    return value, slopes


def _velocity(pulse: AbstractMotion, times: Float[Array, " n"], count: int) -> Float[Array, " n"]:
    """Integrate the acceleration by Gauss-Legendre quadrature over parts of pieces [g s]; exact also where a pulse
    jumps.
    """
    knots, lengths = pulse.knots, pulse.lengths
    nodes, weights = (jnp.asarray(values) for values in gauss_legendre(_ORDER))
    piece = jnp.clip(jax.vmap(lambda time: count_up_to(knots, time))(times) - 1, 0, lengths.size - 1)
    local = jnp.clip(times - knots[piece], 0.0, lengths[piece])
    width = jnp.where(lengths[piece] > 0, lengths[piece], 1.0) / count
    part = jnp.clip(jnp.floor(jax.lax.stop_gradient(local / width)).astype(int), 0, count - 1)
    # One batch of quadratures, to compile less: all parts of all pieces, then the part before each time.
    every, parts = jnp.repeat(jnp.arange(lengths.size), count), jnp.tile(jnp.arange(count), lengths.size)
    pieces = jnp.concatenate([every, piece])
    begins = jnp.concatenate([parts * lengths[every] / count, part * width])
    widths = jnp.concatenate([lengths[every] / count, local - part * width])

    def gain(piece, begin, width):
        places = begin + width * (1 + nodes) / 2
        return jax.vmap(lambda place: pulse.series(piece, place, jnp.ones_like(place), 0)[0])(places) @ weights * width

    gains = jax.vmap(gain)(pieces, begins, widths) / 2
    before = jnp.concatenate([jnp.zeros(1), jnp.cumsum(gains[: every.size])])
    return before[piece * count + part] + gains[every.size :]
