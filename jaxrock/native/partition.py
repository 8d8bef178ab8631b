"""Programs of JAX in parts: what XLA computes, what is machine code, and the loop among that."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import jax
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun


class Part(NamedTuple):
    """Some operations of a program."""

    program: ClosedJaxpr

    @property
    def inputs(self) -> list:
        """The program's variables that it starts from."""
        return self.program.jaxpr.invars

    @property
    def outputs(self) -> list:
        """The variables that it gives."""
        return self.program.jaxpr.outvars


def _part(program: ClosedJaxpr, equations: list, outputs: list) -> Part:
    """The part of some operations, in order; `outputs`: variables that may be its inputs, too."""
    jaxpr = program.jaxpr
    made, constants = {v for equation in equations for v in equation.outvars}, set(jaxpr.constvars)
    used = [v for equation in equations for v in equation.invars] + outputs
    inputs = [v for v in used if not isinstance(v, Literal) and v not in made and v not in constants]
    # Arguments have no names here: JAX would compare their number.
    told = jaxpr.debug_info.with_unknown_names()
    cut = jaxpr.replace(invars=list(dict.fromkeys(inputs)), outvars=outputs, eqns=equations, debug_info=told)
    return Part(ClosedJaxpr(cut, program.consts))


def _needed(equations: list, outputs: list) -> dict:
    """Variables that operations, or results, start from."""
    used = [v for equation in equations for v in equation.invars] + outputs
    return dict.fromkeys(v for v in used if not isinstance(v, Literal))


def hoisted(program: ClosedJaxpr, is_left: Callable) -> ClosedJaxpr:
    """The program with its loops rid of what stays the same in all their turns, and `is_left` to XLA, with what that
    needs: it comes before the loops."""
    if not any(_to_hoist(equation, is_left) for equation in _loops(program.jaxpr)):
        return program

    def run(*leaves):
        return _run(program.jaxpr, program.consts, leaves, is_left)

    return jax.make_jaxpr(run)(*(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in program.in_avals))


