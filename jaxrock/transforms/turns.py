"""Loops of a known number of turns: JAX makes scans of them, and derivatives and machine code of our own know loops."""

from typing import Any

import jax
from jax import lax
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun

from jaxrock._programs import programs_of


def as_loops(program: ClosedJaxpr) -> ClosedJaxpr:
    """The same program; its scans that neither take nor make rows (`jax.lax.fori_loop`) are loops, which reverse mode
    does not go through."""
    if not _has_counted(program.jaxpr):
        return program
    return ClosedJaxpr(_with_loops(program.jaxpr), program.consts)


def _has_counted(jaxpr: Any) -> bool:
    return any(_is_counted(each) or any(map(_has_counted, programs_of(each))) for each in jaxpr.eqns)


def _is_counted(equation: Any) -> bool:
    """Return whether it is a scan without rows: all that it takes and makes is as within. (How JAX tells how many are
    carried differs from version to version.)"""
    if equation.primitive.name != "scan" or equation.params["jaxpr"].consts:
        return False
    turn = equation.params["jaxpr"]
    pairs = [*zip(equation.invars, turn.in_avals, strict=True), *zip(equation.outvars, turn.out_avals, strict=True)]
    return all(len(x.aval.shape) == len(within.shape) for x, within in pairs)


def _with_loops(jaxpr: Any) -> Any:
    found: dict[Any, Any] = {}  # what loops make, by the variables of the scans
    equations = []
    for equation in jaxpr.eqns:
        parameters = {name: _inside(value) for name, value in equation.params.items()}
        equation = equation.replace(invars=_renamed(equation.invars, found), params=parameters)
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


def _inside(value: Any) -> Any:
    """A parameter of an operation, where it is a program, or some."""
    if isinstance(value, (tuple, list)):
        return type(value)(map(_inside, value)) if any(map(_is_program, value)) else value
    if isinstance(value, ClosedJaxpr):
        return as_loops(value)
    return _with_loops(value) if _is_program(value) else value


def _is_program(value: Any) -> bool:
    return hasattr(getattr(value, "jaxpr", value), "eqns")


def _loop(equation: Any) -> Any:
    """The program of a scan that takes turns."""
    turns, count = equation.params["length"], len(equation.invars) - len(equation.outvars)  # the last are carried
    turn = jaxpr_as_fun(equation.params["jaxpr"])

    def run(*operands):
        def once_more(carry):
            done, state = carry
            return done + 1, turn(*operands[:count], *state)

        return lax.while_loop(lambda carry: carry[0] < turns, once_more, (0, list(operands[count:])))[1]

    return jax.make_jaxpr(run)(*(x.aval for x in equation.invars)).jaxpr
