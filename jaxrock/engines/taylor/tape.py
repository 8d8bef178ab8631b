"""Steps on a tape: reverse-mode derivatives by many numbers at once, such as all samples of a record.

A run without derivatives computes the states before all steps. Each step then is a function of the state before it, of
the ground motion within it, and of the parameters of the block. The Jacobians of many steps are computed at once. Their
products carry tangents from step to step, and such a chain transposes.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxrock._core.types import Scalar
from jaxrock._core.unit_tangents import AT_ONCE, in_rows, unit_tangents
from jaxrock.compiler import custom_tangent, lane_function
from jaxrock.compiler.hints import stop_gradient
from jaxrock.engines.scene import Here
from jaxrock.engines.state import State
from jaxrock.engines.trajectory import rows_of, states_of
from jaxrock.motions.shaking import Shaking

_Stepper = Any  # a `TaylorStepper`, whose module imports this one
_TOGETHER = 256  # steps whose Jacobians are computed at once
_PATH = ("local", "opening", "velocity")  # the state variables of a step
# A step keeps each recorded extremum, or computes it from the path. Two of them may instead take the previous value of
# these first ones.
_FIRST = ("peak", "clearance")
_LATER = ("second", "peak_clearance")
_OTHERS = ("peak_time", "fastest", "impact_time", "impact_velocity", "closeness", "closeness_beyond")
_SEEN = (*_FIRST, *_LATER, *_OTHERS)


class _Ground(NamedTuple):
    """The ground motion that a step sees: its series about a time `local` after the start of a piece."""

    shaking: Shaking
    unit: Scalar
    start: Scalar
    length: Scalar

    @classmethod
    def of(cls, stepper: _Stepper, piece: Int[Array, ""], local: Scalar) -> "_Ground":
        """Evaluate the motion at this time."""
        shaking, unit = stepper.shaking(piece, local)
        return cls(shaking, unit, stepper.scene.start(piece), stepper.scene.length(piece))


class _Numbers(NamedTuple):
    """The inputs of the steps of a scene, besides the motion."""

    moments: Any
    far: Any
    p: Scalar
    alpha: Scalar
    reset: Any
    far_reset: Any
    stop: Scalar | None

    @classmethod
    def of(cls, stepper: _Stepper) -> "_Numbers":
        """Collect the inputs of a scene."""
        scene = stepper.scene
        return cls(scene.moments, scene.far, scene.p, scene.alpha, scene.reset, scene.far_reset, stepper.stop)

    def put_into(self, stepper: _Stepper, here: Here) -> _Stepper:
        """Return the stepper with these inputs, and with one piece of the motion."""
        numbers = self._asdict()
        stop = numbers.pop("stop")
        return replace(stepper, scene=replace(stepper.scene, **numbers, here=here), stop=stop)


class _Slopes(NamedTuple):
    """Derivatives of path and recorded extrema after a step.

    - `columns`: a list with the derivatives of each of these by the path and by all inputs with tangents.
    - `kept`: the derivative of each extremum by its previous value; `passed`: of the later ones by the first ones.
    """

    columns: list
    kept: list
    passed: list


def end_on_tape(stepper: _Stepper, state: State) -> State:
    """Follow a block, and return the last state, as `on_tape`.

    An outcome may take many more steps than a history: memory for all would cost most blocks ten times the time of
    everything else. Stretches with the memory of a history are repeated until the block is done.
    """
    engine, scene = stepper.engine, stepper.scene
    most, usual = (engine.budget(scene, history) for history in (False, True))
    if most <= usual:
        return on_tape(stepper, state, most)[0]

    def further(state, limit):
        followed = jax.checkpoint(lambda stepper, state: on_tape(stepper, state, usual, limit)[0])
        return jax.lax.cond(state.done, lambda: state, lambda: followed(stepper, state)), None

    return jax.lax.scan(further, state, jnp.minimum(usual * (1 + jnp.arange(-(-most // usual))), most))[0]


def on_tape(stepper: _Stepper, state: State, room: int, limit: Int[Array, ""] | None = None) -> tuple[State, State]:
    """Follow a block: return the last state, and those before every step, as `states_of`.

    Reverse mode differentiates them by very many numbers through products.
    """
    still, start = stop_gradient((replace(stepper, taped=False), state))
    stretches = -(-room // _TOGETHER)
    last, nodes = stop_gradient(states_of(still, start, stretches * _TOGETHER, room if limit is None else limit))
    ground = jax.vmap(lambda piece, local: _Ground.of(stepper, piece, local))(nodes.piece, nodes.local)
    by = _reals(state), (_Numbers.of(stepper), ground), still, nodes, last.steps - start.steps
    ends, starts = custom_tangent(_changes, (_reals(last), _reals(nodes)), by)
    rows = rows_of(stepper.engine, room)  # no more than without a tape
    return _with_reals(last, ends), jax.tree.map(lambda x: x[:rows], _with_reals(nodes, starts))


def _reals(states: State) -> list:
    return [getattr(states, name) for name in (*_PATH, *_SEEN)]


def _with_reals(states: State, reals: list) -> State:
    return eqx.tree_at(_reals, states, reals)  # the states may have an axis in front


def _changes(values: tuple, by: tuple, changes: tuple) -> tuple[list, list]:
    """Return the tangents of the last state, and of those before every step: products with the Jacobians of the
    steps."""
    (_, reals), (path, told, still, nodes, steps), (first, d_told, *_) = values, by, changes
    first = jnp.stack([jnp.zeros_like(x) if d is None else d for x, d in zip(path, first)])
    numbers, by_numbers = _parted(told[0], d_told[0], jnp.zeros(0, first.dtype))
    ground, by_ground = _parted(told[1], d_told[1], jnp.zeros((nodes.steps.size, 0), first.dtype))
    nodes = _with_reals(nodes, reals)
    starts = jnp.arange(0, nodes.steps.size - 1, _TOGETHER)

    @jax.checkpoint
    def stretch(change, rows):
        start, by_ground = rows

        def go(change):
            # The scan would copy all of them first, if they were its `xs`.
            here = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, _TOGETHER), (nodes, ground))
            products = jax.vmap(lambda node, ground, by: _products(still, node, numbers, ground, by_numbers, by))
            going = start + jnp.arange(_TOGETHER) < steps
            return jax.lax.scan(_one, change, (going, *products(*here, by_ground)))

        def wait(change):
            return change, jnp.broadcast_to(change, (_TOGETHER, *change.shape))

        return jax.lax.cond(start < steps, go, wait, change)

    by_ground = by_ground[:-1].reshape(starts.size, _TOGETHER, -1)
    last, found = jax.lax.scan(stretch, first, (starts, by_ground))
    return list(last), list(jnp.concatenate([found.reshape(-1, first.size), last[None]]).T)


def _parted(told: Any, changes: Any, none: Array) -> tuple[tuple, Array]:
    """Partition the inputs into those with tangents and the rest; flatten the tangents behind `none`."""
    moving = jax.tree.map(lambda x, d: None if d is None else x, told, changes)
    rest = jax.tree.map(lambda x, d: x if d is None else None, told, changes)
    known = jax.tree.leaves(changes)
    return (moving, rest), jnp.concatenate([none, *(d.reshape(*none.shape[:-1], -1) for d in known)], axis=-1)


def _one(change: Array, step: tuple) -> tuple[Array, Array]:
    """Return the tangent of a state after a step, and that before it."""
    going, by_path, kept, passed, own = step
    path, seen = change[: len(_PATH)], change[len(_PATH) :]
    none = jnp.zeros_like(change)
    later = jnp.concatenate([none[: len(_FIRST)], passed * seen[: len(_FIRST)], none[: len(_OTHERS)]])
    after = own + (by_path * path).sum(axis=1) + jnp.concatenate([none[: len(_PATH)], kept * seen + later])
    return jnp.where(going, after, change), change


def _products(
    still: _Stepper, node: State, numbers: tuple, ground: tuple, by_numbers: Array, by_ground: Array
) -> tuple:
    """Return, for a step, the Jacobian by the path, the factors of the extrema, and the tangent from all other inputs.

    Factors are those by the extremum itself, and by the first ones. `numbers`, `ground`: the inputs with tangents, and
    the rest.
    """
    moving, rest = zip(numbers, ground)
    leaves = [*_path_of(node), *jax.tree.leaves(moving)]
    slopes = lane_function(_slopes, key="slopes of a step", in_lanes=True, mode="jacobian by columns")
    rows = in_rows(unit_tangents(leaves), AT_ONCE)
    found, kept, passed = jax.vmap(lambda *row: slopes((still, rest, moving, node, row)))(*rows)
    columns = jnp.stack(found).reshape(len(found), -1)[:, : sum(x.size for x in leaves)]
    by_path, by_told = columns[:, : len(_PATH)], columns[:, len(_PATH) :]
    change = (by_told * jnp.concatenate([by_numbers, by_ground])).sum(axis=1)
    return by_path, jnp.stack(kept)[:, 0], jnp.stack(passed)[:, 0], change


def _slopes(given_: tuple) -> _Slopes:
    """Differentiate a step in directions of its path and of all inputs with tangents."""
    stepper, rest, moving, node, directions = given_
    local = stop_gradient(node.local)
    leaves, structure = jax.tree.flatten(moving)
    path, seen = _path_of(node), [getattr(node, name) for name in _SEEN]

    def step(path, seen, moving):
        numbers, ground = eqx.combine(moving, rest)
        told = numbers.put_into(stepper, Here(node.piece, ground.start, ground.length))
        before = replace(node, **dict(zip(_PATH, path)), **dict(zip(_SEEN, seen)))
        # The shift is zero: its tangent moves the series with the start of the step.
        after = told.step(before, ground.shaking.shifted((before.local - local) / ground.unit), ground.unit)
        return [getattr(after, name) for name in (*_PATH, *_SEEN)]

    def by_path(seen):
        def pushed(*direction):
            def moved(*x):
                return step(x[: len(path)], seen, structure.unflatten(x[len(path) :]))

            return jax.jvp(moved, (*path, *leaves), direction)

        return jax.vmap(pushed, out_axes=(None, 0))(*directions)

    def by_seen(*direction):
        (_, columns), (changes, _) = jax.jvp(by_path, (seen,), (list(direction),))
        return columns, changes[len(path) :]

    # Two directions separate all derivatives by the extrema: the first ones with the others, and the later ones.
    later = jnp.array([name in _LATER for name in _SEEN])
    both = jnp.stack([~later, later]).astype(node.local.dtype)
    columns, seen_by = jax.vmap(by_seen, out_axes=(None, 0))(*both.T)
    kept = [each[int(name in _LATER)] for name, each in zip(_SEEN, seen_by)]
    return _Slopes(columns, kept, [each[0] for name, each in zip(_SEEN, seen_by) if name in _LATER])


def _path_of(node: State) -> list:
    return [getattr(node, name) for name in _PATH]
