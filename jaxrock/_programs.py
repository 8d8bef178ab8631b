"""Programs of JAX that stand within its operations: loops, cases, calls."""

from typing import Any


def programs_of(equation: Any) -> list:
    """The programs within an operation, without their constants."""
    values = [v for p in equation.params.values() for v in (p if isinstance(p, (tuple, list)) else (p,))]
    return [p for p in (getattr(v, "jaxpr", v) for v in values) if hasattr(p, "eqns")]
