"""Partition jaxprs: the parts for XLA, the parts for machine code, and the loop among the latter."""

from collections.abc import Callable
from typing import NamedTuple

import jax
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun

from jaxrock.compiler.jaxpr.traverse import following


class Part(NamedTuple):
    """Some equations of a jaxpr as a jaxpr of their own, in the variables of the original one."""

    program: ClosedJaxpr

    @property
    def inputs(self) -> list:
        """Variables of the whole jaxpr that the part reads."""
        return self.program.jaxpr.invars

    @property
    def outputs(self) -> list:
        """Variables of the whole jaxpr that the part returns."""
        return self.program.jaxpr.outvars


def part_of(program: ClosedJaxpr, equations: list, outputs: list) -> Part:
    """Return the part made of these equations, in order; `outputs` may contain inputs of the part."""
    jaxpr = program.jaxpr
    made, constants = {v for equation in equations for v in equation.outvars}, set(jaxpr.constvars)
    used = needed_by(equations, outputs)
    inputs = [v for v in used if v not in made and v not in constants]
    consts = [(v, x) for v, x in zip(jaxpr.constvars, program.consts, strict=True) if v in used]
    # Drop the argument names: JAX checks that their number is the number of inputs.
    told = jaxpr.debug_info.with_unknown_names()
    known = [v for v, _ in consts]
    cut = jaxpr.replace(constvars=known, invars=inputs, outvars=outputs, eqns=equations, debug_info=told)
    return Part(ClosedJaxpr(cut, [x for _, x in consts]))


def needed_by(equations: list, outputs: list) -> dict:
    """Return the variables that equations read or that are outputs, as the keys of a dict, in order."""
    used = [v for equation in equations for v in equation.invars] + outputs
    return dict.fromkeys(v for v in used if not isinstance(v, Literal))


class Parts(NamedTuple):
    """A jaxpr in four parts, in the order in which they run.

    - `first`: values that all points share and XLA computes.
    - `once`: values that all points share and machine code computes.
    - `each`: values that differ between points and XLA computes.
    - `rest`: all else, which machine code computes.
    """

    first: Part
    once: Part
    each: Part
    rest: Part


def ahead(program: ClosedJaxpr, shared: list[bool], is_known: Callable, is_long: Callable) -> Parts:
    """Partition a jaxpr into the parts that XLA and machine code compute, in the order in which they run.

    `shared` holds one flag per input, `is_known` takes an equation and `is_long` a variable. XLA computes long arrays,
    unsupported operations, and all operands that these need. Loops over values that differ between points, and all
    that depends on them, stay in `rest`.
    """
    jaxpr = program.jaxpr
    own = {v for v, same in zip(jaxpr.invars, shared, strict=True) if not same}
    needed, moving = set(), following(jaxpr, own)
    for equation in reversed(jaxpr.eqns):
        before = not is_known(equation) or needed.intersection(equation.outvars) or any(map(is_long, equation.outvars))
        is_loop = equation.primitive.name == "while" and moving.intersection(equation.outvars)
        if before and not is_loop:
            needed.update(equation.outvars)
            needed.update(v for v in equation.invars if not isinstance(v, Literal))
    first, once, each, rest, later = [], [], [], [], set()
    for equation in jaxpr.eqns:
        inputs = {v for v in equation.invars if not isinstance(v, Literal)}
        is_needed = bool(needed.intersection(equation.outvars))
        if inputs & later or (inputs & own and not is_needed):
            later |= set(equation.outvars)
            rest.append(equation)
        elif inputs & own:
            own |= set(equation.outvars)
            each.append(equation)
        else:
            (first if is_needed else once).append(equation)
    made, wanted = [part_of(program, rest, list(jaxpr.outvars))], needed_by(rest, jaxpr.outvars)
    for equations in (each, once, first):
        outputs = [v for equation in equations for v in equation.outvars if v in wanted]
        made.append(part_of(program, equations, outputs))
        wanted |= needed_by(equations, [])
    return Parts(*reversed(made))


def around_loop(part: Part) -> list[Part]:
    """Split a part at its only loop: the equations before it, the loop, those after it; the whole part without one."""
    program, equations = part.program, part.program.jaxpr.eqns
    places = [i for i, equation in enumerate(equations) if equation.primitive.name == "while"]
    if len(places) != 1:
        return [part]
    before, loop, after = equations[: places[0]], equations[places[0]], equations[places[0] + 1 :]
    made = [v for equation in before for v in equation.outvars]
    needed = needed_by([loop, *after], part.outputs)
    parts = [part_of(program, before, [v for v in made if v in needed])] if before else []
    parts.append(part_of(program, [loop], list(loop.outvars)))
    return [*parts, part_of(program, after, part.outputs)] if after or part.outputs != loop.outvars else parts


def computed(part: Part, values: dict, batched: bool) -> None:
    """Evaluate a part and add its results to `values`, by variable; `batched`: along a leading axis of points."""
    if part.outputs:
        function = jaxpr_as_fun(part.program)
        given = [values[v] for v in part.inputs]
        if batched:
            axes = [0 if values[v].ndim > len(v.aval.shape) else None for v in part.inputs]
            function = jax.vmap(function, in_axes=axes)
        values.update(zip(part.outputs, function(*given), strict=True))
