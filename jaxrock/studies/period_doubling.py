"""Bifurcation diagrams: what a block does after many periods of a motion, over a parameter of the motion."""

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxrock._arguments.annotations import arguments, at_least, pair
from jaxrock._arguments.parameters import check_single
from jaxrock._arguments.ranges import Range
from jaxrock._arguments.tables import AbstractTable, Column
from jaxrock._core.arrays import Values
from jaxrock._core.precision import say_if_single
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.rigid import Block
from jaxrock.compiler import trace_function
from jaxrock.compiler.hints import jit_low_effort
from jaxrock.engines.stepper import AbstractEngine
from jaxrock.models.equation import AbstractEquation
from jaxrock.models.rigid import Housner
from jaxrock.motions.motion import AbstractMotion
from jaxrock.responses.arguments import start_of
from jaxrock.responses.current_model import current_model
from jaxrock.status import Status
from jaxrock.studies.spectra import axis
from jaxrock.studies.stroboscopic import StroboscopicState, after_turns
from jaxrock.sweeps.runner import cheap_per_point
from jaxrock.sweeps.sweep import surface

_EQUAL = 1e-6  # distance over the slenderness of states that are the same
_any = Range("be finite, and at most 1e9 in size", -jnp.inf, jnp.inf, lambda x: (x >= -1e9) & (x <= 1e9))


class Bifurcation(AbstractTable):
    """A bifurcation diagram: states after many periods, over a parameter of the motion.

    - `parameter`: (n,) values of the parameter.
    - `rotation`, `velocity`: (n, periods) states once a period, after the transient [rad], [rad/s]; infinite if the
      block overturned, NaN if it was not computed.
    - `period`: (n,) number of periods after which the state comes back, to 1e-6 of the slenderness; 0: it does not
      within half of the periods recorded, as on a chaotic orbit or a slow way to a periodic one.
    - `overturned`: (n,) the verdict.
    - `status`: (n,) a `Status`.

    Points of a chaotic orbit are those of one of many orbits near the computed one: they tell the attractor, not the
    state after so many periods from this start.
    """

    parameter: Float[Array, " n"]
    rotation: Float[Array, "n periods"]
    velocity: Float[Array, "n periods"]
    period: Int[Array, " n"]
    overturned: Bool[Array, " n"]
    status: Status

    @property
    def _columns(self):
        over = ("parameter", "turn")
        told = {"parameter": Column(("parameter",), self.parameter)}
        told |= {"rotation": Column(over, self.rotation, "rad"), "velocity": Column(over, self.velocity, "rad/s")}
        return told | {name: Column(over[:1], getattr(self, name)) for name in ("period", "overturned", "status")}


@arguments
def bifurcation(
    block: Block | AsymmetricBlock,
    motion: Callable[[Any], AbstractMotion],
    parameter: Values,
    initial: Annotated[tuple[ArrayLike, ArrayLike], pair] = (0.0, 0.0),
    model: AbstractEquation = Housner(),
    *,
    follow: bool = False,
    transient: Annotated[int, at_least(1, 10**6)] = 200,
    periods: Annotated[int, at_least(2, 10**4)] = 48,
    engine: AbstractEngine | None = None,
    progress: bool | None = None,
) -> Bifurcation:
    """Compute the states of a block once a period, after many periods, over a parameter of the motion.

    **Arguments:**

    - `block`, `model`, `engine`: as in `outcome`.
    - `motion`: makes one period of the motion from a value of the parameter: a function that JAX can trace, such as
      `lambda amplitude: rk.HarmonicMotion(amplitude, 0.5, cycles=1)`.
    - `parameter`: (n,) values of the parameter, such as amplitudes [g].
    - `initial`: rotation [rad] and angular velocity [rad/s] at the start. Where several attractors exist, each start
      tells one of them (`basins`).
    - `follow`: whether each value starts from the last state of the value before, which follows one attractor as the
      parameter changes; from the value on at which it is lost, the block has overturned. False: all start from
      `initial`.
    - `transient`: periods before the first state that is recorded, from 1 to 1e6.
    - `periods`: number of states recorded, from 2 to 1e4.
    - `progress`: whether to draw a progress bar; None: on a terminal, if it takes long.

    **Returns:** a `Bifurcation`.
    With traced arguments (within `jax.jit`, `jax.vmap`, `jax.grad`) it is a plain function of arrays.

    **Raises:** ValueError for arguments outside their ranges.

    **Source:** Hogan (1989), periodic orbits of a block over the amplitude of harmonic shaking.
    """
    say_if_single()
    parameter = axis("parameter", parameter, _any)
    check_single(block=block)
    start = start_of(initial)
    number = jax.ShapeDtypeStruct((), jnp.result_type(*jax.tree.leaves(block), parameter))
    family = trace_function(motion, number)
    scene = block, family, current_model(model, block, parameter), engine, start, _Counts.of(transient, periods)
    if follow:
        return Bifurcation(parameter, *_following(parameter, scene))
    return Bifurcation(parameter, *surface(_recorded, (parameter,), scene, "bifurcation", progress))


