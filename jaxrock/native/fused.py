"""Products that are added to something, or from which something is taken: one operation, which is rounded once.

A processor does so in one instruction. LLVM would find many of them by itself: those that it sees side by side. What it
sees depends on what else a program does, on what many scenes share, and on LLVM's effort; so would last digits. Here it
is decided before a program is taken apart, so that a scene has one answer, whether alone or among others.
"""

import functools
import math
from collections import Counter
from typing import Any

from jax.extend.core import ClosedJaxpr, Literal

from jaxrock._programs import with_programs
from jaxrock.numerics.compound import Compound

_MOST = 8  # numbers of an array: longer ones are mostly XLA's, which knows no such operation
_SUMS = {"add", "add_any", "sub"}


def _written(x, y, z, *, minus: bool, less: bool):
    product = -(x * y) if minus else x * y
    return [product - z if less else product + z]


_multiply_add = Compound("multiply_add", _written)


def fused(program: ClosedJaxpr) -> ClosedJaxpr:
    """The same program with `compound_multiply_add(x, y, z)`: x y + z, of which the settings `minus` turns the sign of
    the product, and `less` that of z."""
    return ClosedJaxpr(_fused(program.jaxpr), program.consts)


kept_fused = functools.lru_cache(maxsize=4096)(fused)  # of programs that are kept themselves


def _fused(jaxpr) -> Any:
    uses = Counter(x for equation in jaxpr.eqns for x in equation.invars if not isinstance(x, Literal))
    uses.update(x for x in jaxpr.outvars if not isinstance(x, Literal))
    products, equations = {}, {}  # by their results: factors; by number, in order
    for number, equation in enumerate(jaxpr.eqns):
        name, made = equation.primitive.name, equation.outvars
        equations[number] = equation = with_programs(equation, _fused)
        if name in _SUMS:
            x, y = equation.invars
            ours = x if _is_product(x, products) else y if _is_product(y, products) else None
            if ours is not None:
                place, factors = products[ours]
                del equations[place]
                signs = {"minus": name == "sub" and ours is y, "less": name == "sub" and ours is x}
                equations[number] = equation.replace(
                    primitive=_multiply_add.primitive, invars=[*factors, y if ours is x else x], params=signs
                )
        elif len(made) == 1 and uses[made[0]] == 1 and _is_fit(made[0].aval):
            if name == "mul":
                products[made[0]] = number, equation.invars
            elif name == "square" or (name == "integer_pow" and equation.params["y"] == 2):
                products[made[0]] = number, equation.invars * 2
    return jaxpr.replace(eqns=list(equations.values()))


def _is_product(x, products: dict) -> bool:
    return not isinstance(x, Literal) and x in products


def _is_fit(aval) -> bool:
    return aval.dtype.kind == "f" and math.prod(aval.shape) <= _MOST
