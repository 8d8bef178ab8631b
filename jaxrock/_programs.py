"""Programs of JAX: those within their operations (loops, cases, calls), and what follows from what."""

from collections.abc import Callable, Iterable
from typing import Any

from jax.extend.core import ClosedJaxpr, Jaxpr, Literal


def programs_of(equation: Any) -> list:
    """The programs within an operation, without their constants."""
    found = []
    for value in equation.params.values():
        for each in value if isinstance(value, (tuple, list)) else (value,):
            program = getattr(each, "jaxpr", each)
            if hasattr(program, "eqns"):
                found.append(program)
    return found


def with_programs(equation: Any, change: Callable) -> Any:
    """An operation whose programs (without their constants) are changed; the same object where none is."""

    def changed(value: Any) -> Any:
        if isinstance(value, ClosedJaxpr):
            new = change(value.jaxpr)
            return value if new is value.jaxpr else ClosedJaxpr(new, value.consts)
        if hasattr(value, "eqns"):
            return change(value)
        if isinstance(value, (tuple, list)) and any(isinstance(x, ClosedJaxpr) for x in value):
            return tuple(map(changed, value))
        return value

    inner = {key: new for key, old in equation.params.items() if (new := changed(old)) is not old}
    return equation.replace(params=equation.params | inner) if inner else equation


def following(program: Jaxpr, variables: Iterable) -> set:
    """Variables of a program, and all that follows from them."""
    found = set(variables)
    for equation in program.eqns:
        if any(not isinstance(v, Literal) and v in found for v in equation.invars):
            found.update(equation.outvars)
    return found
