"""Remove hints from jaxprs: operations that return their operands unchanged and only inform JAX or XLA.

One hint may hold many values, some of them invariant in a loop and others not, which would hide the invariant ones.
"""

from operator import is_
from typing import Any

from jax.extend.core import ClosedJaxpr, Literal

from jaxrock.compiler.jaxpr.traverse import with_programs

_MARKS = {"custom_tangent", "materialize", "stop_gradient", "stop_gradient_of_tree"}


def strip_hints(program: ClosedJaxpr) -> ClosedJaxpr:
    """Return the jaxpr without its hints."""
    return ClosedJaxpr(_without(program.jaxpr), program.consts)


def _without(jaxpr) -> Any:
    names: dict = {}  # the operand that replaces a hint's result

    def read(atom):
        return atom if isinstance(atom, Literal) else names.get(atom, atom)

    equations = []
    for equation in jaxpr.eqns:
        given = [read(x) for x in equation.invars]
        if equation.primitive.name in _MARKS:
            names.update(zip(equation.outvars, given))  # hints take the values first, extra operands after them
        else:
            equation = with_programs(equation, _without)
            if not all(map(is_, given, equation.invars)):
                equation = equation.replace(invars=given)
            equations.append(equation)
    return jaxpr.replace(eqns=equations, outvars=[read(x) for x in jaxpr.outvars])
