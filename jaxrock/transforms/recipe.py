"""What is computed of one scene: a function as a whole, in parts, and with its derivatives, as a thing with a name."""

import functools
import threading
import weakref
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.interpreters import partial_eval

from jaxrock._settings import under_usual_settings
from jaxrock._undisturbed import undisturbed
from jaxrock.keeping.facts import settings
from jaxrock.keeping.folder import name_of
from jaxrock.numerics.xla_cpu import are_marked, marking
from jaxrock.transforms.fingerprint import Program
from jaxrock.transforms.turns import as_loops

Derivatives = Literal["at once", "a few at once", "by directions", "in a direction", "on a tape"]


class Passes(NamedTuple):
    """A function of one scene in parts.

    - `begin(tree)`: the scene as the other parts take it, and a first state.
    - `quickly(scene, state, limit)`: the state where it is finished or given up, or after `limit` steps in all; None:
      there is no quick pass.
    - `carefully(scene, state)`: the state where it is finished.
    - `unfinished(scene, state)`: whether the quick pass has to go on.
    - `conclude(scene, state)`: the result, and whether the quick pass has postponed it to the careful one.
    - `round`: steps after which chunks are made up anew of the scenes that are unfinished; None: never.
    """

    begin: Callable
    quickly: Callable | None
    carefully: Callable
    unfinished: Callable | None
    conclude: Callable
    round: int | None

    def whole(self, tree):
        """The function, by the careful pass."""
        scene, state = self.begin(tree)
        return self.conclude(scene, self.carefully(scene, state))[0]

    def at_once(self, tree):
        """The result of the quick pass, and whether it is postponed."""
        scene, state = self.begin(tree)
        return self.conclude(scene, self.quickly(scene, state, jnp.iinfo(jnp.int32).max))


