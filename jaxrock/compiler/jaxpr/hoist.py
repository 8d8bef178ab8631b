"""Hoist loop-invariant equations out of loops where a predicate asks for it: they run once, before the loop."""

from collections.abc import Callable, Sequence
from typing import Any

from jax.extend.core import ClosedJaxpr, Literal, Var

from jaxrock.compiler.jaxpr.partition import needed_by


def hoist(program: ClosedJaxpr, is_left: Callable, constants: Sequence[int] = ()) -> ClosedJaxpr:
    """Return the jaxpr with loop-invariant equations before its loops: where `is_left(equation)`, and their operands.

    `constants` are the positions of inputs that are invariant in a loop around the jaxpr. Equations that depend on
    these only move out of the branches of its conditions, too.
    """
    constant = {program.jaxpr.invars[place] for place in constants} | set(program.jaxpr.constvars)
    if not _has_any(program.jaxpr, constant, is_left):
        return program
    around = _Around(program)
    constant |= _same(program.jaxpr, constant)[1]
    for equation in program.jaxpr.eqns:
        if equation.primitive.name == "while":
            equation = _loop(equation, around, is_left)
        elif equation.primitive.name == "cond" and constant:
            equation = _cases(equation, around, constant, is_left)
        around.equations.append(equation)
    return around.program


class _Around:
    """A jaxpr under reconstruction, into which equations of its inner jaxprs may move."""

    def __init__(self, program: ClosedJaxpr):
        self._old, self.equations = program, []
        self._known = dict(zip(program.jaxpr.constvars, program.consts, strict=True))

    @property
    def program(self) -> ClosedJaxpr:
        """The jaxpr as rebuilt so far."""
        new = self._old.jaxpr.replace(eqns=self.equations, constvars=list(self._known))
        return ClosedJaxpr(new, list(self._known.values()))

    def take(self, program: ClosedJaxpr, more: list, given: dict) -> tuple[list, list]:
        """Move the equations `more` of an inner jaxpr to the end of this one.

        `given` maps inputs of the inner jaxpr to atoms of this one. Return the moved results that the rest of the
        inner jaxpr reads, as variables of the inner jaxpr and of this one.
        """
        names = dict(given)
        for variable, value in zip(program.jaxpr.constvars, program.consts, strict=True):
            if variable in needed_by(more, []):
                names[variable] = Var(variable.aval)
                self._known[names[variable]] = value
        for equation in more:
            # Two equations may share one inner jaxpr, so the results need new variables at each.
            names.update((v, Var(v.aval)) for v in equation.outvars)
            inputs = [x if isinstance(x, Literal) else names[x] for x in equation.invars]
            self.equations.append(equation.replace(invars=inputs, outvars=[names[v] for v in equation.outvars]))
        rest = [equation for equation in program.jaxpr.eqns if equation not in more]
        passed = needed_by(rest, program.jaxpr.outvars)
        made = [v for equation in more for v in equation.outvars if v in passed]
        return made, [names[v] for v in made]


def _has_any(jaxpr, constant: set, is_left: Callable, inside: bool = False) -> bool:
    """Return whether any equation can move: out of the inner jaxprs, or also out of this one if it is `inside`."""
    same, constant = _same(jaxpr, constant)
    if inside and any(map(is_left, same)):
        return True
    for equation in jaxpr.eqns:
        inner = []
        if equation.primitive.name == "while":
            body, count = equation.params["body_jaxpr"].jaxpr, equation.params["body_nconsts"]
            inner = [(body, set(body.invars[:count]) | set(body.constvars))]
        if equation.primitive.name == "cond" and constant:
            branches = equation.params["branches"]
            inner = [(x.jaxpr, _variables(x, _places(equation, constant))) for x in branches]
        if any(_has_any(x, known, is_left, True) for x, known in inner):
            return True
    return False


def _same(jaxpr, constant: set) -> tuple[list, set]:
    """Return the equations, but for loops, that depend on constants only, and the set of all constant variables."""
    constant, same = set(constant), []
    for equation in jaxpr.eqns:
        inputs = [x for x in equation.invars if not isinstance(x, Literal)]
        if equation.primitive.name != "while" and constant.issuperset(inputs):
            constant.update(equation.outvars)
            same.append(equation)
    return same, constant


def _to_hoist(jaxpr, constant: set, is_left: Callable) -> list:
    """Return the constant equations for which `is_left` holds, and those that they need, in order."""
    found, needed = [], set()
    for equation in reversed(_same(jaxpr, constant)[0]):
        if needed.intersection(equation.outvars) or is_left(equation):
            found.append(equation)
            needed.update(needed_by([equation], []))
    return found[::-1]


def _places(equation, constant: set) -> list[int]:
    """Return the positions of constant operands among those of a condition's branches."""
    return [k for k, x in enumerate(equation.invars[1:]) if isinstance(x, Literal) or x in constant]


def _variables(program: ClosedJaxpr, places: Sequence[int]) -> set:
    """Return the inputs of a jaxpr at these positions, and its constants."""
    return {program.jaxpr.invars[place] for place in places} | set(program.jaxpr.constvars)


def _without(program: ClosedJaxpr, more: list, inputs: list) -> ClosedJaxpr:
    """Return a jaxpr without the equations `more`, with other inputs."""
    rest: Any = [equation for equation in program.jaxpr.eqns if equation not in more]
    told = program.jaxpr.debug_info.with_unknown_names()  # JAX checks the number of names
    return ClosedJaxpr(program.jaxpr.replace(invars=inputs, eqns=rest, debug_info=told), program.consts)


def _loop(loop, around: _Around, is_left: Callable):
    """Return a loop without the equations that move out of its body to `around`."""
    n_cond, n_body = loop.params["cond_nconsts"], loop.params["body_nconsts"]
    body = hoist(loop.params["body_jaxpr"], is_left, range(n_body))
    first, rest, constants = loop.invars[: n_cond + n_body], loop.invars[n_cond + n_body :], body.jaxpr.invars[:n_body]
    more = _to_hoist(body.jaxpr, set(constants) | set(body.jaxpr.constvars), is_left)
    made, here = around.take(body, more, dict(zip(constants, first[n_cond:])))
    body = _without(body, more, [*constants, *made, *body.jaxpr.invars[n_body:]])
    changed = loop.params | {"body_jaxpr": body, "body_nconsts": n_body + len(made)}
    return loop.replace(invars=[*first, *here, *rest], params=changed)


def _cases(condition, around: _Around, constant: set, is_left: Callable):
    """Return a condition without the equations that move out of its branches to `around`."""
    places, branches = _places(condition, constant), []
    for branch in condition.params["branches"]:
        branch = hoist(branch, is_left, places)
        more = _to_hoist(branch.jaxpr, _variables(branch, places), is_left)
        made, here = around.take(branch, more, dict(zip(branch.jaxpr.invars, condition.invars[1:])))
        branches.append((branch, more, made, here))
    all_made = [v for _, _, made, _ in branches for v in made]
    changed = []
    for branch, more, made, _ in branches:  # all branches must take the same operands
        inputs = [v if v in made else Var(v.aval) for v in all_made]
        changed.append(_without(branch, more, [*branch.jaxpr.invars, *inputs]))
    given = [x for *_, here in branches for x in here]
    return condition.replace(invars=[*condition.invars, *given], params=condition.params | {"branches": tuple(changed)})
