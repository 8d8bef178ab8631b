"""Loops rid of what stays the same in all their turns, where machine code cannot do it: XLA computes it before them."""

from collections.abc import Callable, Sequence

import jax
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun

from jaxrock.native.partition import needed_by, part_of


def hoisted(program: ClosedJaxpr, is_left: Callable, constants: Sequence[int] = ()) -> ClosedJaxpr:
    """The program with what stays the same in its loops, and `is_left` to what is before them, with what that needs.

    `constants`: places of its inputs that stay the same in all turns of a loop around it: what only depends on these
    comes out of the cases of its conditions, too.
    """
    constant = {program.jaxpr.invars[place] for place in constants} | set(program.jaxpr.constvars)
    if not _has_any(program.jaxpr, constant, is_left):
        return program

    def run(*leaves):
        return _run(program, leaves, constant, is_left)

    return jax.make_jaxpr(run)(*(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in program.in_avals))


def _has_any(jaxpr, constant: set, is_left: Callable) -> bool:
    """Whether there is anything to hoist."""
    constant = constant | _same(jaxpr, constant)[1]
    for equation in jaxpr.eqns:
        inner = []
        if equation.primitive.name == "while":
            body, count = equation.params["body_jaxpr"].jaxpr, equation.params["body_nconsts"]
            inner = [(body, set(body.invars[:count]) | set(body.constvars))]
        if equation.primitive.name == "cond" and constant:
            branches = equation.params["branches"]
            inner = [(x.jaxpr, _variables(x, _places(equation, constant))) for x in branches]
        if any(_to_hoist(x, same, is_left) or _has_any(x, same, is_left) for x, same in inner):
            return True
    return False


def _same(jaxpr, constant: set) -> tuple[list, set]:
    """Operations that only depend on what is constant, and all that is."""
    constant, same = set(constant), []
    for equation in jaxpr.eqns:
        if equation.primitive.name != "while" and constant.issuperset(needed_by([equation], [])):
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


def _run(program: ClosedJaxpr, leaves: Sequence, constant: set, is_left: Callable) -> list:
    """Evaluate a program, its loops and conditions rid of what is hoisted."""
    jaxpr, constant = program.jaxpr, constant | _same(program.jaxpr, constant)[1]
    values = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*program.consts, *leaves]))

    def read(atom):
        return atom.val if isinstance(atom, Literal) else values[atom]

    for equation in jaxpr.eqns:
        given = [read(x) for x in equation.invars]
        if equation.primitive.name == "while":
            found = _run_loop(equation, given, is_left)
        elif equation.primitive.name == "cond" and constant:
            found = _run_cases(equation, given, constant, is_left)
        else:
            part = part_of(program, [equation], list(equation.outvars))
            found = jaxpr_as_fun(part.program)(*(values[v] for v in part.inputs))
        values.update(zip(equation.outvars, found))
    return [read(x) for x in jaxpr.outvars]


def _without(program: ClosedJaxpr, more: list, given: dict, place: int) -> tuple[ClosedJaxpr, list]:
    """A program without some operations, whose results it takes as inputs at a place, and these results."""
    jaxpr = program.jaxpr
    rest = [equation for equation in jaxpr.eqns if equation not in more]
    passed = needed_by(rest, jaxpr.outvars)
    out = [v for equation in more for v in equation.outvars if v in passed]
    part = part_of(program, more, out)
    found = jaxpr_as_fun(part.program)(*(given[v] for v in part.inputs)) if out else []
    inputs = [*jaxpr.invars[:place], *out, *jaxpr.invars[place:]]
    told = jaxpr.debug_info.with_unknown_names()
    return ClosedJaxpr(jaxpr.replace(invars=inputs, eqns=rest, debug_info=told), program.consts), found


def _run_loop(loop, given: list, is_left: Callable) -> list:
    """A loop, and before it what is hoisted out of it."""
    parameters = loop.params
    n_cond, n_body = parameters["cond_nconsts"], parameters["body_nconsts"]
    body, consts = hoisted(parameters["body_jaxpr"], is_left, range(n_body)), given[n_cond : n_cond + n_body]
    constants = body.jaxpr.invars[:n_body]
    more = _to_hoist(body.jaxpr, set(constants) | set(body.jaxpr.constvars), is_left)
    body, found = _without(body, more, dict(zip(constants, consts)), n_body)
    changed = parameters | {"body_jaxpr": body, "body_nconsts": n_body + len(found)}
    return loop.primitive.bind(*given[:n_cond], *consts, *found, *given[n_cond + n_body :], **changed)


def _run_cases(equation, given: list, constant: set, is_left: Callable) -> list:
    """A condition, and before it what is hoisted out of its cases."""
    which, *operands = given
    branches, found, places = [], [], _places(equation, constant)
    for branch in equation.params["branches"]:
        branch = hoisted(branch, is_left, places)
        more = _to_hoist(branch.jaxpr, _variables(branch, places), is_left)
        values = dict(zip(branch.jaxpr.invars, operands))
        branches.append(_without(branch, more, values, len(branch.jaxpr.invars)))
        found += branches[-1][1]

    def case(number):
        program, own = branches[number]
        before = sum(len(each) for _, each in branches[:number])
        places = slice(len(operands) + before, len(operands) + before + len(own))
        return lambda *all_: jaxpr_as_fun(program)(*all_[: len(operands)], *all_[places])

    return jax.lax.switch(which, [case(number) for number in range(len(branches))], *operands, *found)