class Recipe:
    """A function of one scene: `function(tree)`, of a tree with leaves `like` these (`jax.ShapeDtypeStruct`).

    - `passes`: the same in parts, where machine code of our own may run it.
    - `on_tape`: the same, through whose own code reverse mode goes; for derivatives by very many numbers.
    - `facts`: what tells it, with its leaves' shapes, from all others in any process; None: only its program does.
    - `results`: what it returns, a tree of `jax.ShapeDtypeStruct`; None: tracing tells.
    - `in_lanes`, `refilled`: whether machine code may run it, and refill the lanes of its loop.
    - `order`: of the derivatives that it computes.
    - `derivatives`: how forward mode makes more of them: value and Jacobian at once (by more than eight numbers a few
      directions at a time); the same, but by many numbers, where the Jacobian would be too large, value and change in
      one direction; the Jacobian by directions, which are scenes of their own, as of all that computes derivatives
      already; value and change in one direction alone, which does not transpose; or the change alone, which does, since
      reverse mode goes through the function's code.
    - `directions`: how many of the last leaves are the direction of a change that it computes; that of what, by which
      leaves, is told by `origin`.
    """

    def __init__(
        self,
        function: Callable,
        structure: Any,
        like: Sequence[jax.ShapeDtypeStruct],
        passes: Passes | None = None,
        on_tape: Callable | None = None,
        facts: str | None = None,
        results: Any = None,
        in_lanes: bool = False,
        refilled: bool = False,
        order: int = 0,
        derivatives: Derivatives = "at once",
        directions: int = 0,
        origin: "tuple[Recipe, tuple[bool, ...]] | None" = None,
    ):
        self.function, self.structure, self.like, self.order = function, structure, tuple(like), order
        self.passes, self.on_tape, self.facts, self._results = passes, on_tape, facts, results
        self.in_lanes, self.refilled = in_lanes or passes is not None, refilled or bool(passes and passes.round)
        self.derivatives, self.directions, self.origin = derivatives, directions, origin
        self.plans, self._derivatives, self._programs = {}, {}, {}  # what has been made of it

    @classmethod
    def of(cls, function: Callable, structure: Any, like: Sequence, facts: str | None, **rest: Any) -> "Recipe":
        """A recipe; the one that there is of a function with the same facts, with all that has been made of it."""
        if facts is None:
            return cls(function, structure, like, **rest)
        key = facts, tuple((x.shape, x.dtype) for x in like), structure, settings()
        with _one_at_a_time:
            recipe = _alike.get(key)
            if recipe is None:
                recipe = _alike[key] = cls(function, structure, like, facts=facts, **rest)
        _latest.note(recipe)
        return recipe

    def _traced(self, quick: bool) -> tuple[ClosedJaxpr, Any]:
        key = quick, are_marked()
        found = self._programs.get(key)
        if found is None:
            found = self._programs[key] = self._trace(self.passes.at_once if quick and self.passes else self.function)
        if self.facts is not None:  # else it may hold what is traced only once
            for recipe in _with_programs.note(self):
                recipe._programs.clear()
        return found

    @undisturbed
    @under_usual_settings
    def _trace(self, function: Callable) -> tuple[ClosedJaxpr, Any]:
        # Outside of any mesh: Equinox compares the types of arguments when it differentiates the solves of Diffrax, and
        # takes those that tell of the mesh of a `shard_map`, and those that do not, for different ones.
        with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())):
            made = jax.make_jaxpr(lambda *x: function(self.structure.unflatten(x)), return_shape=True)
            program, shapes = made(*self.like)
        needed, _ = partial_eval.dce_jaxpr(program.jaxpr, [True] * len(program.jaxpr.outvars), instantiate=True)
        program = ClosedJaxpr(needed, program.consts)
        return (program if self.derivatives == "on a tape" else as_loops(program)), shapes

    @property
    def program(self) -> ClosedJaxpr:
        """The function as JAX traces it, from leaves to leaves, without what nobody needs; with marks for XLA on CPUs
        (`numerics.xla_cpu`) where there are any now."""
        return self._traced(quick=False)[0]

    @property
    def quick(self) -> ClosedJaxpr | None:
        """The quick pass, from leaves to leaves; the last tells whether it is postponed."""
        return self._traced(quick=True)[0] if self.passes and self.passes.quickly else None

    @property
    def results(self) -> Any:
        """What it returns, a tree of `jax.ShapeDtypeStruct`."""
        if self._results is None:
            self._results = self._first[1]
        return self._results

    @property
    def _first(self) -> tuple[ClosedJaxpr, Any]:
        """Traced before it is known for what: as it will most likely be wanted, machine code needs no marks."""
        with marking(are_marked() and not self.in_lanes):
            return self._traced(quick=False)

    @property
    def holds_traced(self) -> bool:
        """Return whether its function holds traced values of what is around it."""
        return self.facts is None and any(isinstance(x, jax.core.Tracer) for x in self._first[0].consts)

    def __call__(self, leaves: Sequence) -> list:
        """Compute it for one scene."""
        return jaxpr_as_fun(self.program)(*leaves)

    @functools.cached_property
    def taped(self) -> "Recipe":
        """The same on a tape."""
        assert self.on_tape is not None
        facts = None if self.facts is None else f"{self.facts} on tape"
        return Recipe(
            self.on_tape, self.structure, self.like, facts=facts, results=self.results, derivatives="on a tape"
        )

    def derivative(self, moves: tuple[bool, ...], make: Callable, *settings: int) -> "Recipe":
        """The recipe of value and derivatives by some leaves, which `make(recipe, moves, *settings)` makes once."""
        key = make, moves, settings
        if key not in self._derivatives:
            self._derivatives[key] = make(self, moves, *settings)
        return self._derivatives[key]

    @functools.cached_property
    def name(self) -> str:
        """What tells it from others in the text of programs."""
        if self.facts is not None:
            return name_of(self.facts)
        return Program(self.program.jaxpr, None, ()).fingerprint(self.program.consts)

    def __repr__(self) -> str:
        return f"recipe {self.name}"


class _Latest:
    """The latest so many recipes of any threads."""

    def __init__(self, most: int):
        self._most, self._recipes, self._lock = most, dict[Recipe, None](), threading.Lock()

    def note(self, recipe: Recipe) -> list[Recipe]:
        """Those that are among the latest no more, now that this one is."""
        with self._lock:
            self._recipes.pop(recipe, None)
            self._recipes[recipe] = None
            gone = list(self._recipes)[: -self._most]
            for each in gone:
                del self._recipes[each]
        return gone

    def taken(self) -> list[Recipe]:
        """All of them, which it holds no more."""
        with self._lock:
            gone, self._recipes = list(self._recipes), {}
        return gone


# Recipes with facts: those that a compiled function holds, and the latest. What was made of them is small, and stays
# with them; their programs are large, and only the latest stay.
_alike: weakref.WeakValueDictionary = weakref.WeakValueDictionary()
_one_at_a_time = threading.Lock()
_latest, _with_programs = _Latest(512), _Latest(32)


def forget_programs() -> None:
    """Forget what has been traced of recipes with facts; what was made of it stays."""
    for recipe in _with_programs.taken():
        recipe._programs.clear()
