"""Programs of JAX: those within their operations (loops, cases, calls), and what follows from what."""

from collections.abc import Iterable
from typing import Any

from jax.extend.core import Jaxpr, Literal


def programs_of(equation: Any) -> list:
    """The programs within an operation, without their constants."""
    found = []
    for value in equation.params.values():
        for each in value if isinstance(value, (tuple, list)) else (value,):
            program = getattr(each, "jaxpr", each)
            if hasattr(program, "eqns"):
                found.append(program)
    return found


def following(program: Jaxpr, variables: Iterable) -> set:
    """Variables of a program, and all that follows from them."""
    found = set(variables)
    for equation in program.eqns:
        if any(not isinstance(v, Literal) and v in found for v in equation.invars):
            found.update(equation.outvars)
    return found
