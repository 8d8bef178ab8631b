"""A compiler for scalar functions at many inputs: in vectors of lanes, with derivatives, kept between sessions.

Imports `jaxrock._core`. It knows no mechanics; `README.md` beside this file has two examples. Nothing outside of
this package imports anything but these names, and those of `hints`.
"""

from jaxrock.compiler import cache as cache, checks as checks, hints as hints
from jaxrock.compiler.autodiff.custom_tangent import custom_tangent as custom_tangent
from jaxrock.compiler.jaxpr.traced_function import trace_function as trace_function
from jaxrock.compiler.primitive.cond_any import cond_any as cond_any
from jaxrock.compiler.primitive.elementwise import elementwise as elementwise
from jaxrock.compiler.primitive.lane_function import TwoPass as TwoPass
from jaxrock.compiler.primitive.macro import MacroPrimitive as MacroPrimitive
from jaxrock.compiler.primitive.make import lane_function as lane_function
