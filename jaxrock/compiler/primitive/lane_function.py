"""A lane function: a function of one lane with its passes, derivatives, jaxprs and key."""

import abc
import enum
import functools
import threading
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.interpreters import partial_eval

from jaxrock._core.settings import under_usual_settings
from jaxrock.compiler.cache.key import settings
from jaxrock.compiler.cache.store import name_of
from jaxrock.compiler.hints.materialize import are_hints_wanted, with_hints
from jaxrock.compiler.jaxpr.fingerprint import Program
from jaxrock.compiler.jaxpr.scan_to_while import scan_to_while
from jaxrock.compiler.tracing import while_tracing


class Mode(enum.StrEnum):
    """How derivatives of a lane function are computed."""

    JACOBIAN = "jacobian"
    """One run computes value and Jacobian, which are contracted with the tangents. By more than eight numbers, machine
    code takes eight columns at a time."""

    JACOBIAN_OR_JVP = "jacobian or jvp"
    """As `JACOBIAN`, but by many numbers one run computes value and tangent."""

    COLUMNS = "jacobian by columns"
    """Each column of the Jacobian is a lane of its own, as in all derivatives of higher order."""

    JVP = "jvp"
    """One run computes value and tangent. It does not transpose: for parts of functions that forward mode follows."""

    TAPE = "tape"
    """Value and tangent are separate, and the tangent transposes, by JAX's reverse mode through the function."""


class TwoPass(abc.ABC):
    """A loop in two passes: a fast one for many lanes, and an accurate one for the lanes that the fast one rejects.

    - `round`: number of steps after which XLA forms new chunks of the unfinished lanes; None: never.
    """

    round: int | None = None

    @abc.abstractmethod
    def init(self, tree: Any) -> tuple[Any, Any]:
        """Return the point as the other methods take it, and the first state."""

    @abc.abstractmethod
    def fast(self, point: Any, state: Any, limit: Any) -> Any:
        """Return the state where it is finished or given up, or after `limit` steps since the first."""

    @abc.abstractmethod
    def accurate(self, point: Any, state: Any) -> Any:
        """Return the result of following the state with care."""

    @abc.abstractmethod
    def unfinished(self, point: Any, state: Any) -> Any:
        """Return whether the fast pass has to go on."""

    @abc.abstractmethod
    def result(self, point: Any, state: Any) -> tuple[Any, Any]:
        """Return the result of the fast pass, and whether it rejects the lane."""

    def accurate_only(self, tree: Any) -> Any:
        """Return the result of the accurate pass."""
        point, state = self.init(tree)
        return self.accurate(point, state)

    def fast_only(self, tree: Any) -> tuple[Any, Any]:
        """Return the result of the fast pass, and whether it rejects the lane."""
        point, state = self.init(tree)
        return self.result(point, self.fast(point, state, jnp.iinfo(jnp.int32).max))