class _Counts(NamedTuple):
    """Numbers of periods, as a scene holds them: one as a number, and one as the length of an array."""

    transient: Int[Array, ""]
    turns: Int[Array, " periods"]

    @classmethod
    def of(cls, transient: int, periods: int) -> "_Counts":
        return cls(jnp.asarray(transient, jnp.int32), jnp.zeros(periods, jnp.int32))


@jit_low_effort(follows_scenes=True)
def _following(parameter, scene) -> tuple:
    """Return what `_recorded` does for every value, each from the last state of the one before."""
    *rest, start, counts = scene
    kind = jnp.result_type(*jax.tree.leaves(scene[0]), parameter)

    def following(start, value):
        found = _recorded(value, (*rest, tuple(start), counts))
        known = found[-1] == Status.successful  # without a last state, the next value starts as this one did
        return jnp.where(known, jnp.stack([found[0][-1], found[1][-1]]).astype(kind), start), found

    return jax.lax.scan(following, jnp.stack(start).astype(kind), parameter)[1]


@cheap_per_point
def _recorded(value, scene) -> tuple:
    """Return states, the number of periods after which they recur, verdict and status."""
    block, family, model, engine, start, counts = scene
    motion = family(value.astype(jnp.result_type(*jax.tree.leaves(block), value)))
    if not isinstance(motion, AbstractMotion):
        raise ValueError(f"Argument `motion` must return a motion, but returned {type(motion).__name__}.")
    start = jnp.stack(start)

    def turn(found, _):
        more = _going_on(found, lambda: after_turns(block, motion, tuple(_still(found.state)), model, 1, engine))
        return more, found.state

    # A start that is lost, of a block that has overturned at the value before, stays lost.
    first = after_turns(block, motion, tuple(_still(start)), model, counts.transient, engine)
    lost = replace(first, rotation=start[0], velocity=start[1], overturned=jnp.isinf(start[0]))
    first = jax.tree.map(lambda a, b: jnp.where(jnp.isfinite(start).all(), a, b), first, lost)
    last, states = jax.lax.scan(turn, first, counts.turns)
    size = jnp.stack([block.alpha, block.alpha * block.p]) if isinstance(block, Block) else None
    size = jnp.stack([block.alpha1, block.alpha1 * block.p1]) if size is None else size
    return *states.T, _recurrence(states / size), last.overturned, last.status


def _going_on(found: StroboscopicState, more: Callable) -> StroboscopicState:
    """Return a later state, or the same of a block that is lost."""
    goes_on = ~found.overturned & (found.status == Status.successful)
    return jax.tree.map(lambda a, b: jnp.where(goes_on, a, b), more(), found)


def _still(state: Float[Array, "2"]) -> Float[Array, "2"]:
    """Return a state that can be followed, in place of one that is lost."""
    return jnp.where(jnp.isfinite(state), state, 0.0)


def _recurrence(states: Float[Array, "periods 2"]) -> Int[Array, ""]:
    """Return the smallest number of periods after which the last states recur; 0 if they do not."""
    most = states.shape[0] // 2
    lags = jnp.arange(1, most + 1)
    back = states[::-1]
    off = jax.vmap(lambda lag: jnp.abs(back[:most] - jnp.roll(back, -lag, axis=0)[:most]).max())(lags)
    recurs = off <= max(_EQUAL, 64 * float(jnp.finfo(states.dtype).eps))
    return jnp.where(recurs.any(), lags[jnp.argmax(recurs)], 0).astype(jnp.int32)
