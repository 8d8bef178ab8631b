"""Walk jaxprs: find or replace the jaxprs inside an equation (loop, condition, call), and follow data dependence."""

from collections.abc import Callable, Iterable
from operator import is_
from typing import Any

from jax.extend.core import ClosedJaxpr, Jaxpr, Literal


def programs_of(equation: Any) -> list:
    """Return the jaxprs in an equation's parameters, as open jaxprs (without their constants)."""
    found = []
    for value in equation.params.values():
        for each in value if isinstance(value, (tuple, list)) else (value,):
            program = getattr(each, "jaxpr", each)
            if hasattr(program, "eqns"):
                found.append(program)
    return found


def with_programs(equation: Any, change: Callable) -> Any:
    """Return the equation with `change` applied to each of its open jaxprs; the same object if none changes."""

    def changed(value: Any) -> Any:
        if isinstance(value, ClosedJaxpr):
            new = change(value.jaxpr)
            return value if new is value.jaxpr else ClosedJaxpr(new, value.consts)
        if hasattr(value, "eqns"):
            return change(value)
        if isinstance(value, (tuple, list)) and any(isinstance(x, ClosedJaxpr) for x in value):
            parts = list(map(changed, value))
            if all(map(is_, parts, value)):
                return value
            return type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)
        return value

    inner = {key: new for key, old in equation.params.items() if (new := changed(old)) is not old}
    return equation.replace(params=equation.params | inner) if inner else equation


def following(program: Jaxpr, variables: Iterable) -> set:
    """Return the given variables of a jaxpr and every variable computed from them."""
    found = set(variables)
    for equation in program.eqns:
        if any(not isinstance(v, Literal) and v in found for v in equation.invars):
            found.update(equation.outvars)
    return found