class LaneFunction:
    """A function of one lane, `function(tree)`, for trees with leaves of the types `in_avals`.

    - `two_pass`: the same in two passes, where machine code may run it.
    - `reverse`: the same, for derivatives by many numbers: JAX's reverse mode goes through its code.
    - `key`: identifies it, with `in_avals`, in any process; None: only its jaxpr does.
    - `results`: `jax.ShapeDtypeStruct`s of what it returns; None: tracing tells.
    - `in_lanes`, `refill`: whether machine code may run it, and refill the lanes of its loop.
    - `order`: of the derivatives that it computes.
    - `mode`: of its derivatives.
    - `directions`: number of the last leaves that are tangents; `origin`: the function that these differentiate, and
      which of its leaves have one.
    """

    def __init__(
        self,
        function: Callable,
        structure: Any,
        in_avals: Sequence[jax.ShapeDtypeStruct],
        two_pass: TwoPass | None = None,
        reverse: Callable | None = None,
        key: str | None = None,
        results: Any = None,
        in_lanes: bool = False,
        refill: bool = False,
        order: int = 0,
        mode: Mode = Mode.JACOBIAN,
        directions: int = 0,
        origin: "tuple[LaneFunction, tuple[bool, ...]] | None" = None,
    ):
        self.function, self.structure, self.in_avals, self.order = function, structure, tuple(in_avals), order
        self.two_pass, self.reverse, self.key, self._results = two_pass, reverse, key, results
        self.in_lanes, self.refill = in_lanes or two_pass is not None, refill or bool(two_pass and two_pass.round)
        self.mode, self.directions, self.origin = mode, directions, origin
        self.compiled, self._derivatives, self._programs = {}, {}, {}

    @classmethod
    def of(cls, function: Callable, structure: Any, in_avals: Sequence, key: str | None, **rest: Any) -> "LaneFunction":
        """Return the lane function with this key, which holds what has been compiled of it; without a key a new one."""
        if key is None:
            return cls(function, structure, in_avals, **rest)
        alike = key, tuple((x.shape, x.dtype) for x in in_avals), structure, settings()
        with _one_at_a_time:
            fn = _alike.get(alike)
            if fn is None:
                fn = _alike[alike] = cls(function, structure, in_avals, key=key, **rest)
        _latest.note(fn)
        return fn

    def _traced(self, fast: bool) -> tuple[ClosedJaxpr, Any]:
        key = fast, are_hints_wanted()
        found = self._programs.get(key)
        if found is None:
            found = self._programs[key] = self._trace(
                self.two_pass.fast_only if fast and self.two_pass else self.function
            )
        if self.key is not None:  # without a key, its jaxpr may hold tracers, which exist once
            for fn in _with_programs.note(self):
                fn._programs.clear()
        return found

    @while_tracing
    @under_usual_settings
    def _trace(self, function: Callable) -> tuple[ClosedJaxpr, Any]:
        # Without a mesh: Equinox compares types of arguments where it differentiates the solves of Diffrax, and takes
        # types with the mesh of a `shard_map`, and types without it, for different ones.
        with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())):
            made = jax.make_jaxpr(lambda *x: function(self.structure.unflatten(x)), return_shape=True)
            program, shapes = made(*self.in_avals)
        needed, _ = partial_eval.dce_jaxpr(program.jaxpr, [True] * len(program.jaxpr.outvars), instantiate=True)
        program = ClosedJaxpr(needed, program.consts)
        return (program if self.mode == Mode.TAPE else scan_to_while(program)), shapes

    @property
    def program(self) -> ClosedJaxpr:
        """The jaxpr from leaves to leaves, without dead code; with hints for XLA where these are wanted now."""
        return self._traced(fast=False)[0]

    @property
    def fast(self) -> ClosedJaxpr | None:
        """The jaxpr of the fast pass; its last result tells whether the lane is rejected."""
        return self._traced(fast=True)[0] if self.two_pass is not None else None

    @property
    def results(self) -> Any:
        """Types of the result, a tree of `jax.ShapeDtypeStruct`."""
        if self._results is None:
            self._results = self._first[1]
        return self._results

    @property
    def _first(self) -> tuple[ClosedJaxpr, Any]:
        """The jaxpr and the results' types, traced as most likely needed: machine code needs no hints."""
        with with_hints(are_hints_wanted() and not self.in_lanes):
            return self._traced(fast=False)

    @property
    def holds_traced(self) -> bool:
        """Return whether its function captures tracers of a surrounding trace."""
        return self.key is None and any(isinstance(x, jax.core.Tracer) for x in self._first[0].consts)

    def __call__(self, leaves: Sequence) -> list:
        """Evaluate it at the leaves of one point."""
        return jaxpr_as_fun(self.program)(*leaves)

    @functools.cached_property
    def taped(self) -> "LaneFunction":
        """This function with derivatives by JAX's reverse mode."""
        assert self.reverse is not None
        key = None if self.key is None else f"{self.key} on tape"
        return LaneFunction(self.reverse, self.structure, self.in_avals, key=key, results=self.results, mode=Mode.TAPE)

    def derivative(self, has_tangent: tuple[bool, ...], make: Callable, *settings: int) -> "LaneFunction":
        """Return value and derivatives by some leaves, made once by `make(fn, has_tangent, *settings)`."""
        key = make, has_tangent, settings
        if key not in self._derivatives:
            self._derivatives[key] = make(self, has_tangent, *settings)
        return self._derivatives[key]

    @functools.cached_property
    def name(self) -> str:
        """Identify it in the text of jaxprs."""
        if self.key is not None:
            return name_of(self.key)
        return Program(self.program.jaxpr, None, ()).fingerprint(self.program.consts)

    def __repr__(self) -> str:
        return f"lane function {self.name}"


class _Latest:
    """The latest lane functions of all threads, at most so many."""

    def __init__(self, most: int):
        self._most, self._recipes, self._lock = most, dict[LaneFunction, None](), threading.Lock()

    def note(self, fn: LaneFunction) -> list[LaneFunction]:
        """Make this one the latest; return those that are among the latest no more."""
        with self._lock:
            self._recipes.pop(fn, None)
            self._recipes[fn] = None
            gone = list(self._recipes)[: -self._most]
            for each in gone:
                del self._recipes[each]
        return gone

    def taken(self) -> list[LaneFunction]:
        """Return and drop all."""
        with self._lock:
            gone, self._recipes = list(self._recipes), {}
        return gone


# Lane functions with keys: those that a compiled function holds, and the latest. Compiled programs are small and stay;
# jaxprs are large, and only those of the latest stay.
_alike: weakref.WeakValueDictionary = weakref.WeakValueDictionary()
_one_at_a_time = threading.Lock()
_latest, _with_programs = _Latest(512), _Latest(32)


def forget_programs() -> None:
    """Drop the jaxprs of lane functions with keys; their compiled programs stay."""
    for fn in _with_programs.taken():
        fn._programs.clear()
