"""Hints to the compiler: primitives that are the identity, or plain JAX, wherever nothing compiles for lanes.

Imports nothing of the compiler. Start with `select` and `materialize`.
"""

from jaxrock.compiler.hints.as_dtype import as_dtype as as_dtype, common_type as common_type
from jaxrock.compiler.hints.divergent import divergent as divergent, supports_divergence as supports_divergence
from jaxrock.compiler.hints.low_effort import (
    LOW_EFFORT_LIMIT as LOW_EFFORT_LIMIT,
    jit_low_effort as jit_low_effort,
    low_effort_options as low_effort_options,
)
from jaxrock.compiler.hints.materialize import (
    materialize as materialize,
    materialize_by as materialize_by,
    materialize_flag as materialize_flag,
    opaque_one as opaque_one,
)
from jaxrock.compiler.hints.padded_size import padded_size as padded_size
from jaxrock.compiler.hints.select import select as select
from jaxrock.compiler.hints.stop_gradient import stop_gradient as stop_gradient
