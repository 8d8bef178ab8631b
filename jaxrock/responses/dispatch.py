"""One `simulate` and one `outcome` for blocks of every kind, rigid and flexible."""

import functools

from jaxrock.blocks.flexible import FlexibleBlock
from jaxrock.flexible import response as flexible
from jaxrock.responses import rigid as response

_signature_of = functools.partial(functools.wraps, assigned=(), updated=())


@_signature_of(response.outcome)
def outcome(block, motion, *arguments, **named):
    """Tell what becomes of a block under a motion and in the free stage after it.

    **Arguments:**

    - `block`: a `Block` or `AsymmetricBlock` of scalars (use `jax.vmap` for many). Or a `FlexibleBlock`: then all other
      arguments, and the result, are those of `outcome_flexible`.
    - `motion`: any motion, with a vertical one if it has one (`with_vertical`); the ground rests after its end.
    - `model`: `Housner()` (nonlinear), `Linear()`, a `Spring(...)`, or an `Equation` of your own.
    - `initial`: rotation [rad] and angular velocity [rad/s] at time 0.
    - `engine`: `Series(...)` or `Diffrax(...)`; None takes `Series()`, for an `Equation` `Diffrax()`.

    **Returns:** an `Outcome`.

    **Raises:** ValueError for arguments outside their ranges; arrays where scalars are wanted.
    """
    answer = flexible.outcome_flexible if isinstance(block, FlexibleBlock) else response.outcome
    return answer(block, motion, *arguments, **named)


@_signature_of(response.simulate)
def simulate(block, motion, *arguments, **named):
    """Compute the history of a block under a motion.

    **Arguments:**

    - `block`, `motion`, `model`, `initial`, `engine`: as in `outcome`. For a `FlexibleBlock` all arguments, and the
      result, are those of `simulate_flexible`.
    - `duration`: how long to follow the block [s], positive; None: the motion and 10/p of free rocking.
    - `samples`: number of equally spaced points of the ready-made history, at least 2; any other time is had
      by calling the result.

    **Returns:** a `Response`.

    **Raises:** ValueError for arguments outside their ranges.
    """
    answer = flexible.simulate_flexible if isinstance(block, FlexibleBlock) else response.simulate
    return answer(block, motion, *arguments, **named)
