"""Loops rid of what stays the same in all their turns, where machine code cannot do it: XLA computes it before them."""

from collections.abc import Callable, Sequence
from typing import Any

from jax.extend.core import ClosedJaxpr, Literal, Var

from jaxrock.native.partition import needed_by


def hoisted(program: ClosedJaxpr, is_left: Callable, constants: Sequence[int] = ()) -> ClosedJaxpr:
    """The program with what stays the same in its loops, and `is_left` to what is before them, with what that needs.

    `constants`: places of its inputs that stay the same in all turns of a loop around it: what only depends on these
    comes out of the cases of its conditions, too.
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
    """A program that is written anew: operations of those within it may come to stand before them."""

    def __init__(self, program: ClosedJaxpr):
        self._old, self.equations = program, []
        self._known = dict(zip(program.jaxpr.constvars, program.consts, strict=True))

    @property
    def program(self) -> ClosedJaxpr:
        """As far as it is written."""
        new = self._old.jaxpr.replace(eqns=self.equations, constvars=list(self._known))
        return ClosedJaxpr(new, list(self._known.values()))

    def take(self, program: ClosedJaxpr, more: list, given: dict) -> tuple[list, list]:
        """Take some operations out of a program within: variables in it that they make for the rest of it, and what
        these are here. `given`: what its inputs are here."""
        names = dict(given)
        for variable, value in zip(program.jaxpr.constvars, program.consts, strict=True):
            if variable in needed_by(more, []):
                names[variable] = Var(variable.aval)
                self._known[names[variable]] = value
        for equation in more:
            # A program may stand at many places: what it makes has another name at each.
            names.update((v, Var(v.aval)) for v in equation.outvars)
            inputs = [x if isinstance(x, Literal) else names[x] for x in equation.invars]
            self.equations.append(equation.replace(invars=inputs, outvars=[names[v] for v in equation.outvars]))
        rest = [equation for equation in program.jaxpr.eqns if equation not in more]
        passed = needed_by(rest, program.jaxpr.outvars)
        made = [v for equation in more for v in equation.outvars if v in passed]
        return made, [names[v] for v in made]


def _has_any(jaxpr, constant: set, is_left: Callable, inside: bool = False) -> bool:
    """Return whether there is anything to hoist: of what is within a program, or of all, if it is `inside` another."""
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
    """Operations that only depend on what is constant, and all that is."""
    constant, same = set(constant), []
    for equation in jaxpr.eqns:
        inputs = [x for x in equation.invars if not isinstance(x, Literal)]
        if equation.primitive.name != "while" and constant.issuperset(inputs):
            constant.update(equation.outvars)
            same.append(equation)
    return same, constant


def _to_hoist(jaxpr, constant: set, is_left: Callable) -> list:
    """Operations that only depend on what is constant, and are left to XLA or needed for that."""
    found, needed = [], set()
    for equation in reversed(_same(jaxpr, constant)[0]):
        if needed.intersection(equation.outvars) or is_left(equation):
            found.append(equation)
            needed.update(needed_by([equation], []))
    return found[::-1]


def _places(equation, constant: set) -> list[int]:
    """Places of the operands of a condition's cases that are constant."""
    return [k for k, x in enumerate(equation.invars[1:]) if isinstance(x, Literal) or x in constant]


def _variables(program: ClosedJaxpr, places: Sequence[int]) -> set:
    """What is constant at the start of a program, of which these inputs are."""
    return {program.jaxpr.invars[place] for place in places} | set(program.jaxpr.constvars)


def _without(program: ClosedJaxpr, more: list, inputs: list) -> ClosedJaxpr:
    """A program without some operations, with other inputs."""
    rest: Any = [equation for equation in program.jaxpr.eqns if equation not in more]
    told = program.jaxpr.debug_info.with_unknown_names()  # JAX would compare their number
    return ClosedJaxpr(program.jaxpr.replace(invars=inputs, eqns=rest, debug_info=told), program.consts)


def _loop(loop, around: _Around, is_left: Callable):
    """A loop rid of what is hoisted out of it, which comes before it."""
    n_cond, n_body = loop.params["cond_nconsts"], loop.params["body_nconsts"]
    body = hoisted(loop.params["body_jaxpr"], is_left, range(n_body))
    first, rest, constants = loop.invars[: n_cond + n_body], loop.invars[n_cond + n_body :], body.jaxpr.invars[:n_body]
    more = _to_hoist(body.jaxpr, set(constants) | set(body.jaxpr.constvars), is_left)
    made, here = around.take(body, more, dict(zip(constants, first[n_cond:])))
    body = _without(body, more, [*constants, *made, *body.jaxpr.invars[n_body:]])
    changed = loop.params | {"body_jaxpr": body, "body_nconsts": n_body + len(made)}
    return loop.replace(invars=[*first, *here, *rest], params=changed)


def _cases(condition, around: _Around, constant: set, is_left: Callable):
    """A condition rid of what is hoisted out of its cases, which comes before it."""
    places, branches = _places(condition, constant), []
    for branch in condition.params["branches"]:
        branch = hoisted(branch, is_left, places)
        more = _to_hoist(branch.jaxpr, _variables(branch, places), is_left)
        made, here = around.take(branch, more, dict(zip(branch.jaxpr.invars, condition.invars[1:])))
        branches.append((branch, more, made, here))
    all_made = [v for _, _, made, _ in branches for v in made]
    changed = []
    for branch, more, made, _ in branches:  # every case is given what any of them needs
        inputs = [v if v in made else Var(v.aval) for v in all_made]
        changed.append(_without(branch, more, [*branch.jaxpr.invars, *inputs]))
    given = [x for *_, here in branches for x in here]
    return condition.replace(invars=[*condition.invars, *given], params=condition.params | {"branches": tuple(changed)})
