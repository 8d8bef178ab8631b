"""Programs without operations that change no value, which only mark it for JAX or for XLA.

One such operation may mark many values at once, of which some stay the same in a loop and others do not.
"""

from operator import is_
from typing import Any

from jax.extend.core import ClosedJaxpr, Literal

from jaxrock._programs import with_programs

_MARKS = {"fixed", "given", "stop_gradient", "keep"}


def unmarked(program: ClosedJaxpr) -> ClosedJaxpr:
    """The same program without marks."""
    return ClosedJaxpr(_without(program.jaxpr), program.consts)


def _without(jaxpr) -> Any:
    names: dict = {}  # what stands for a variable

    def read(atom):
        return atom if isinstance(atom, Literal) else names.get(atom, atom)

    equations = []
    for equation in jaxpr.eqns:
        given = [read(x) for x in equation.invars]
        if equation.primitive.name in _MARKS:
            names.update(zip(equation.outvars, given))  # what tells of a mark comes after the value
        else:
            equation = with_programs(equation, _without)
            if not all(map(is_, given, equation.invars)):
                equation = equation.replace(invars=given)
            equations.append(equation)
    return jaxpr.replace(eqns=equations, outvars=[read(x) for x in jaxpr.outvars])
