"""Turn counted scans into while loops: JAX traces counted loops as scans; this compiler takes while loops."""

from typing import Any

import jax
from jax import lax
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun

from jaxrock.compiler.jaxpr.traverse import programs_of, with_programs


def scan_to_while(program: ClosedJaxpr) -> ClosedJaxpr:
    """Return the jaxpr with while loops in place of scans that neither read nor stack rows (`jax.lax.fori_loop`).

    JAX's reverse mode does not differentiate while loops.
    """
    if not _has_counted(program.jaxpr):
        return program
    return ClosedJaxpr(_with_loops(program.jaxpr), program.consts)


def _has_counted(jaxpr: Any) -> bool:
    return any(_is_counted(each) or any(map(_has_counted, programs_of(each))) for each in jaxpr.eqns)


def _is_counted(equation: Any) -> bool:
    """Return whether an equation is a scan without rows.

    Then all its operands and results have the ranks that they have in its body. Versions of JAX state the number of
    carried values in different ways, and the ranks avoid them.
    """
    if equation.primitive.name != "scan" or equation.params["jaxpr"].consts:
        return False
    turn = equation.params["jaxpr"]
    pairs = [*zip(equation.invars, turn.in_avals, strict=True), *zip(equation.outvars, turn.out_avals, strict=True)]
    return all(len(x.aval.shape) == len(within.shape) for x, within in pairs)


def _with_loops(jaxpr: Any) -> Any:
    found: dict[Any, Any] = {}  # {result of a scan: result of its loop}
    equations = []
    for equation in jaxpr.eqns:
        equation = with_programs(equation, _with_loops)
        equation = equation.replace(invars=_renamed(equation.invars, found))
        if not _is_counted(equation):
            equations.append(equation)
            continue
        made = _loop(equation)
        given = dict(zip(made.invars, equation.invars, strict=True))
        equations += [each.replace(invars=_renamed(each.invars, given)) for each in made.eqns]
        found.update(zip(equation.outvars, _renamed(made.outvars, given), strict=True))
    return jaxpr.replace(eqns=equations, outvars=_renamed(jaxpr.outvars, found))


def _renamed(variables: list, names: dict) -> list:
    return [x if isinstance(x, Literal) else names.get(x, x) for x in variables]


def _loop(equation: Any) -> Any:
    """Trace a while loop that is equivalent to a scan without rows."""
    turns, count = equation.params["length"], len(equation.invars) - len(equation.outvars)  # constants come first
    turn = jaxpr_as_fun(equation.params["jaxpr"])

    def run(*operands):
        def once_more(carry):
            done, state = carry
            return done + 1, turn(*operands[:count], *state)

        return lax.while_loop(lambda carry: carry[0] < turns, once_more, (0, list(operands[count:])))[1]

    return jax.make_jaxpr(run)(*(x.aval for x in equation.invars)).jaxpr
