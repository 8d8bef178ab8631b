"""Form fused multiply-adds (FMA): a product and a sum as one operation, which is rounded once.

LLVM contracts only the adjacent products and sums that it sees. Those depend on the rest of the jaxpr, on the values
that all points share, and on LLVM's optimization level; so would the last digits. This pass decides before the jaxpr is
partitioned, so that a point has one result, alone or among others.
"""

import functools
import math
from collections import Counter
from typing import Any

from jax.extend.core import ClosedJaxpr, Literal

from jaxrock.compiler.jaxpr.traverse import with_programs
from jaxrock.compiler.primitive.macro import MacroPrimitive

_MOST = 8  # elements of an array: XLA, which has no such operation, computes most of the longer ones
_SUMS = {"add", "add_any", "sub"}


def _written(x, y, z, *, minus: bool, less: bool):
    product = -(x * y) if minus else x * y
    return [product - z if less else product + z]


_multiply_add = MacroPrimitive("multiply_add", _written)


def form_fma(program: ClosedJaxpr) -> ClosedJaxpr:
    """Return the jaxpr with `macro_multiply_add(x, y, z)` in place of products and sums: x y + z.

    Its setting `minus` changes the sign of the product, and `less` that of z.
    """
    return ClosedJaxpr(_fused(program.jaxpr), program.consts)


kept_fma = functools.lru_cache(maxsize=4096)(form_fma)  # for jaxprs that another cache holds


def _fused(jaxpr) -> Any:
    uses = Counter(x for equation in jaxpr.eqns for x in equation.invars if not isinstance(x, Literal))
    uses.update(x for x in jaxpr.outvars if not isinstance(x, Literal))
    products, equations = {}, {}  # {result: (number, factors)}; {number: equation}, in order
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
