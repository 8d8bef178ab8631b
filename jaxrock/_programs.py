"""Programs of JAX that stand within its operations: loops, cases, calls."""

from typing import Any


def programs_of(equation: Any) -> list:
    """The programs within an operation, without their constants."""
    found = []
    for value in equation.params.values():
        for each in value if isinstance(value, (tuple, list)) else (value,):
            program = getattr(each, "jaxpr", each)
            if hasattr(program, "eqns"):
                found.append(program)
    return found