def _loops(jaxpr) -> Iterator:
    """All loops of a program, and those in them."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "while":
            yield equation
            yield from _loops(equation.params["body_jaxpr"].jaxpr)


def _to_hoist(loop, is_left: Callable) -> list:
    """Operations of a loop that stay the same, and are left to XLA or needed for that."""
    body = loop.params["body_jaxpr"].jaxpr
    constant = set(body.invars[: loop.params["body_nconsts"]]) | set(body.constvars)
    same = []
    for equation in body.eqns:
        if equation.primitive.name != "while" and constant.issuperset(_needed([equation], [])):
            constant.update(equation.outvars)
            same.append(equation)
    found, needed = [], set()
    for equation in reversed(same):
        if needed.intersection(equation.outvars) or is_left(equation):
            found.append(equation)
            needed.update(_needed([equation], []))
    return found[::-1]


def _run(jaxpr, consts: list, leaves: Sequence, is_left: Callable) -> list:
    """Evaluate a program whose loops are rid of what is hoisted."""
    values = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *leaves]))

    def read(atom):
        return atom.val if isinstance(atom, Literal) else values[atom]

    for equation in jaxpr.eqns:
        given = [read(x) for x in equation.invars]
        if equation.primitive.name == "while":
            found = _run_loop(equation, given, is_left)
        else:
            part = _part(ClosedJaxpr(jaxpr.replace(constvars=[]), []), [equation], list(equation.outvars))
            found = jaxpr_as_fun(part.program)(*(values[v] for v in part.inputs))
        values.update(zip(equation.outvars, found))
    return [read(x) for x in jaxpr.outvars]


def _run_loop(loop, given: list, is_left: Callable) -> list:
    parameters, body = loop.params, loop.params["body_jaxpr"]
    more = _to_hoist(loop, is_left)
    rest = [equation for equation in body.jaxpr.eqns if equation not in more]
    passed = list(_needed(rest, body.jaxpr.outvars))
    out = [v for equation in more for v in equation.outvars if v in passed]
    n_cond, n_body = parameters["cond_nconsts"], parameters["body_nconsts"]
    consts, invars = given[n_cond : n_cond + n_body], body.jaxpr.invars
    part = _part(body, more, out)
    known = dict(zip(invars[:n_body], consts))
    found = jaxpr_as_fun(part.program)(*(known[v] for v in part.inputs))
    told = body.jaxpr.debug_info.with_unknown_names()
    variables = [*invars[:n_body], *out, *invars[n_body:]]
    shorter = ClosedJaxpr(body.jaxpr.replace(invars=variables, eqns=rest, debug_info=told), body.consts)
    inner = hoisted(shorter, is_left)
    changed = parameters | {"body_jaxpr": inner, "body_nconsts": n_body + len(out)}
    return loop.primitive.bind(*given[:n_cond], *consts, *found, *given[n_cond + n_body :], **changed)


def ahead(program: ClosedJaxpr, shared: list[bool], is_known: Callable, is_long: Callable) -> tuple[Part, Part, Part]:
    """What XLA computes first, of what all lanes share and of each lane's own; and the rest.

    All that lanes share is computed once. A lane's own is left to the rest, but for long arrays, and operations that
    are not known, with what they need; loops are in the rest, and what follows from it.
    """
    jaxpr = program.jaxpr
    needed = set()
    for equation in reversed(jaxpr.eqns):
        before = not is_known(equation) or needed.intersection(equation.outvars) or any(map(is_long, equation.outvars))
        if equation.primitive.name != "while" and before:
            needed.update(equation.outvars)
            needed.update(v for v in equation.invars if not isinstance(v, Literal))
    own = {v for v, same in zip(jaxpr.invars, shared, strict=True) if not same}
    parts, later = ([], [], []), set()
    for equation in jaxpr.eqns:
        inputs = {v for v in equation.invars if not isinstance(v, Literal)}
        if inputs & later or (inputs & own and not needed.intersection(equation.outvars)):
            later |= set(equation.outvars)
            parts[2].append(equation)
        elif inputs & own:
            own |= set(equation.outvars)
            parts[1].append(equation)
        else:
            parts[0].append(equation)
    for_rest = _needed(parts[2], jaxpr.outvars)

    def results(part, needed):
        return [v for equation in part for v in equation.outvars if v in needed]

    first = _part(program, parts[0], results(parts[0], for_rest | _needed(parts[1], [])))
    second = _part(program, parts[1], results(parts[1], for_rest))
    return first, second, _part(program, parts[2], list(jaxpr.outvars))


def around_loop(part: Part) -> list[Part]:
    """What comes before the one loop of a part, the loop, and what comes after it; or the whole, if that is not so."""
    program, equations = part.program, part.program.jaxpr.eqns
    places = [i for i, equation in enumerate(equations) if equation.primitive.name == "while"]
    if len(places) != 1:
        return [part]
    before, loop, after = equations[: places[0]], equations[places[0]], equations[places[0] + 1 :]
    made = [v for equation in before for v in equation.outvars]
    needed = _needed([loop, *after], part.outputs)
    parts = [_part(program, before, [v for v in made if v in needed])] if before else []
    parts.append(_part(program, [loop], list(loop.outvars)))
    return [*parts, _part(program, after, part.outputs)] if after or part.outputs != loop.outvars else parts


def computed(part: Part, values: dict, batched: bool) -> None:
    """Add the results of a part to the values of variables; `batched`: with a leading axis of lanes."""
    if part.outputs:
        function = jaxpr_as_fun(part.program)
        given = [values[v] for v in part.inputs]
        if batched:
            axes = [0 if values[v].ndim > len(v.aval.shape) else None for v in part.inputs]
            function = jax.vmap(function, in_axes=axes)
        values.update(zip(part.outputs, function(*given), strict=True))
