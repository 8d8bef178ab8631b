"""The interface of an engine: its settings, and a stepper that applies them to one scene.

An engine supplies `advance`, which follows a rocking block from event to event; `finish`, which solves the free stage;
and `evaluate`, which reads a history. The steps that all engines share are in `rest`, `impact` and `bookkeeping`.
"""

import abc
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
from equinox import AbstractVar
from jaxtyping import Array, Int, PyTree

from jaxrock._core.types import Flag, Scalar
from jaxrock.compiler.hints import select
from jaxrock.engines.scene import Scene
from jaxrock.engines.state import Counts, Node, State

FEW_PIECES = 32  # up to which a motion is over before chaos grows
Stepper = TypeVar("Stepper", bound="AbstractStepper")


class AbstractEngine(eqx.Module):
    """Settings of a way to solve scenes."""

    @property
    def reverse(self) -> bool:
        """Return whether reverse mode differentiates this engine's own loops."""
        return False

    @property
    def forward(self) -> "AbstractEngine":
        """Return the engine for runs without derivatives."""
        return self

    @property
    def in_lanes(self) -> bool:
        """Return whether machine code can run its steps."""
        return False

    @abc.abstractmethod
    def stepper(self, scene: Scene, stop: Scalar | None, history: bool, taped: bool = False) -> "AbstractStepper":
        """Return the stepper of a scene, up to the time `stop` [s] (None: the end of the motion).

        With `taped`, its steps support reverse mode.
        """

    @abc.abstractmethod
    def budget(self, scene: Scene, history: bool) -> int:
        """Return the largest number of steps."""

    @abc.abstractmethod
    def loop(self, unfinished: Callable, step: Callable, carry: PyTree, budget: int) -> PyTree:
        """Repeat `step` while `unfinished`, at most `budget` times."""


class AbstractStepper(eqx.Module):
    """One scene with an engine's settings, and how far to follow it."""

    if TYPE_CHECKING:  # annotations here would make them arguments of every subclass, in this order

        @property
        def scene(self) -> Scene: ...
        @property
        def stop(self) -> Scalar | None: ...
        @property
        def engine(self) -> AbstractEngine: ...
        @property
        def history(self) -> bool: ...
        @property
        def doubt(self) -> float: ...
    else:
        scene: AbstractVar[Scene]
        stop: AbstractVar[Scalar | None]  # time at which to stop [s]; None: at the end of the motion
        engine: AbstractVar[AbstractEngine]
        history: AbstractVar[bool]  # follow an overturning block down to the ground
        doubt: AbstractVar[float]  # standard errors from the boundary within which no verdict is given

    @abc.abstractmethod
    def advance(self, state: State) -> State:
        """Return the state at the next event or step."""

    def begun(self, state: State) -> State:
        """Return a state at time 0, or at the end of the motion, from which `advance` follows a block."""
        if not self.follows_free_stage:
            return state
        return replace(state, counts=Counts(state.impacts, state.large_impacts))

    def to_the_end(self, state: State) -> State:
        """Advance a state at time 0 to the end of the motion, or until the block is lost."""
        state = self.begun(state)
        budget = self.engine.budget(self.scene, history=False)
        return self.engine.loop(lambda s: ~s.done & (s.steps < budget), lambda s: self.advance(s), state, budget)

    @property
    def has_copies(self) -> bool:
        """Return whether copies are followed where errors outgrow the rotation: under motions of many pieces."""
        return self.scene.most_pieces > FEW_PIECES

    @property
    def follows_free_stage(self) -> bool:
        """Return whether steps follow the free stage, too."""
        return False

    def after_history(self, state: State) -> State:
        """Follow the free stage by steps from the last state of a history."""
        stepper: Any = replace(self, stop=None, history=False)  # type: ignore[call-arg]  # fields of all that are no base
        moving = (state.side != 0) & ~state.overturned & (state.piece >= self.scene.pieces)
        state = replace(state, done=~moving | ~state.done, steps=jnp.zeros_like(state.steps))
        return stepper.to_the_end(state)

    @abc.abstractmethod
    def finish(self, state: State) -> State:
        """Advance a state from the end of the motion to the end of the free stage: peak, verdict and margin."""

    @abc.abstractmethod
    def evaluate(self, node: Node, elapsed: Scalar) -> tuple[Scalar, Scalar]:
        """Return the opening angle [rad] and its velocity [rad/s], `elapsed` seconds after a node and before the
        next."""

    def on(self: Stepper, side: Scalar) -> Stepper:
        """Return the stepper for a block that stands on this side."""
        if self.scene.far is None:
            return self
        return replace(self, scene=self.scene.on(side))  # type: ignore[call-arg]  # a field of all that are no base

    def at(self: Stepper, state: State | Node) -> Stepper:
        """Return the stepper for a block in this state: on its side, with what ties remember there."""
        stepper = self.on(state.side)
        moments: Any = stepper.scene.moments
        if not moments.remembers or state.reached is None:
            return stepper
        scene = replace(stepper.scene, moments=moments.remembering(state.reached.on(state.side)))
        return replace(stepper, scene=scene)  # type: ignore[call-arg]

    def time(self, state: State | Node) -> Scalar:
        """Return the time of a state [s]."""
        return self.scene.start(state.piece) + state.local

    def room(self, state: State) -> Scalar:
        """Return the time to the next knot or the stop [s]."""
        # In a tie, `jnp.minimum` and `jnp.maximum` would average both derivatives. A zero room has derivatives, too:
        # one of two coinciding knots may move.
        room = self._to_knot(state)
        if self.stop is not None:
            left = self.stop - self.time(state)
            room = select(room <= left, room, left)
        return select(room < 0, 0.0, room)

    def _to_knot(self, state: State) -> Scalar:
        return self.scene.length(state.piece) - state.local

    def _is_over_by(self, stop: Scalar, piece: Int[Array, ""]) -> Flag:
        """Return whether a piece ends before the stop or with it: a computed duration may round to either side."""
        following = select(piece < self.scene.pieces, self.scene.start(piece + 1), jnp.inf)
        return following <= stop * (1 + 8 * float(jnp.finfo(following.dtype).eps))

    def move_on(self, state: State, elapsed: Scalar, full: Flag) -> tuple[Int[Array, ""], Scalar, Flag]:
        """Return piece and local time after `elapsed` seconds (`full`: up to the knot or the stop), and whether the
        motion is over."""
        ends = full if self.stop is None else full & self._is_over_by(self.stop, state.piece)
        piece = state.piece + ends
        if (
            self.scene.following is not None and not self.history
        ):  # a history takes as many steps with derivatives as without
            piece = select(ends, self.scene.from_here(piece), piece)
        over = piece >= self.scene.pieces if self.stop is None else full & ~ends
        return piece, select(ends, 0.0, state.local + elapsed), over
